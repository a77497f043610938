"""Turns the rows and events of a run into alarm messages."""

import json
import math
from collections.abc import Sequence

from membrane_ctrl.alarms.book import AlarmBook, SentMessage, Sign, sign_of_value, signs_of
from membrane_ctrl.alarms.outbox import Outbox
from membrane_ctrl.config.alarms import AlarmsConfig
from membrane_ctrl.model import event_lines, port_events
from membrane_ctrl.model.events import CommandTaken, EventLine
from membrane_ctrl.model.run_status import RunStatus
from membrane_ctrl.model.telemetry import TelemetryRow

# before its first tick a run connects its devices, with time-outs of its own
_STARTS_S = 30.0


class Watcher:
    """Turns rows and events into alarm messages.

    Parameters
    ----------
    config : AlarmsConfig
        Rules, and the times of escalation, reminders and silence.
    outboxes : sequence of Outbox
        The first gets all messages, the second (if there is one) only the escalated ones.
    now_s : float
        Second of the run, as for all methods.

    Attributes
    ----------
    is_sender : bool
        Whether messages go to the outboxes; else it only follows the conditions.
    """

    def __init__(self, config: AlarmsConfig, outboxes: Sequence[Outbox], now_s: float) -> None:
        self.is_sender = True
        self._config = config
        self._book = AlarmBook(config)
        self._outboxes = outboxes
        self._last_row_s = now_s + _STARTS_S
        self._status = RunStatus()
        self._is_orphan = False

    @property
    def has_ended(self) -> bool:
        """The "end" event has arrived."""
        return self._status.ended

    def start_sending(self, sent: Sequence[SentMessage], now_s: float) -> None:
        """Become the sender, after others that have sent messages of this run.

        Parameters
        ----------
        sent : sequence of SentMessage
            Those of the others.
        now_s : float
            Second of the run.
        """
        self.is_sender = True
        self._book.adopt_sent(sent, now_s)

    def process_news(self, rows: Sequence[bytes], events: Sequence[bytes], now_s: float) -> None:
        """Take rows and events, and send due messages.

        Parameters
        ----------
        rows, events : sequence of bytes
            As they were in the rings.
        now_s : float
            Second of the run.
        """
        self.take_news(rows, events, now_s)
        self.send_due(now_s)

    def take_news(self, rows: Sequence[bytes], events: Sequence[bytes], now_s: float) -> None:
        """Take the newest rows and events of the run.

        Parameters
        ----------
        rows : sequence of bytes
            Packed telemetry rows, in order.
        events : sequence of bytes
            Events as JSON, in order.
        now_s : float
            Second of the run.
        """
        for message in events:
            self._take_event(json.loads(message), now_s)
        for row in rows:
            self._take_row(row, now_s)
        self._judge_silence(bool(rows), now_s)

    def note_orphan(self, now_s: float) -> None:
        """Note that the control process ended without an "end" event."""
        text = (
            "the control process ended without a report: look whether the pump runs. A board's "
            "watchdog stops its pump; on a bench of single instruments the last flow continues "
            "until `membrane-ctrl safe` runs"
        )
        self._is_orphan = True
        self._book.take_sign(Sign("silent", False), now_s)
        self._book.take_sign(Sign("control_gone", True, "critical", text), now_s)

    def send_due(self, now_s: float) -> None:
        """Send the messages that are due, if this process is the sender."""
        if not self.is_sender:
            return
        for message in self._book.step(now_s):
            for outbox in self._outboxes[: 2 if message.escalated else 1]:
                outbox.queue_message(message)
        for outbox in self._outboxes:
            outbox.step(now_s)

    def _take_event(self, line: EventLine, now_s: float) -> None:
        event = event_lines.from_dict(line)
        condition_s = line.get("mono_s")
        signs = signs_of(
            event.notice_changes(self._status.notices),
            float(condition_s) if isinstance(condition_s, int | float) else math.nan,
        )
        self._status = self._status.after_event(event)
        match event:
            case port_events.AlarmsAcknowledged() | CommandTaken(command="ack"):
                # the person who sends `ack` has seen the alarms, even if the hold refuses
                self._book.acknowledge_all(now_s)
        for sign in signs:
            self._book.take_sign(sign, now_s)

    def _take_row(self, message: bytes, now_s: float) -> None:
        row = TelemetryRow.unpack(message)
        for rule in self._config.rules:
            sign = sign_of_value(rule, getattr(row, rule.field), self._book.is_standing(rule.name))
            if sign is not None:
                self._book.take_sign(sign, now_s)

    def _judge_silence(self, has_rows: bool, now_s: float) -> None:
        is_over = self.has_ended or self._is_orphan
        if has_rows:
            self._last_row_s = now_s
            self._book.take_sign(Sign("silent", False), now_s)
        elif now_s - self._last_row_s >= self._config.silent_s and not is_over:
            text = f"no tick for {self._config.silent_s:g} s: the control process hangs"
            self._book.take_sign(Sign("silent", True, "critical", text), now_s)
