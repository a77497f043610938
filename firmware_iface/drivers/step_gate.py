"""A reading without a checksum is accepted only near one of the two before it."""


class StepGate:
    """Passes a value within `step` of either of the last two, passed or not.

    A corrupted reading stands alone and is stopped; the good one after it still has the good one
    before. A true step is stopped once and passes with its second reading. Nothing confirms the
    very first value, so it is stopped.
    """

    def __init__(self, step: float) -> None:
        self._step = step
        self._before: tuple[float, ...] = ()

    def passes(self, value: float) -> bool:
        """Whether to accept the value; it is remembered either way."""
        near = any(abs(value - before) <= self._step for before in self._before)
        self._before = (value, *self._before[:1])
        return near
