"""One clock through all code: seconds since the run's start on the system's monotonic axis.

CLOCK_MONOTONIC is one axis for all processes of a machine, so a clock made from the same origin
reads the same everywhere. UTC is read once at the start: a stepped wall clock has no effect.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta


@dataclass(frozen=True, slots=True)
class RunClock:
    """The run's time axis; picklable, so that every process of the run has the same."""

    origin_mono_s: float  # `time.monotonic()` at the start of the run
    origin_utc: datetime  # UTC at that moment

    @classmethod
    def start(cls) -> RunClock:
        """A clock that reads 0 now."""
        return cls(time.monotonic(), datetime.now(UTC))

    def now(self) -> float:
        """Seconds since the run's start."""
        return time.monotonic() - self.origin_mono_s

    def utc(self, mono_s: float) -> datetime:
        """UTC of a moment on the run's axis."""
        return self.origin_utc + timedelta(seconds=mono_s)
