"""One look at the run: rings in, notices out."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence

from membrane_ctrl.alarms.book import AlarmBook
from membrane_ctrl.alarms.outbox import Outbox
from membrane_ctrl.alarms.signs import Sign, sign_of_value, signs_of
from membrane_ctrl.port_config import AlarmsConfig
from membrane_ctrl.telemetry import FIELDS
from membrane_ctrl.tick import Event

# before its first tick a run connects its devices, with patience of its own
_STARTS_S = 30.0
_ROW = struct.Struct(f"<{len(FIELDS)}d")


class Watcher:
    """Turns what the rings hold into notices.

    Parameters
    ----------
    config : AlarmsConfig
        Rules and times.
    outboxes : sequence of Outbox
        The first gets every notice; the second, if there is one, those that are escalated.
    now_s : float
        When it begins to look.

    Attributes
    ----------
    ended : bool
        The run has said its last word.
    """

    def __init__(self, config: AlarmsConfig, outboxes: Sequence[Outbox], now_s: float) -> None:
        self._config = config
        self._book = AlarmBook(config)
        self._outboxes = outboxes
        self._last_row_s = now_s + _STARTS_S
        self._fault: Event = {}
        self.ended = False

    def look(self, rows: Sequence[bytes], events: Sequence[bytes], now_s: float) -> None:
        """Take in what came since the last look, and send what is due."""
        for message in events:
            self._take_event(json.loads(message), now_s)
        for row in rows:
            self._take_row(row, now_s)
        self._listen(bool(rows), now_s)
        self._send(now_s)

    def orphaned(self, now_s: float) -> None:
        """The control process is gone, and has not said why."""
        text = "the control process has ended without a word; the board's watchdog has stopped the pump"
        self._book.take(Sign("control_gone", True, "critical", text), now_s)
        self._send(now_s)

    def _take_event(self, event: Event, now_s: float) -> None:
        kind = event.get("kind")
        if kind == "fault":
            self._fault = event
        elif kind == "state" and event.get("state") == "fault" and not self._fault.get("latching"):
            event = self._fault | {"latching": True}  # held on the mean flow for too long, it has latched
        for sign in signs_of(event):
            self._book.take(sign, now_s)
        if kind == "alarms_acknowledged" or (kind == "command" and event.get("command") == "ack"):
            self._book.acknowledge()  # whoever asks for `ack` has seen it, whether it is obeyed or not
        self.ended |= kind == "end"

    def _take_row(self, message: bytes, now_s: float) -> None:
        row = dict(zip(FIELDS, _ROW.unpack(message), strict=True))
        for rule in self._config.rules:
            sign = sign_of_value(rule, row[rule.field], self._book.standing(rule.name))
            if sign is not None:
                self._book.take(sign, now_s)

    def _listen(self, heard: bool, now_s: float) -> None:
        if heard:
            self._last_row_s = now_s
            self._book.take(Sign("silent", False), now_s)
        elif now_s - self._last_row_s >= self._config.silent_s and not self.ended:
            text = f"no tick for {self._config.silent_s:g} s: the control process hangs"
            self._book.take(Sign("silent", True, "critical", text), now_s)

    def _send(self, now_s: float) -> None:
        for notice in self._book.step(now_s):
            for outbox in self._outboxes[: 2 if notice.escalated else 1]:
                outbox.post(notice)
        for outbox in self._outboxes:
            outbox.step(now_s)
