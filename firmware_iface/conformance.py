"""Does a board do what a pump board must do? Any board is asked over its own protocol, nothing else is touched.

What is tested, and why, is in docs/firmware.md; each check names its section. The pump is commanded to a few per cent
for moments: do not run it on a mirror that must not move.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from firmware_iface.links.modbus_links import ModbusLinks
from firmware_iface.links.modbus_rules import ModbusLink
from firmware_iface.register_map import Block, Register, RegisterMap, default_map
from firmware_iface.roles import DeviceRefusedError, LinkDownError, LinkError

PUMP_FRACTION = 0.05  # below what starts a diaphragm pump
PERIOD_S = 0.3  # watchdog period during the test
_GRACE_S = 0.1  # the board's own loop and one wake-up after the period
_NEAR = 0.002  # of a fraction: counts of a board that rounds its output


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one check: `problem` is empty when it passed, else what the board did wrong."""

    check: str
    section: str
    problem: str


class ConformanceError(Exception):
    """The board did not do what it must; the message says what it did."""


def _require(right: bool, problem: str) -> None:
    if not right:
        raise ConformanceError(problem)


class Conformance:
    """The checks, in the order they are made.

    Parameters
    ----------
    link : ModbusLink
        The board, connected.
    sleep : callable
        Waits; the board's clock is what counts.
    """

    def __init__(self, link: ModbusLink, sleep: Callable[[float], Awaitable[None]] = asyncio.sleep) -> None:
        self._link = link
        self._sleep = sleep
        self._registers: RegisterMap = default_map()
        self._command = self._registers.block("command")
        self._heartbeat = 0

    async def run(self) -> list[Finding]:
        """Make all checks; the first one decides whether the others mean anything. Raises LinkDownError."""
        findings: list[Finding] = []
        for check, section, test in self._checks():
            problem = ""
            try:
                await test()
            except ConformanceError as error:
                problem = str(error)
            except LinkDownError:
                raise
            except LinkError as error:
                problem = f"no valid answer: {error}"
            findings.append(Finding(check, section, problem))
            if problem and check == "identity":
                break
            await self._rest()
        return findings

    def _checks(self) -> list[tuple[str, str, Callable[[], Awaitable[None]]]]:
        return [
            ("identity", "Registers", self._identity),
            ("every block is read whole", "Registers", self._blocks),
            ("samples advance", "Timing", self._advance),
            ("a command is carried out and read back", "Commands", self._obeys),
            ("values outside the limits are refused", "Commands", self._limits),
            ("a refused write changes nothing", "Commands", self._atomic),
            ("read-only and unknown registers are refused", "Registers", self._read_only),
            ("settings are read back as written", "Watchdog", self._settings),
            ("disarming is refused while the pump is commanded", "Watchdog", self._disarm),
            ("a silent host stops the pump", "Watchdog", self._silent),
            ("the same heartbeat does not feed", "Watchdog", self._stuck),
            ("half a command does not feed", "Watchdog", self._half),
            ("a latched fault keeps the pump off", "States", self._latched),
            ("clearing sets the pump to 0", "States", self._cleared),
        ]

    async def _read(self, block: Block) -> dict[str, float]:
        return block.decode(await self._link.read_holding(block.address, block.count))

    async def _sensors(self) -> dict[str, float]:
        return await self._read(self._registers.block("sensors"))

    async def _write(self, pump: float, vent: float = 0.0, *, fresh: bool = True) -> None:
        self._heartbeat = (self._heartbeat + fresh) % 2**16
        values = {"pump_command_fraction": pump, "vent_command_fraction": vent, "heartbeat": self._heartbeat}
        await self._link.write_registers(self._command.address, self._command.encode(values))

    async def _arm(self, period_s: float = PERIOD_S, arm: float = 1.0) -> None:
        block = self._registers.block("settings")
        values = {"watchdog_period_s": period_s, "watchdog_arm": arm}
        await self._link.write_registers(block.address, block.encode(values))

    async def _clear(self) -> None:
        await self._link.write_registers(self._registers.block("reset").address, [0xFFFF])

    async def _rest(self) -> None:
        """Pump off, faults cleared, watchdog off: how every check begins and ends."""
        for step in (self._clear, lambda: self._write(0.0), lambda: self._arm(arm=0.0)):
            try:
                await step()
            except LinkDownError:
                raise
            except LinkError:
                continue  # what the board cannot do is said by the check that asks for it

    async def _identity(self) -> None:
        found = await self._read(self._registers.block("identity"))
        kind, version = int(found["device_kind"]), int(found["map_version"])
        wanted = self._registers
        _require(kind == wanted.device_kind, f"device kind is {kind}, wanted {wanted.device_kind}")
        _require(version == wanted.map_version, f"map version is {version}, this test knows {wanted.map_version}")
        _require(found["gauge_pressure_limit_pa"] > 0, "gauge_pressure_limit_pa is not above 0")
        _require(0 < found["pump_limit_fraction"] <= 1, "pump_limit_fraction is not within 0..1")
        self._heartbeat = int((await self._sensors())["heartbeat_echo"])

    async def _blocks(self) -> None:
        for block in self._registers.blocks:
            await self._read(block)

    async def _advance(self) -> None:
        before = await self._sensors()
        await self._sleep(0.1)
        after = await self._sensors()
        _require(after["sample_counter"] != before["sample_counter"], "sample_counter stands still for 0.1 s")
        passed_s = _time_s(after) - _time_s(before)
        _require(0.02 < passed_s < 1.0, f"device time went {passed_s:.3f} s in 0.1 s")

    async def _obeys(self) -> None:
        for pump, vent in ((PUMP_FRACTION, 0.0), (0.0, 0.5), (0.0, 0.0)):
            await self._write(pump, vent)
            await self._sleep(_GRACE_S)
            found = await self._sensors()
            for name, wanted in (("pump", pump), ("vent", vent)):
                value = found[f"{name}_readback_fraction"]
                _require(abs(value - wanted) < _NEAR, f"{name} commanded {wanted:g}, read back {value:g}")
        _require(int(found["heartbeat_echo"]) == self._heartbeat, "heartbeat_echo is not the last heartbeat")

    async def _limits(self) -> None:
        for register in self._registers:
            for raw in _outside(register):
                what = f"{register.name} = {raw / register.counts_per_unit:g}"
                await self._refused([raw], register.address, what, "limits")

    async def _refused(self, words: list[int], address: int, what: str, why: str) -> None:
        try:
            await self._link.write_registers(address, words)
        except DeviceRefusedError:
            return
        raise ConformanceError(f"accepts {what}, which is outside its {why}")

    async def _atomic(self) -> None:
        await self._write(0.0, 0.25)
        words = self._command.encode(
            {"pump_command_fraction": 0.0, "vent_command_fraction": 1.0, "heartbeat": self._heartbeat}
        )
        words[0] = 0xFFFF  # a pump command of 1.31
        await self._refused(words, self._command.address, "a command block with one value of 1.31", "limits")
        found = await self._read(self._command)
        _require(
            abs(found["vent_command_fraction"] - 0.25) < _NEAR,
            f"a refused block set the vent to {found['vent_command_fraction']:g}",
        )

    async def _read_only(self) -> None:
        for name in ("identity", "sensors"):
            await self._refused([0], self._registers.block(name).address, f"a write to {name}", "rights")
        last = max(block.address + block.count for block in self._registers.blocks)
        try:
            await self._link.read_holding(last, 1)
        except DeviceRefusedError:
            return
        raise ConformanceError(f"answers a read of register {last}, which the map does not have")

    async def _settings(self) -> None:
        for period_s in (PERIOD_S, 1.5):
            await self._arm(period_s)
            found = await self._read(self._registers.block("settings"))
            _require(found["watchdog_arm"] == 1, "watchdog_arm written 1, read back 0")
            value_s = found["watchdog_period_s"]
            _require(abs(value_s - period_s) < 1e-3, f"watchdog_period_s written {period_s:g}, read back {value_s:g}")
        _require((await self._sensors())["watchdog_armed"] == 1, "watchdog_armed stays 0 after arming")

    async def _disarm(self) -> None:
        await self._arm(10.0)
        await self._write(PUMP_FRACTION)
        try:
            await self._arm(10.0, 0.0)
        except DeviceRefusedError:
            return
        raise ConformanceError("lets the watchdog be disarmed while the pump is commanded")

    async def _silent(self) -> None:
        await self._arm()
        await self._write(PUMP_FRACTION)
        await self._sleep(PERIOD_S / 2)
        found = await self._sensors()
        _require(found["pump_readback_fraction"] > 0, "stops the pump before the watchdog period is over")
        await self._sleep(PERIOD_S / 2 + _GRACE_S)
        await self._tripped("a host silent for longer than the watchdog period")

    async def _tripped(self, after: str) -> None:
        found = await self._sensors()
        value = found["pump_readback_fraction"]
        _require(value == 0, f"holds the pump at {value:g} after {after}")
        mask = self._registers.fault_mask("watchdog")
        _require(found["watchdog_tripped"] == 1, f"does not report watchdog_tripped after {after}")
        _require(bool(int(found["latched_faults"]) & mask), f"does not latch the watchdog fault after {after}")

    async def _stuck(self) -> None:
        await self._arm()
        await self._write(PUMP_FRACTION)
        for _ in range(4):
            await self._sleep((PERIOD_S + _GRACE_S) / 4)
            await self._write(PUMP_FRACTION, fresh=False)
        await self._tripped("writes that repeat one heartbeat")

    async def _half(self) -> None:
        await self._arm()
        await self._write(PUMP_FRACTION)
        pump = self._registers.register("pump_command_fraction")
        for _ in range(4):
            await self._sleep((PERIOD_S + _GRACE_S) / 4)
            await self._link.write_registers(pump.address, [round(PUMP_FRACTION * pump.counts_per_unit)])
        await self._tripped("writes of the pump command alone")

    async def _latched(self) -> None:
        await self._arm()
        await self._write(PUMP_FRACTION)
        await self._sleep(PERIOD_S + _GRACE_S)
        await self._write(PUMP_FRACTION)
        await self._sleep(_GRACE_S)
        value = (await self._sensors())["pump_readback_fraction"]
        _require(value == 0, f"runs the pump at {value:g} while a fault is latched")

    async def _cleared(self) -> None:
        await self._arm()
        await self._write(PUMP_FRACTION)
        await self._sleep(PERIOD_S + _GRACE_S)
        await self._write(PUMP_FRACTION)
        await self._clear()
        found = await self._sensors()
        _require(found["latched_faults"] == 0, f"faults stay {found['latched_faults']:g} after they were cleared")
        value = found["pump_readback_fraction"]
        _require(value == 0, f"starts the pump at {value:g} when faults are cleared")


def _time_s(values: dict[str, float]) -> float:
    return values["device_time_s"] + values["device_time_fraction_s"]


def _outside(register: Register) -> list[int]:
    """Raw 16-bit values just outside a register's limits, where the type has such."""
    if register.access != "rw" or register.words != 1 or math.isinf(register.maximum):
        return []
    low, high = (round(limit * register.counts_per_unit) for limit in (register.minimum, register.maximum))
    return [raw for raw in (low - 1, high + 1, 0xFFFF) if 0 <= raw <= 0xFFFF and not low <= raw <= high]


async def examine(url: str, unit_id: int = 1, timeout_s: float = 0.5) -> list[Finding]:
    """All findings about the board at a Modbus URL. Raises LinkError if it is not there, ValueError for the URL."""
    link = ModbusLinks().link(url, unit_id, timeout_s)
    await link.connect()
    try:
        return await Conformance(link).run()
    finally:
        await link.close()
