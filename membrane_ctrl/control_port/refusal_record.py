"""Records refused requests at a bounded rate."""

from collections.abc import Callable

from membrane_ctrl.model import events, port_events

# Refusals are recorded, but cannot fill the record: ten mistakes all appear; of a flood, one in ten
# seconds, with the count of the others
_REFUSAL_BURST = 10.0
_REFUSALS_PER_S = 0.1


class Refusals:
    """Records refusals at the rate of a token bucket; `count` counts all."""

    def __init__(
        self, record_event: Callable[[events.Event], None], now: Callable[[], float]
    ) -> None:
        self._record_event = record_event
        self._now = now
        self._tokens = _REFUSAL_BURST
        self._since_s = now()
        self._unrecorded = 0
        self.count = 0

    def record(self, who: str, command: str, reason: str, why: str = "") -> None:
        """Count a refusal, and record it if the rate allows.

        Parameters
        ----------
        who : str
            The sender, or the peer of the connection.
        command : str
            Empty if the request could not be read.
        reason : str
            Why it was refused, within a sentence.
        why : str
            The sender's own reason for the request.
        """
        self.count += 1
        now_s = self._now()
        self._tokens = min(_REFUSAL_BURST, self._tokens + _REFUSALS_PER_S * (now_s - self._since_s))
        self._since_s = now_s
        if self._tokens < 1.0:
            self._unrecorded += 1
            return
        self._tokens -= 1.0
        self._record_event(
            port_events.Refused(who, command, why, reason, and_unrecorded=self._unrecorded or None)
        )
        self._unrecorded = 0
