"""The membrane pump board as a Modbus TCP device over any plant.

`BoardState` is what it does, without bytes, clock or asyncio: registers, watchdog, latches, its own
limits.
"""

import asyncio
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from firmware_iface.board_settings import GAUGE_FROZEN_S, GAUGE_TIMEOUT_S
from firmware_iface.emulators import modbus_pdu, modbus_server
from firmware_iface.emulators.modbus_pdu import (
    BUSY,
    ILLEGAL_ADDRESS,
    ILLEGAL_VALUE,
    RegisterRefusal,
)
from firmware_iface.register_map import Block, Register, RegisterMap, load_default_map, make_block

FIRMWARE_VERSION = 0x00_01_01_00  # 1.1.0
# the paper's mirror works at 600 Pa; the controller's own limit (750 Pa) is to act first
GAUGE_PRESSURE_LIMIT_PA = 800.0
PUMP_LIMIT_FRACTION = 1.0
WATCHDOG_PERIOD_S = 1.0  # after power-up; the watchdog itself is then off, as on most devices
_GAUGE_RANGE_PA = load_default_map().register("gauge_pressure_pa").to_value(2**31 - 1)
# registers that read as 0
_SECRETS = dict.fromkeys(("claim_key", "command_key", "clear_key", "stop"), 0.0)
# the register of a block that carries the claim's secret; a block without one needs no claim
_KEYS = {"settings": "claim_key", "command": "command_key", "reset": "clear_key"}
# the board's own loop; the pump is off at most this and one wake-up after the watchdog period
_PERIOD_S = 0.01
_GATEWAY_NO_RESPONSE = 11


@dataclass(frozen=True, slots=True)
class BoardSample:
    """One sample of the board's sensors; NaN where there is no value (units as in
    `roles.BenchReading`).
    """

    displacement_um: float
    displacement_quality: int
    gauge_pressure_pa: float
    ambient_pressure_pa: float
    air_temperature_c: float
    gas_temperature_c: float
    sample_counter: int
    device_time_s: float
    interlock_inputs: int = 0xFFFF  # bit i: the circuit of interlock input i is closed
    # Of instruments beside the board, which has no registers for them
    film_temperature_c: float = math.nan
    ring_temperature_c: float = math.nan
    humidity_percent: float = math.nan

    @property
    def gauge_present(self) -> bool:
        """Whether the gauge has a value that its register can hold."""
        return abs(self.gauge_pressure_pa) <= _GAUGE_RANGE_PA  # False for NaN


@dataclass(frozen=True, slots=True)
class StoredSettings:
    """Settings that a board keeps without power: which protections of its own are fitted (from map
    version 3).
    """

    gauge_fitted: bool = True
    gauge_timeout_s: float = GAUGE_TIMEOUT_S  # of pumping without a value of the gauge
    # of pumping with a gauge that repeats its value; 0: not judged
    gauge_frozen_s: float = GAUGE_FROZEN_S
    interlocks_fitted: int = 0  # bit i: interlock input i stops the pump when it is open


class BoardState:
    """The board between two requests.

    `advance` is called before every request and every few milliseconds: the watchdog, the pressure
    limit and the guard of the gauge depend only on the time passed in.

    Parameters
    ----------
    registers : RegisterMap
        Of the board's map version, which decides whether it has claims and guards.
    sample : BoardSample
        What the sensors measure at power-up.
    stored : StoredSettings
        Settings kept without power; boards of map versions 1 and 2 ignore them.

    Attributes
    ----------
    map_version : int
        As it reports it; a test may set another one.
    """

    def __init__(
        self, registers: RegisterMap, sample: BoardSample, stored: StoredSettings = StoredSettings()
    ) -> None:
        self.map_version = registers.map_version
        self.registers = registers
        self.stored = stored
        self._by_address = {register.address: register for register in registers}
        # drivers read whole blocks again and again: found at once
        self._by_span = {(block.address, block.count): block for block in registers.blocks}
        self._command = registers.block("command")
        self._claims = registers.map_version >= 2
        self._watchdog_mask = registers.make_fault_mask("watchdog")
        self._over_pressure_mask = registers.make_fault_mask("over_pressure")
        if self._claims:
            self._stopped_mask = registers.make_fault_mask("stopped")
        else:
            self._stopped_mask = 0
        self._guards = registers.map_version >= 3
        if self._guards:
            self._gauge_lost_mask = registers.make_fault_mask("gauge_lost")
            self._interlock_mask = registers.make_fault_mask("interlock")
        else:
            self._gauge_lost_mask = 0
            self._interlock_mask = 0
        self._sample = sample
        self._now_s = 0.0
        self.restart()

    def restart(self) -> None:
        """Power-up: outputs off, watchdog off, settings and faults lost."""
        self._settable = {
            "watchdog_period_s": WATCHDOG_PERIOD_S,
            "watchdog_arm": 0.0,
            "pump_command_fraction": 0.0,
            "vent_command_fraction": 0.0,
            "heartbeat": 0.0,
            "clear_faults": 0.0,
        }
        self._claim_id = self._claim_key = 0.0
        self._heartbeat_fed = 0.0
        self._fed_s = 0.0
        self._faults = 0
        self._gauge_seen_s = -math.inf  # when the gauge last had a value
        self._gauge_pa = math.nan  # that value
        # time of pumping since it changed, or since a person cleared `gauge_lost`
        self._gauge_same_s = 0.0
        self._watch_gauge(0.0)
        self._protect_pump()

    @property
    def pump_fraction(self) -> float:
        """What the pump is given: 0 while any fault is latched."""
        if self._faults:
            return 0.0
        return min(self._settable["pump_command_fraction"], PUMP_LIMIT_FRACTION)

    @property
    def vent_fraction(self) -> float:
        """How far the vent is open: fully after over-pressure.

        A watchdog trip leaves it as commanded: a controller that died while venting must not stop
        the venting, and one that died while holding had it closed or at a small bleed, on which the
        mirror sinks slowly.
        """
        if self._faults & self._over_pressure_mask:
            return 1.0
        return self._settable["vent_command_fraction"]

    def advance(self, now_s: float, sample: BoardSample) -> None:
        """Take the newest sample, then let the board's own protections act.

        Parameters
        ----------
        now_s : float
            Time on any axis that does not fall.
        sample : BoardSample
            What the sensors measure.
        """
        passed_s = now_s - self._now_s
        self._now_s = now_s
        self._sample = sample
        if sample.gauge_pressure_pa > GAUGE_PRESSURE_LIMIT_PA:
            self._latch_fault(self._over_pressure_mask)
        self._watch_gauge(passed_s)
        self._protect_pump()
        if (
            self._settable["watchdog_arm"]
            and now_s - self._fed_s > self._settable["watchdog_period_s"]
        ):
            self._latch_fault(self._watchdog_mask)

    def _watch_gauge(self, passed_s: float) -> None:
        """Note when the gauge had a value, and for how long of pumping it has repeated it."""
        if self.pump_fraction > 0:
            self._gauge_same_s += passed_s
        if not self._sample.gauge_present:
            return
        self._gauge_seen_s = self._now_s
        if self._sample.gauge_pressure_pa != self._gauge_pa:
            self._gauge_pa = self._sample.gauge_pressure_pa
            self._gauge_same_s = 0.0

    @property
    def _gauge_lost(self) -> bool:
        stored = self.stored
        missing = self._now_s - self._gauge_seen_s > stored.gauge_timeout_s
        frozen = 0 < stored.gauge_frozen_s < self._gauge_same_s
        return stored.gauge_fitted and (missing or frozen)

    def _protect_pump(self) -> None:
        """Stop a pump whose gauge is lost, and latch an open interlock.

        Judged with every sample and after every write, so that no command drives the pump even for
        a moment. The gauge's age counts on while the fault is latched and when it is cleared:
        without a new value the pump does not run again. An open circuit latches even if the pump is
        off: an emergency stop must not be forgotten.
        """
        if not self._guards:
            return
        if self._settable["pump_command_fraction"] > 0 and self._gauge_lost:
            self._latch_fault(self._gauge_lost_mask)
        if self.stored.interlocks_fitted & ~self._sample.interlock_inputs:
            self._latch_fault(self._interlock_mask)

    @property
    def held(self) -> bool:
        """A claim is held and its watchdog was fed in time: no other program may have the board.

        A latched fault does not matter: a program may claim and hold a latched board.
        """
        return (
            bool(self._claim_key)
            and self._now_s - self._fed_s <= self._settable["watchdog_period_s"]
        )

    def _latch_fault(self, mask: int) -> None:
        self._faults |= mask
        # so that nothing moves when the fault is cleared
        self._settable["pump_command_fraction"] = 0.0

    def read(self, address: int, count: int) -> list[int]:
        """Return the words of one instant.

        Parameters
        ----------
        address : int
            Of the first register.
        count : int
            How many.

        Returns
        -------
        list of int

        Raises
        ------
        RegisterRefusal
            Illegal address: one of them does not exist.
        """
        values = self._collect_values()
        whole = self._by_span.get((address, count))
        if whole is not None:
            return whole.encode(values)
        end = address + count
        by_address: dict[int, int] = {}
        for block in self.registers.blocks:
            if block.address < end and address < block.address + block.count:
                by_address.update(enumerate(block.encode(values), block.address))
        if not all(each in by_address for each in range(address, end)):
            raise RegisterRefusal(ILLEGAL_ADDRESS)
        return [by_address[each] for each in range(address, end)]

    def write(self, address: int, words: Sequence[int]) -> None:
        """Write whole registers, all or none.

        Parameters
        ----------
        address : int
            First register on the wire, from 0.
        words : sequence of int
            Unsigned 16 bit; the map states how they encode the registers' values.

        Raises
        ------
        RegisterRefusal
            Illegal address for a read-only or unknown register or for a part of one; illegal value
            outside the limits, and for disarming the watchdog while the pump is commanded. With
            claims (map version 2 and later): illegal address for a part of a block, busy while
            another holds the board, illegal value without any claim.
        """
        # Everything is checked before anything is stored, so that a refused write changes nothing.
        target = self._find_written_block(address, len(words))
        written = target.decode(words)
        if not all(register.allows(written[register.name]) for register in target.registers):
            raise RegisterRefusal(ILLEGAL_VALUE)
        if self._claims:
            self._check_claim(target.name, written)
        disarms = written.get("watchdog_arm") == 0 and self._settable["watchdog_arm"]
        if disarms and self._settable["pump_command_fraction"] > 0:
            raise RegisterRefusal(ILLEGAL_VALUE)
        if self._claims and target.name == "settings":
            self._update_claim(written)
        self._apply_settings(written, whole_command=target.registers == self._command.registers)

    def _check_claim(self, block: str, written: dict[str, float]) -> None:
        key = _KEYS.get(block)
        if key is None or written[key] == self._claim_key:
            return
        if self.held:
            raise RegisterRefusal(BUSY)
        if not written.get("watchdog_arm"):  # only arming makes a claim
            raise RegisterRefusal(ILLEGAL_VALUE)

    def _update_claim(self, written: dict[str, float]) -> None:
        """Arming claims the board, disarming gives it back; a new claim has a whole period from now
        on.
        """
        if not written["watchdog_arm"]:
            self._claim_id = self._claim_key = 0.0
            return
        if written["claim_key"] != self._claim_key:
            self._fed_s = self._now_s
        self._claim_id = written["claim_id"]
        self._claim_key = written["claim_key"]

    def _find_written_block(self, address: int, count: int) -> Block:
        whole = self._by_span.get((address, count))
        if whole is not None and whole.access == "rw":
            return whole
        if self._claims:
            raise RegisterRefusal(ILLEGAL_ADDRESS)
        found: list[Register] = []
        end = address + count
        while address < end:
            register = self._by_address.get(address)
            if register is None or register.access != "rw" or address + register.words > end:
                raise RegisterRefusal(ILLEGAL_ADDRESS)
            found.append(register)
            address += register.words
        return make_block("write", "rw", "", found)

    def _apply_settings(self, written: dict[str, float], *, whole_command: bool) -> None:
        # The watchdog is fed by a whole command with a new heartbeat: a program that repeats one
        # old message must not keep the pump running.
        arms = bool(written.get("watchdog_arm")) and not self._settable["watchdog_arm"]
        feeds = whole_command and written["heartbeat"] != self._heartbeat_fed
        self._settable |= written
        if feeds:
            self._heartbeat_fed = written["heartbeat"]
        # `clear_faults` is a mask: it clears the named faults only, and the pump starts at zero.
        cleared = int(self._settable["clear_faults"]) & self._faults
        if cleared:
            self._faults &= ~cleared
            self._settable["pump_command_fraction"] = 0.0
        self._settable["clear_faults"] = 0.0
        if written.get("stop"):
            self._latch_fault(self._stopped_mask)
        if arms or feeds or cleared & self._watchdog_mask:
            self._fed_s = self._now_s
        if cleared & self._gauge_lost_mask:
            self._gauge_same_s = 0.0  # a gauge at rest shows that it works only once the pump runs
        self._protect_pump()

    def _collect_values(self) -> dict[str, float]:
        sample = self._sample
        whole_s = int(sample.device_time_s)
        return {
            **self._settable,
            "device_kind": self.registers.device_kind,
            "map_version": self.map_version,
            "firmware_version": FIRMWARE_VERSION,
            "gauge_pressure_limit_pa": GAUGE_PRESSURE_LIMIT_PA,
            "pump_limit_fraction": PUMP_LIMIT_FRACTION,
            "gauge_fitted": float(self.stored.gauge_fitted),
            "gauge_timeout_s": self.stored.gauge_timeout_s,
            "gauge_frozen_s": self.stored.gauge_frozen_s,
            "interlocks_fitted": self.stored.interlocks_fitted,
            "sample_counter": sample.sample_counter % 2**32,
            "device_time_s": whole_s,
            # cut, not rounded: 10000 of 10000 would be a second too many
            "device_time_fraction_s": int((sample.device_time_s - whole_s) * 10_000) / 10_000,
            "displacement_quality": sample.displacement_quality,
            "displacement_um": sample.displacement_um,
            "gauge_pressure_pa": sample.gauge_pressure_pa if sample.gauge_present else math.nan,
            "ambient_pressure_pa": sample.ambient_pressure_pa,
            "air_temperature_c": sample.air_temperature_c,
            "gas_temperature_c": sample.gas_temperature_c,
            "pump_readback_fraction": self.pump_fraction,
            "vent_readback_fraction": self.vent_fraction,
            "heartbeat_echo": self._heartbeat_fed,
            "watchdog_armed": self._settable["watchdog_arm"],
            "watchdog_tripped": float(bool(self._faults & self._watchdog_mask)),
            "latched_faults": self._faults,
            "period_in_force_s": self._settable["watchdog_period_s"],
            "claim_in_force": self._claim_id,
            "interlock_inputs": sample.interlock_inputs & 0xFFFF,
            "claim_id": self._claim_id,
            **_SECRETS,
        }


class BoardPlant(Protocol):
    """The plant on the board's wires."""

    def sample(self) -> BoardSample:
        """The newest sample of the sensors; called every 10 ms and at every request."""

    def actuate(self, pump_fraction: float, vent_fraction: float) -> None:
        """Drive pump and vent; called when one of them changes.

        Parameters
        ----------
        pump_fraction : float
            0 (off) to 1 (full power), after the board's own limits.
        vent_fraction : float
            0 (closed) to 1 (open).
        """


class PumpBoardEmulator:
    """Serves a plant on Modbus TCP, from the event loop's thread.

    Parameters
    ----------
    plant : BoardPlant
        On the board's wires.
    host : str
        Address to listen on.
    port : int
        TCP port; 0 takes any free one (see `port` after `start`).
    clock : callable or None
        Of the watchdog, s; None is the event loop's.
    unit_id : int
        Requests to other units get exception 11, as from a gateway.
    registers : RegisterMap or None
        Those of an earlier map version; None is the newest.
    stored : StoredSettings
        Settings that the board keeps without power.
    """

    def __init__(
        self,
        plant: BoardPlant,
        host: str = "127.0.0.1",
        port: int = 0,
        clock: Callable[[], float] | None = None,
        unit_id: int = 1,
        registers: RegisterMap | None = None,
        stored: StoredSettings = StoredSettings(),
    ) -> None:
        self._plant = plant
        self._clock = clock or (lambda: asyncio.get_running_loop().time())
        self._unit_id = unit_id
        self._sample = plant.sample()
        self.state = BoardState(registers or load_default_map(), self._sample, stored)
        self._actuated = (0.0, 0.0)
        self._server = modbus_server.ModbusTcpServer(self._handle, host, port)
        self._task: asyncio.Task[None] | None = None

    @property
    def port(self) -> int:
        """The port in use."""
        return self._server.port

    async def start(self) -> None:
        """Switch the board on. Raises OSError when it cannot listen, for example on a busy port."""
        await self._server.start()
        self._plant.actuate(*self._actuated)
        self._task = asyncio.create_task(self._run(), name="pump board emulator")

    async def stop(self) -> None:
        """Switch the board off: connections dropped, pump off, vent as it was. Raises what the
        plant raised.
        """
        task, self._task = self._task, None
        if task is None:
            return
        await self._server.stop()
        task.cancel()
        try:
            await task
        except asyncio.CancelledError:
            self._plant.actuate(0.0, self._actuated[1])

    def power_cycle(self) -> None:
        """Restart the board; connections live on, as behind a gateway (see also
        `drop_connections`).
        """
        self.state.restart()
        self._drive_outputs()

    def drop_connections(self) -> None:
        """Hang up on all clients."""
        self._server.drop_connections()

    async def _run(self) -> None:
        while True:
            self._advance()
            await asyncio.sleep(_PERIOD_S)

    def _advance(self) -> None:
        self._sample = self.newest()
        self.state.advance(self._clock(), self._sample)
        self._drive_outputs()

    def newest(self) -> BoardSample:
        """The sample of the sensors now."""
        return self._plant.sample()

    def _drive_outputs(self) -> None:
        outputs = (self.state.pump_fraction, self.state.vent_fraction)
        if outputs != self._actuated:
            self._actuated = outputs
            self._plant.actuate(*outputs)

    def _handle(self, unit: int, pdu: bytes) -> modbus_server.Answer:
        if unit != self._unit_id:
            return modbus_server.Answer(modbus_pdu.exception_pdu(pdu, _GATEWAY_NO_RESPONSE))
        return self.answer(pdu)

    def answer(self, pdu: bytes) -> modbus_server.Answer:
        """Carry out a request."""
        self._advance()
        reply = modbus_pdu.answer_request(pdu, self.state)
        self._drive_outputs()
        return modbus_server.Answer(reply)
