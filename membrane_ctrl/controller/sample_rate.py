"""Notice that the displacement has fewer new samples than the loop has ticks. Pure."""

import math
from dataclasses import dataclass

from membrane_ctrl.model.events import Event, Maintenance, MaintenanceOver
from membrane_ctrl.model.state_tree import Count, StateNode

NOTICE = "few_samples"
# Share of the ticks with a new sample: below the first it is reported, above the second it is over.
FRESH_SHARE_LEAST = 0.9
_FRESH_SHARE_AGAIN = 0.95
_WINDOW_S = 10.0


@dataclass(slots=True)
class SampleRateState(StateNode):
    """Ticks with an answer, and those with a new sample, since a time."""

    since_s: float = math.nan
    answers: Count = 0
    samples: Count = 0
    reported: bool = False


class SampleRate:
    """Counts new samples among the answers, in windows of ten seconds."""

    def __init__(self, memory: SampleRateState | None = None) -> None:
        self.memory = memory or SampleRateState()

    def step(self, now_s: float, answered: bool, fresh: bool) -> list[Event]:
        """Count one tick; returns the notice, or its end, after a window that shows it.

        Parameters
        ----------
        now_s : float
            Time of the tick.
        answered : bool
            The device answered, and its samples advance: a fault reports it otherwise.
        fresh : bool
            The answer has a sample that no tick had before.
        """
        # A window without any answer lasts until there is one: it shows nothing of the samples
        memory = self.memory
        if math.isnan(memory.since_s):
            memory.since_s = now_s
        memory.answers += answered
        memory.samples += answered and fresh
        window_s = now_s - memory.since_s
        if window_s < _WINDOW_S or not memory.answers:
            return []
        share = memory.samples / memory.answers
        rates_hz = (memory.samples / window_s, memory.answers / window_s)
        memory.since_s = now_s
        memory.answers = 0
        memory.samples = 0
        return self._report(share, *rates_hz)

    def _report(self, share: float, samples_hz: float, answers_hz: float) -> list[Event]:
        rates = f"{samples_hz:.0f} new samples a second in {answers_hz:.0f} answers"
        if not self.memory.reported and share < FRESH_SHARE_LEAST:
            self.memory.reported = True
            message = (
                f"the displacement has {rates}; the loop acts on new samples only. Lower "
                f"loop.rate_hz to {samples_hz:.0f}, or raise the rate of the sensor"
            )
            return [Maintenance(NOTICE, message)]
        if self.memory.reported and share >= _FRESH_SHARE_AGAIN:
            self.memory.reported = False
            return [MaintenanceOver(NOTICE, f"the displacement has {rates}")]
        return []
