"""The run's clock, with real waiting."""

import time
from dataclasses import dataclass

from membrane_ctrl.model.clock import RunClock


@dataclass(frozen=True, slots=True)
class WaitingClock:
    """The run's clock, with real waiting."""

    run: RunClock

    def now(self) -> float:
        """Seconds since the run's start."""
        return self.run.now()

    def sleep(self, duration_s: float) -> None:
        """Wait."""
        time.sleep(duration_s)
