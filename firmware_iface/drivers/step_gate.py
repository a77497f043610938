"""Whether a reading can be believed that carries no checksum: it has to be near one of the two before it."""

from __future__ import annotations


class StepGate:
    """Passes a value within `step` of either of the last two, passed or not.

    A hit reading is alone and is stopped; the good one after it still has the good one before. A true step is stopped
    once and passes with its second reading. The first value of all has no witness and is stopped.
    """

    def __init__(self, step: float) -> None:
        self._step = step
        self._before: tuple[float, ...] = ()

    def passes(self, value: float) -> bool:
        """Whether to believe it; it is remembered either way."""
        near = any(abs(value - before) <= self._step for before in self._before)
        self._before = (value, *self._before[:1])
        return near
