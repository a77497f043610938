"""The pump board in virtual time: its registers, its watchdog and its latches around the twin's
plant, no wire.

The driver is that of a real bench; only its link ends in memory. Failures of sensors, link, board
and actuators are switches (`Wrong`), which a scenario or a campaign changes at run time.
"""

import contextlib
import math
from collections.abc import Coroutine, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from firmware_iface import register_map, roles
from firmware_iface.drivers.pump_board import PumpBoard
from firmware_iface.emulators import modbus_pdu, pump_board
from firmware_iface.links.modbus_link import exception_error
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_interlocks import VirtualInterlocks

T = TypeVar("T")
_LASER_NO_LIGHT = 1


@dataclass(slots=True)
class Wrong:
    """Present failures, initially none. Fractions and offsets are NaN or 0 when off."""

    no_light: bool = False  # the laser has no reading
    laser_offset_um: float = 0.0  # error of its reading
    laser_stuck: bool = False  # it repeats its value, with samples that advance
    samples_frozen: bool = False  # the board answers with the same sample again and again
    gauge_lost: bool = False
    barometer_lost: bool = False
    thermometer_lost: bool = False
    gauge_offset_pa: float = 0.0  # the gauge reads this much too much
    gauge_stuck: bool = False  # it repeats its value
    open_interlocks: int = 0  # bit i: the circuit of the board's interlock input i is open
    silent: bool = False  # requests are carried out and not answered
    unreachable: bool = False  # there is no connection
    lost_every: int = 0  # every n-th request gets no answer; 0: none is lost
    readback_fraction: float = math.nan  # the pump's read-back, whatever its command
    pump_share: float = 1.0  # how much of its flow the pump still gives
    pump_stuck_fraction: float = math.nan  # where it stays, whatever the board commands
    vent_stuck_fraction: float = math.nan
    stalled: bool = False  # the control process does not run: stopped, hung, or starved
    late_ms: float = 0.0  # every tick starts so late
    dead_task: bool = False  # a task of the control process has ended
    camera_lost: bool = False  # no shape arrives
    camera_offset_um: float = 0.0  # shapes show this much more sag


class VirtualBench:
    """Plant and board, advanced together; the methods of `roles.Bench`, without waiting.

    Parameters
    ----------
    plant : Plant
        The mirror.
    watchdog_s : float
        Time without a command after which the board stops the pump.
    stored : StoredSettings or None
        Settings that the board keeps without power; None: those of a new board.
    interlocks : VirtualInterlocks or None
        The configured circuits; None: none.

    Attributes
    ----------
    wrong : Wrong
        Switches of what is wrong with the bench.
    truth : Truth
        The true state when the board last took its sample, or would have.
    """

    def __init__(
        self,
        plant: Plant,
        watchdog_s: float = 0.5,
        stored: pump_board.StoredSettings | None = None,
        interlocks: VirtualInterlocks | None = None,
    ) -> None:
        self.plant = plant
        self.wrong = Wrong()
        self.interlocks = interlocks or VirtualInterlocks()
        self._sample = self._sample_sensors(None)
        self.board = pump_board.BoardState(
            register_map.load_default_map(), self._sample, stored or pump_board.StoredSettings()
        )
        self._driver = PumpBoard("", watchdog_s=watchdog_s, link=MemoryLink(self))

    def advance(self, duration_s: float) -> None:
        """Let time pass: the plant moves, the board samples it, judges it and drives it."""
        self.plant.advance(duration_s)
        self.interlocks.advance(self.plant.time_s)
        self._sample = self._sample_sensors(self._sample)
        self.board.advance(self.plant.time_s, self._sample)
        self.drive_actuators()

    def drive_actuators(self) -> None:
        """Drive the actuators as the board commands, as far as they follow."""
        wrong = self.wrong
        pump = self.board.pump_fraction * wrong.pump_share
        if not math.isnan(wrong.pump_stuck_fraction):
            pump = wrong.pump_stuck_fraction
        vent = self.board.vent_fraction
        if not math.isnan(wrong.vent_stuck_fraction):
            vent = wrong.vent_stuck_fraction
        self.plant.actuate(pump, vent)

    def power_cycle(self) -> None:
        """The board restarts: outputs off, watchdog off, faults lost."""
        self.board.restart()
        self.drive_actuators()

    def open(self) -> roles.BenchIdentity:
        """Connect and arm. Raises LinkError."""
        return at_once(self._driver.open())

    def read(self) -> roles.BenchReading:
        """One sample. Raises LinkError."""
        reading = at_once(self._driver.read())
        interlocks_open = self.interlocks.open_mask(reading.interlock_inputs, self.plant.time_s)
        # Instruments beside the board, which has no registers for the climate
        sample = self._sample
        pump_fraction = reading.pump_fraction
        if not math.isnan(self.wrong.readback_fraction):
            pump_fraction = self.wrong.readback_fraction
        return replace(
            reading,
            pump_fraction=pump_fraction,
            interlocks_open=interlocks_open,
            film_temperature_c=sample.film_temperature_c,
            ring_temperature_c=sample.ring_temperature_c,
            humidity_percent=sample.humidity_percent,
        )

    def write(self, command: roles.BenchCommand) -> None:
        """Write pump and vent, and feed the watchdog. Raises LinkError."""
        at_once(self._driver.write(command))

    def clear_faults(self, mask: int) -> None:
        """Clear these bits of the board's latched faults. Raises LinkError."""
        at_once(self._driver.clear_faults(mask))

    def close(self) -> None:
        """Disarm if the board allows it, and disconnect."""
        at_once(self._driver.close())

    def _sample_sensors(self, last: pump_board.BoardSample | None) -> pump_board.BoardSample:
        wrong = self.wrong
        self.truth = self.plant.truth()
        if wrong.samples_frozen and last is not None:
            return last
        sample = self.plant.sample_of(self.truth)
        displacement_um = sample.displacement_um + wrong.laser_offset_um
        quality = sample.displacement_quality
        if wrong.laser_stuck and last is not None:
            displacement_um = last.displacement_um
        if wrong.no_light:
            displacement_um = math.nan
            quality = _LASER_NO_LIGHT
        gauge_pa = sample.gauge_pressure_pa + wrong.gauge_offset_pa
        if wrong.gauge_stuck and last is not None:
            gauge_pa = last.gauge_pressure_pa
        if wrong.gauge_lost:
            gauge_pa = math.nan
        closed = sample.interlock_inputs & ~int(wrong.open_interlocks)
        return replace(
            sample,
            displacement_um=displacement_um,
            displacement_quality=quality,
            gauge_pressure_pa=gauge_pa,
            ambient_pressure_pa=math.nan if wrong.barometer_lost else sample.ambient_pressure_pa,
            air_temperature_c=math.nan if wrong.thermometer_lost else sample.air_temperature_c,
            interlock_inputs=self.interlocks.board_word(closed),
        )


class MemoryLink:
    """A `ModbusLink` that ends at a board in memory: requests take no time."""

    name = "virtual board"

    def __init__(self, bench: VirtualBench) -> None:
        self._bench = bench
        self._requests = 0
        self.connected = False

    async def connect(self) -> None:
        """Connect; raises LinkDownError while a scenario makes the board unreachable."""
        if self._bench.wrong.unreachable:
            raise roles.LinkDownError(f"{self.name}: no connection")
        self.connected = True

    async def read_holding(self, address: int, count: int) -> list[int]:
        """Read registers of the board, as `ModbusLink.read_holding`.

        Parameters
        ----------
        address, count : int
            First register, and number of registers.

        Raises
        ------
        LinkError
            The board refuses; while a scenario cuts the link, there is no answer.
        """
        self._begin()
        with _raise_refusals(self.name):
            words = self._bench.board.read(address, count)
        self._answer()
        return words

    async def read_input(self, address: int, count: int) -> list[int]:
        """Read input registers: the board has the same ones as `read_holding`.

        Parameters
        ----------
        address, count
            As for `read_holding`.
        """
        return await self.read_holding(address, count)

    async def write_register(self, address: int, word: int) -> None:
        """Write one register, as `write_registers`.

        Parameters
        ----------
        address, word : int
            Register, and its 16 bits.
        """
        await self.write_registers(address, [word])

    async def write_registers(self, address: int, words: Sequence[int]) -> None:
        """Write registers of the board, and drive pump and vent as the board then does.

        Parameters
        ----------
        address : int
            First register.
        words : sequence of int
            16 bits for each register.

        Raises
        ------
        LinkError
            As `read_holding`.
        """
        self._begin()
        with _raise_refusals(self.name):
            self._bench.board.write(address, words)
        self._bench.drive_actuators()
        self._answer()

    async def close(self) -> None:
        """Disconnect."""
        self.connected = False

    def _begin(self) -> None:
        if not self.connected or self._bench.wrong.unreachable:
            self.connected = False
            raise roles.LinkDownError(f"{self.name}: the connection is gone")

    def _answer(self) -> None:
        wrong = self._bench.wrong
        self._requests += 1
        if wrong.silent or (wrong.lost_every and self._requests % wrong.lost_every == 0):
            raise roles.LinkError(f"{self.name}: no answer")


@contextlib.contextmanager
def _raise_refusals(name: str) -> Iterator[None]:
    """A refusal of the board, as the link's error."""
    try:
        yield
    except modbus_pdu.RegisterRefusal as refusal:
        raise exception_error(name, refusal.code) from None


def at_once(coroutine: Coroutine[Any, Any, T]) -> T:
    """The result of a coroutine that waits for nothing. Raises what it raises."""
    try:
        coroutine.send(None)
    except StopIteration as end:
        result: T = end.value
        return result
    raise AssertionError("a link in memory waited")
