"""Compares how well two loops hold the mirror, by readings of the same laser. Pure.

The readings of a short block are averaged, so that their noise is small. The mean square of a block
is that of the centre's error, plus the noise of the mean, which the differences of successive
readings show and which is subtracted. It is the same noise for both loops, and the same weather:
their difference is known far better than either of them.
"""

import math
from collections import deque
from dataclasses import dataclass, field

from membrane_ctrl.model.state_tree import Count, StateNode

_BLOCK_S = 0.2
_BLOCK_READINGS = 4
# Blocks are averaged over so long that successive averages are independent of each other.
_SPAN_S = 5.0
_SPANS_MOST = 24
_SPANS_LEAST = 8


@dataclass(slots=True)
class LoopComparisonState(StateNode):
    """Sums of the present block and span, and the last spans."""

    block_s: float = 0.0
    readings: Count = 0
    own_um: float = 0.0
    other_um: float = 0.0
    last_um: float = math.nan
    steps_um2: float = 0.0
    steps: Count = 0
    span_s: float = 0.0
    blocks: Count = 0
    own_um2: float = 0.0
    difference_um2: float = 0.0
    own_spans_um2: deque[float] = field(default_factory=deque)
    difference_spans_um2: deque[float] = field(default_factory=deque)


@dataclass(frozen=True, slots=True)
class MeanSquare(StateNode):
    """A mean square of errors and its standard deviation, µm²."""

    um2: float
    sigma_um2: float


@dataclass(frozen=True, slots=True)
class LoopErrors(StateNode):
    """Errors of the centre.

    Attributes
    ----------
    own : MeanSquare
        Of the loop that holds the mirror.
    excess : MeanSquare
        By how much that exceeds the other loop's, in the same weather.
    """

    own: MeanSquare
    excess: MeanSquare


class LoopComparison:
    """Errors of the loop that holds the mirror, and of another one, over the last two minutes."""

    def __init__(self, memory: LoopComparisonState | None = None) -> None:
        self.memory = memory or LoopComparisonState()

    def reset(self) -> None:
        """Forget everything."""
        self.memory.start_afresh()

    def skip(self) -> None:
        """Drop the span that has begun: its readings show a disturbance that passes."""
        memory = self.memory
        self._begin_block()
        memory.span_s = memory.own_um2 = memory.difference_um2 = 0.0
        memory.blocks = 0

    def step(self, own_um: float, other_um: float, dt_s: float) -> None:
        """Add a reading.

        Parameters
        ----------
        own_um, other_um : float
            Distance from the setpoint under the present and under the other loop; NaN without a
            reading.
        dt_s : float
            Time since the last one.
        """
        memory = self.memory
        memory.block_s += dt_s
        if math.isfinite(own_um) and math.isfinite(other_um):
            if math.isfinite(memory.last_um):
                memory.steps_um2 += (own_um - memory.last_um) ** 2
                memory.steps += 1
            memory.last_um = own_um
            memory.readings += 1
            memory.own_um += own_um
            memory.other_um += other_um
        if memory.block_s >= _BLOCK_S - 1e-9 and memory.readings >= _BLOCK_READINGS:
            self._end_block()

    def _end_block(self) -> None:
        """Take the means of a block into the present span, and a full span into the comparison."""
        memory = self.memory
        # Mean errors of the block; differences of successive readings show the noise in them.
        own_um, other_um = memory.own_um / memory.readings, memory.other_um / memory.readings
        noise_um2 = memory.steps_um2 / (2 * memory.steps * memory.readings)
        memory.own_um2 += own_um**2 - noise_um2
        memory.difference_um2 += own_um**2 - other_um**2
        memory.blocks += 1
        memory.span_s += memory.block_s
        self._begin_block()
        # Several blocks are a span, whose mean squares are compared.
        if memory.span_s >= _SPAN_S:
            _append(memory.own_spans_um2, memory.own_um2 / memory.blocks)
            _append(memory.difference_spans_um2, memory.difference_um2 / memory.blocks)
            memory.span_s = memory.own_um2 = memory.difference_um2 = 0.0
            memory.blocks = 0

    def _begin_block(self) -> None:
        memory = self.memory
        memory.block_s = memory.own_um = memory.other_um = memory.steps_um2 = 0.0
        memory.readings = memory.steps = 0
        memory.last_um = math.nan

    @property
    def spans(self) -> int:
        """Number of spans in the comparison."""
        return len(self.memory.own_spans_um2)

    @property
    def errors(self) -> LoopErrors | None:
        """The comparison; None while it is too short."""
        if self.spans < _SPANS_LEAST:
            return None
        return LoopErrors(
            _find_mean(self.memory.own_spans_um2), _find_mean(self.memory.difference_spans_um2)
        )


def _find_mean(spans_um2: deque[float]) -> MeanSquare:
    """Mean over spans, and its error by their scatter."""
    count = len(spans_um2)
    mean_um2 = sum(spans_um2) / count
    spread_um4 = sum((each - mean_um2) ** 2 for each in spans_um2) / (count - 1)
    return MeanSquare(mean_um2, math.sqrt(spread_um4 / count))


def _append(spans: deque[float], value: float) -> None:
    spans.append(value)
    if len(spans) > _SPANS_MOST:
        spans.popleft()
