"""Sends the alarms of one run while this process is their sender."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

from membrane_ctrl.alarms.book import ESCALATION, LAB, AlarmMessage
from membrane_ctrl.alarms.outbox import Outbox, Send
from membrane_ctrl.alarms.sent_log import SentLog
from membrane_ctrl.alarms.watcher import Watcher
from membrane_ctrl.config.alarms import AlarmsConfig


class RunAlarms:
    """Follows a run, and sends its alarms while no other process does.

    Parameters
    ----------
    config : AlarmsConfig
        Rules, and the times of escalation and reminders.
    sent_log : SentLog
        Of the run's folder.
    senders : sequence of callable
        For all messages, and for the escalated ones.
    patience_s : float
        Time without a sender after which this process becomes the sender.
    now : callable
        Seconds of the run.
    """

    def __init__(
        self,
        config: AlarmsConfig,
        sent_log: SentLog,
        senders: Sequence[Send],
        patience_s: float,
        now: Callable[[], float],
    ) -> None:
        self._log = sent_log
        self._patience_s = patience_s
        self._now = now
        self._alone_since_s = math.nan
        self._outboxes = [
            Outbox(partial(self._send_once, send, to))
            for send, to in zip(senders, (LAB, ESCALATION), strict=False)
        ]
        self._watcher = Watcher(config, self._outboxes, now())
        self._watcher.is_sender = False

    @property
    def has_ended(self) -> bool:
        """Whether the run has ended by itself, with an event that states it."""
        return self._watcher.has_ended

    @property
    def is_done(self) -> bool:
        """Whether another process sends, or everything that was due is sent."""
        if not self._watcher.is_sender:
            return self._log.has_sender()
        return all(outbox.is_empty for outbox in self._outboxes)

    def process_news(self, rows: Sequence[bytes], events: Sequence[bytes]) -> None:
        """Take rows and events; send what is due.

        Parameters
        ----------
        rows : sequence of bytes
            Packed telemetry rows since the last call, in order.
        events : sequence of bytes
            Events since the last call as JSON, in order.
        """
        self._watcher.take_news(rows, events, self._now())
        self.send_due()

    def report_orphan(self) -> None:
        """Report that the control process ended without an "end" event."""
        self._watcher.note_orphan(self._now())
        self.send_due()

    def send_due(self) -> None:
        """Send what is due, if this process is the sender; nothing is new."""
        self._choose_sender()
        self._watcher.send_due(self._now())

    def end_patience(self) -> None:
        """From now on, become the sender as soon as there is none: the run is over."""
        self._patience_s = 0.0

    def _choose_sender(self) -> None:
        """Become the sender if there has been none for long enough; stop if another is."""
        # Two processes watch one run: the service and the hold's own alarm process. The log decides
        # which of them sends. The one that waits follows all conditions, so that it can take over
        # with the messages that are due, and without those that were sent.
        if self._watcher.is_sender:
            self._watcher.is_sender = self._log.is_sender()
            if self._watcher.is_sender:
                self._log.note_work()
            return
        now_s = self._now()
        if self._log.has_sender():
            self._alone_since_s = math.nan
            return
        if math.isnan(self._alone_since_s):
            self._alone_since_s = now_s
        if now_s - self._alone_since_s >= self._patience_s:
            self._log.become_sender()
            self._watcher.start_sending(self._log.read_sent(), now_s)

    def _send_once(self, send: Send, to: str, message: AlarmMessage) -> bool:
        """Send a message unless another process has sent it, or has become the sender."""
        if self._log.was_sent(message, to):
            return True
        if not self._log.is_sender():
            return False
        self._log.note_work()
        at_s = self._now()
        accepted = send(message)
        self._log.note_attempt(message, to, at_s, accepted)
        return accepted
