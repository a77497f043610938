"""The contract of an experiment: one sample in, one flow out, without clock and I/O.

The caller runs `step` once per tick and returns the mirror to the loop on `Finished`. Every
experiment runs inside an `excursion_guard.ExcursionGuard`, which ends it before the mirror exceeds
its permitted excursion.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

from membrane_ctrl.model.state_tree import StateNode


@dataclass(frozen=True, slots=True)
class BenchSample:
    """One sample of the bench; NaN for missing and lost values."""

    displacement_um: float
    ambient_pressure_pa: float = float("nan")
    air_temperature_c: float = float("nan")


class ExperimentEnd(StrEnum):
    """How an experiment ended."""

    COMPLETED = "completed"
    STOPPED_BY_GUARD = "stopped_by_guard"  # the mirror moved too far
    NO_RESPONSE = "no_response"  # the mirror did not move
    READING_LOST = "reading_lost"
    OVERDUE = "overdue"
    INTERRUPTED = "interrupted"  # by a person, the safety table or another state


@dataclass(frozen=True, slots=True)
class Finished(StateNode):
    """The end of an experiment, with a reason and a remedy for people."""

    end: ExperimentEnd
    reason: str

    @property
    def completed(self) -> bool:
        """Whether it ran as long as it was meant to."""
        return self.end is ExperimentEnd.COMPLETED


class Experiment(Protocol):
    """A step machine."""

    def step(self, measurement: BenchSample, dt_s: float) -> float | Finished:
        """Run one tick.

        Parameters
        ----------
        measurement : BenchSample
            The reading; NaN for a lost one.
        dt_s : float
            Time since the last one.

        Returns
        -------
        float or Finished
            Flow in µm/s until the next reading, or the end with its reason.
        """
