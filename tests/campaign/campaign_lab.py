"""Single instruments at a plant, in memory, converted by this module's own arithmetic."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import Any

from campaign_times import WATCHDOG_S
from campaign_world import WatchedPlant

from firmware_iface.drivers.bronkhorst import BronkhorstFlow, BronkhorstPressure
from firmware_iface.drivers.bronkhorst_modbus import ModbusParameters
from firmware_iface.drivers.modbus_map import ModbusValue, make_map
from firmware_iface.emulators.modbus_pdu import RegisterRefusal, RegisterTable
from firmware_iface.emulators.pumps import BronkhorstRegisters, Instrument
from firmware_iface.role_bench import RoleBench, RoleDevices
from firmware_iface.roles import DeviceRefusedError, LinkDownError, LinkError


class Registers:
    """Values in registers of 16 bit, by arithmetic of its own: 4000 .. 20000 for `low` ..
    `high`.
    """

    def __init__(
        self,
        low: float,
        high: float,
        value: Callable[[], float],
        set_value: Callable[[float], None],
    ) -> None:
        self._low, self._high, self._value, self._set_value = low, high, value, set_value

    def read(self, address: int, count: int) -> list[int]:
        """The value as it is."""
        if (address, count) != (0, 1):
            raise RegisterRefusal(2)
        return [round(4000 + 16000 * (self._value() - self._low) / (self._high - self._low))]

    def write(self, address: int, words: Sequence[int]) -> None:
        """The actuator's drive: nothing with a broken wire, full scale at most."""
        if address != 0 or len(words) != 1:
            raise RegisterRefusal(2)
        share = min(max((words[0] - 4000) / 16000, 0.0), 1.0)
        self._set_value(self._low + share * (self._high - self._low))


class TableLink:
    """A `ModbusLink` that ends at a table in memory; it can be unplugged,
    and lose single answers.
    """

    def __init__(self, name: str, table: RegisterTable) -> None:
        self.name, self.table = name, table
        self.plugged, self.connected = True, False
        self.lose = 0
        self.deaf = False  # to writes

    async def connect(self) -> None:
        if not self.plugged:
            raise LinkDownError(f"{self.name}: not plugged in")
        self.connected = True

    async def read_holding(self, address: int, count: int) -> list[int]:
        self._ask()
        try:
            return self.table.read(address, count)
        except RegisterRefusal as refusal:
            raise DeviceRefusedError(f"{self.name}: {refusal}") from None

    read_input = read_holding

    async def write_register(self, address: int, word: int) -> None:
        await self.write_registers(address, [word])

    async def write_registers(self, address: int, words: Sequence[int]) -> None:
        self._ask()
        if self.deaf:
            raise LinkError(f"{self.name}: no answer")
        try:
            self.table.write(address, words)
        except RegisterRefusal as refusal:
            raise DeviceRefusedError(f"{self.name}: {refusal}") from None

    async def close(self) -> None:
        self.connected = False

    def _ask(self) -> None:
        if not (self.connected and self.plugged):
            self.connected = False
            raise LinkDownError(f"{self.name}: the connection is gone")
        if self.lose > 0:
            self.lose -= 1
            raise LinkError(f"{self.name}: no answer")


class Instruments:
    """Single instruments at a plant, in memory, converted by this class's own arithmetic."""

    def __init__(self, plant: WatchedPlant, bronkhorst: bool) -> None:
        self._plant, self._at_s = plant, 0.0
        self._pump = self._vent = 0.0
        self.offset_pa = 0.0
        sensor, lead = self._sensor, self._lead
        self.laser = self._link(
            "laser", Registers(-1000.0, 1000.0, sensor("displacement_um"), lambda _: None)
        )
        self.vent = self._link("vent", Registers(0.0, 1.0, lambda: self._vent, lead("_vent")))
        if bronkhorst:
            flow = Instrument("DMFC", "M1", 360.0, "mln/min", None, lead("_pump"))
            gauge = Instrument("DEPC", "M2", 10.0, "mbar(g)", lambda: self._gauge_pa() / 100)
            self.pump, self.gauge = (
                self._link(n, BronkhorstRegisters(i)) for n, i in (("p", flow), ("g", gauge))
            )
            pump: Any = BronkhorstFlow(ModbusParameters(self.pump), "M1")
            pressure: Any = BronkhorstPressure(ModbusParameters(self.gauge), "M2")
        else:
            self.pump = self._link("pump", Registers(0.0, 1.0, lambda: self._pump, lead("_pump")))
            self.gauge = self._link(
                "gauge", Registers(-100.0, 1100.0, self._gauge_pa, lambda _: None)
            )
            pump = ModbusValue(self.pump, _map(0.0, 1.0), rest=0.0)
            pressure = ModbusValue(self.gauge, _map(-100.0, 1100.0))
        laser = ModbusValue(
            self.laser, _map(-1000.0, 1000.0), clock=asyncio.get_running_loop().time
        )
        roles = RoleDevices(laser, pump, pressure, ModbusValue(self.vent, _map(0.0, 1.0), rest=0.0))
        self.bench = RoleBench(roles, WATCHDOG_S, asyncio.get_running_loop().time)

    def now(self) -> WatchedPlant:
        """The plant as it is now."""
        now_s = asyncio.get_running_loop().time()
        if now_s > self._at_s:
            self._plant.advance(now_s - self._at_s)
            self._at_s = now_s
        return self._plant

    def _link(self, name: str, table: RegisterTable) -> TableLink:
        return TableLink(name, table)

    def _sensor(self, name: str) -> Callable[[], float]:
        return lambda: float(getattr(self.now().sample(), name))

    def _gauge_pa(self) -> float:
        return self.now().sample().gauge_pressure_pa + self.offset_pa

    def _lead(self, name: str) -> Callable[[float], None]:
        def drive(fraction: float) -> None:
            self.now()
            setattr(self, name, fraction)
            self._plant.actuate(self._pump, self._vent)

        return drive


def _map(low: float, high: float) -> Any:
    return make_map({"address": 0, "raw": (4000, 20000), "value": (low, high)})[0]
