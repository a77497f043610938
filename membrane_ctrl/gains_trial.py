"""Gains on trial: they go back to the last good ones unless somebody says in time that they may stay.

The one who tries them may lose its connection or be killed; the loop must then not be left with gains that nobody
has verified (docs/decisions/78-gains-on-trial.md).
"""

from __future__ import annotations

import math

from membrane_ctrl.config import LoopConfig


class GainsTrial:
    """Remembers the last good gains.

    Parameters
    ----------
    loop : LoopConfig
        The gains that a run begins with are good.
    """

    def __init__(self, loop: LoopConfig) -> None:
        self._good = self._tried = loop
        self._until_s = math.nan

    @property
    def on_trial(self) -> bool:
        """The present gains have not been kept yet."""
        return math.isfinite(self._until_s)

    def begin(self, loop: LoopConfig, now_s: float, trial_s: float) -> None:
        """New gains: for `trial_s` seconds unless kept, or for good if that is NaN."""
        self._tried = loop
        self._until_s = now_s + trial_s
        if not self.on_trial:
            self._good = loop

    def keep(self) -> None:
        """The present gains are good."""
        self._good, self._until_s = self._tried, math.nan

    def overdue(self, now_s: float) -> bool:
        """Nobody has kept them in time."""
        return now_s >= self._until_s

    def revert(self) -> LoopConfig:
        """The last good gains, which are the present ones from now on."""
        self._tried, self._until_s = self._good, math.nan
        return self._good
