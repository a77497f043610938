"""Does the pump stand still when it is commanded off? Pure.

A pump that still runs shows in its read-back or, if that is wrong, in a mirror that rises although
gas can only leak out. Warmer gas and a falling barometer lift the mirror too; both are measured and
allowed for.
"""

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

from firmware_iface.roles import BenchReading
from membrane_ctrl.config.schema import LoopConfig, StatesConfig
from membrane_ctrl.model.state_tree import Count, StateNode

# A flow controller's zero and a tachometer's last count are below this; no pump moves gas below 0.1
OFF_FRACTION = 0.02
# Readings are averaged over blocks, which leaves 0.2 µm and 0.1 Pa of noise at 50 Hz
_BLOCK_S = 0.5
# A block is compared with the one 20 s before. In 12 h of the twin with the pump off, gusty weather
# and films that lose no gas, the mirror rose by at most 11.4 µm (0.74 Pa); a pump at half of its
# range lifts it by
# 44 µm (3.6 Pa)
_WINDOW_S = 20.0
_RISE_MAX_UM = 30.0
_PA_PER_UM = 0.05  # 3p/s is 0.065 Pa/um at the working point; less makes the gauge the slower check
# The gas follows the air within 12 s: a change up to 40 s before the window still moves the mirror
# in it
_WEATHER_BLOCKS = 120
# The end of a run waits for this many blocks without a rise as steep as a pump's: 3 µm/s (weather:
# 2.2 µm/s)
_REST_BLOCKS = 5
_REST_RISE_MAX_UM = 6.0


@dataclass(frozen=True, slots=True)
class PressureBlock(StateNode):
    """Means over a block, NaN without a value."""

    end_s: float
    displacement_um: float
    gauge_pressure_pa: float
    ambient_pressure_pa: float
    air_temperature_c: float


@dataclass(slots=True)
class RunningMean(StateNode):
    """The mean of a block so far."""

    total: float = 0.0
    count: Count = 0

    def add(self, value: float) -> None:
        """Add a value, ignoring one that is not finite."""
        if math.isfinite(value):
            self.total += value
            self.count += 1

    @property
    def mean(self) -> float:
        """The mean; NaN without a value."""
        return self.total / self.count if self.count else math.nan


@dataclass(slots=True)
class OpenBlock(StateNode):
    """The block that is being filled."""

    ends_s: float = math.nan  # NaN: it begins with the next reading
    displacement_um: RunningMean = field(default_factory=RunningMean)
    gauge_pressure_pa: RunningMean = field(default_factory=RunningMean)
    ambient_pressure_pa: RunningMean = field(default_factory=RunningMean)
    air_temperature_c: RunningMean = field(default_factory=RunningMean)


@dataclass(slots=True)
class StandstillState(StateNode):
    """What was observed of the pump since it was commanded off."""

    blocks: deque[PressureBlock] = field(default_factory=deque)
    open_block: OpenBlock = field(default_factory=OpenBlock)
    on_since_s: float = math.nan  # the read-back of a pump that should have stopped
    read_s: float = math.nan  # the last reading
    seen_off: bool = False
    runs_on: str = ""
    inflow: str = ""
    silent_s: float = 0.0


class Standstill:
    """Observations of the pump since it was commanded off."""

    def __init__(
        self, loop: LoopConfig, states: StatesConfig, memory: StandstillState | None = None
    ) -> None:
        self._loop = loop
        self._states = states
        self.memory = memory or StandstillState()

    @property
    def seen_off(self) -> bool:
        """The newest reading, taken after a command of 0, shows the pump at rest."""
        return self.memory.seen_off

    @property
    def runs_on(self) -> str:
        """The read-back of a pump that should have stopped; empty if all is well."""
        return self.memory.runs_on

    @property
    def inflow(self) -> str:
        """Rise of the mirror although the pump is commanded off; empty if there is none."""
        return self.memory.inflow

    @property
    def silent_s(self) -> float:
        """Time since the last reading."""
        return self.memory.silent_s

    @property
    def at_rest(self) -> bool:
        """The read-back shows the pump at rest, and for two seconds the mirror has not risen as if
        pumped.
        """
        blocks = self.memory.blocks
        if not self.memory.seen_off or len(blocks) < _REST_BLOCKS:
            return False
        rise_um = blocks[-1].displacement_um - blocks[-_REST_BLOCKS].displacement_um
        return not rise_um > _REST_RISE_MAX_UM  # without a laser the read-back alone decides

    def observe_reading(
        self,
        now_s: float,
        reading: BenchReading | None,
        commanded: tuple[float, float],
        link_up: bool,
    ) -> None:
        """Note a tick's reading.

        Parameters
        ----------
        now_s : float
            Time of the tick.
        reading : BenchReading or None
            Its read-back of the pump, and its pressure; None in a tick without an answer.
        commanded : (float, float)
            The last two pump commands before it.
        link_up : bool
            Whether the link is up; otherwise commands have not arrived.
        """
        memory = self.memory
        if reading is not None or math.isnan(memory.read_s):
            memory.read_s = now_s
        memory.silent_s = now_s - memory.read_s
        if max(commanded) > 0.0:
            self._forget_observations()
            return
        if not link_up:
            memory.on_since_s = math.nan  # commands sent meanwhile have not arrived
        if reading is None:
            memory.seen_off = False
            return
        self._compare_readback(now_s, reading.pump_fraction)
        self._watch_mirror(now_s, reading)

    def _forget_observations(self) -> None:
        """The pump is commanded on: nothing that was observed counts."""
        memory = self.memory
        memory.blocks.clear()
        if math.isfinite(memory.open_block.ends_s):
            memory.open_block = OpenBlock()
        memory.on_since_s = math.nan
        memory.seen_off = False
        memory.runs_on = ""
        memory.inflow = ""

    def _compare_readback(self, now_s: float, readback: float) -> None:
        memory = self.memory
        memory.seen_off = readback <= OFF_FRACTION  # false for NaN: an unseen pump may run
        if memory.seen_off:
            memory.on_since_s = math.nan
            memory.runs_on = ""
            return
        if math.isnan(memory.on_since_s):
            memory.on_since_s = now_s
        on_s = now_s - memory.on_since_s
        if on_s > self._states.lower_timeout_s:
            memory.runs_on = f"read-back {100.0 * readback:.0f} %, commanded off for {on_s:.1f} s"

    def _watch_mirror(self, now_s: float, reading: BenchReading) -> None:
        """Take a reading into the present block; at the end of the block, look for a rise."""
        memory, block = self.memory, self.memory.open_block
        # Means over a block, of readings without an error code.
        if math.isnan(block.ends_s):
            block.ends_s = now_s + _BLOCK_S
        block.displacement_um.add(
            reading.displacement_um if reading.displacement_quality == 0 else math.nan
        )
        block.gauge_pressure_pa.add(reading.gauge_pressure_pa)
        block.ambient_pressure_pa.add(reading.ambient_pressure_pa)
        block.air_temperature_c.add(reading.air_temperature_c)
        if now_s < block.ends_s:
            return
        # At its end it is compared with earlier ones.
        means = (
            block.displacement_um.mean,
            block.gauge_pressure_pa.mean,
            block.ambient_pressure_pa.mean,
            block.air_temperature_c.mean,
        )
        memory.blocks.append(PressureBlock(now_s, *means))
        if len(memory.blocks) > _WEATHER_BLOCKS:
            memory.blocks.popleft()
        memory.open_block = OpenBlock(now_s + _BLOCK_S)
        memory.inflow = self._find_rise()

    def _find_rise(self) -> str:
        """Rise beyond the weather's in both laser and gauge; if one is missing,
        the other decides.
        """
        # The newest block, and one that is a window older.
        blocks = self.memory.blocks
        last = blocks[-1]
        first = next(
            (block for block in reversed(blocks) if last.end_s - block.end_s >= _WINDOW_S), None
        )
        if first is None:
            return ""
        over_s = last.end_s - first.end_s
        rise_um = last.displacement_um - first.displacement_um
        rise_pa = last.gauge_pressure_pa - first.gauge_pressure_pa
        # What barometer and thermometer explain, as the loop's feed-forward does.
        most_um = (
            _RISE_MAX_UM
            + abs(self._loop.barometer_gain_um_per_pa)
            * _find_range(block.ambient_pressure_pa for block in blocks)
            + abs(self._loop.temperature_gain_um_per_k)
            * _find_range(block.air_temperature_c for block in blocks)
        )
        # Every sensor that is there must show it.
        checks = ((rise_um, most_um), (rise_pa, _PA_PER_UM * most_um))
        rises = [rise > most for rise, most in checks if math.isfinite(rise)]
        if not rises or not all(rises):
            return ""
        return f"{rise_um:+.0f} µm, {rise_pa:+.1f} Pa in {over_s:.0f} s with the pump commanded off"


def _find_range(values: Iterable[float]) -> float:
    """Largest minus smallest; 0 without a sensor."""
    finite = [value for value in values if math.isfinite(value)]
    return max(finite) - min(finite) if finite else 0.0
