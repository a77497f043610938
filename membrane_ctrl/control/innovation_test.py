"""Tests whether the innovations of an estimate are as a right model predicts. Pure.

Those of a right model are white and have variance 1. The sum of n of them then has the variance n;
innovations that are correlated with each other have more.
"""

import math
from dataclasses import dataclass

from membrane_ctrl.control.filters import lag_step_fraction
from membrane_ctrl.model.state_tree import Count, StateNode

_BLOCK_S = 1.0
_MEMORY_S = 120.0
_BLOCKS_LEAST = 30
# The mean of some hundred squares scatters by 0.14 about 1 if the innovations are white.
_CORRELATED = 1.8
_TOO_LARGE = 1.5


@dataclass(slots=True)
class InnovationTestState(StateNode):
    """Sums of the present block, and means over the last minutes.

    Attributes
    ----------
    block_s, total, squares, count
        Duration, sum, sum of squares and number of the block's innovations.
    blocks : int
        Since the start.
    variance, correlation : float
        Mean square of the innovations, and that of the blocks' sums over their number.
    """

    block_s: float = 0.0
    total: float = 0.0
    squares: float = 0.0
    count: Count = 0
    blocks: Count = 0
    variance: float = 1.0
    correlation: float = 1.0


class InnovationTest:
    """Variance and correlation of a sensor's innovations in the last two minutes."""

    def __init__(self, memory: InnovationTestState | None = None) -> None:
        self.memory = memory or InnovationTestState()

    def step(self, innovation: float, dt_s: float) -> None:
        """Add a tick.

        Parameters
        ----------
        innovation : float
            In standard deviations; NaN for a tick without one.
        dt_s : float
            Time since the last tick.
        """
        memory = self.memory
        memory.block_s += dt_s
        if math.isfinite(innovation):
            memory.total += innovation
            memory.squares += innovation**2
            memory.count += 1
        if memory.block_s < _BLOCK_S - 1e-9 or memory.count == 0:
            return
        # The variance of a block's sum over n is that of one innovation if they are white, and
        # larger if neighbours have one sign. At first a plain mean, then a fading one
        memory.blocks += 1
        share = max(lag_step_fraction(memory.block_s, _MEMORY_S), 1.0 / memory.blocks)
        memory.variance += share * (memory.squares / memory.count - memory.variance)
        memory.correlation += share * (memory.total**2 / memory.count - memory.correlation)
        memory.block_s = memory.total = memory.squares = 0.0
        memory.count = 0

    def describe(self) -> str:
        """What the innovations show, as a phrase."""
        memory = self.memory
        if memory.blocks < _BLOCKS_LEAST:
            return "the cause is not known"
        if memory.correlation > _CORRELATED * memory.variance:
            return (
                "its innovations are correlated: it looks like another curve, dead time or lag of "
                "the pump, or like weather that no sensor shows"
            )
        if memory.variance > _TOO_LARGE:
            return "its innovations are larger than predicted: it looks like a noisier laser"
        return "its innovations are as predicted, and the cause is not known"
