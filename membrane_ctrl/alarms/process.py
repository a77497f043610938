"""The process that sends alarms: mail servers may take a minute, and the run does not wait for
them.

Messages go through Apprise: mail, chat, web hook and many more, each a URL (https://appriseit.com).
"""

import importlib
import importlib.util
import json
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from membrane_ctrl.alarms.book import AlarmBook, AlarmMessage, Sign, sign_of_value, signs_of
from membrane_ctrl.alarms.sending import Service, limited_memory, send_to_all
from membrane_ctrl.config import schema
from membrane_ctrl.config.port import AlarmsConfig
from membrane_ctrl.model import child_events, errors, event_lines, files, port_events
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.durations import pause_s
from membrane_ctrl.model.events import CommandTaken, Event, EventLine
from membrane_ctrl.model.run_status import RunStatus
from membrane_ctrl.model.telemetry import TelemetryRow
from membrane_ctrl.processes import child, event_pipe, ring

Send = Callable[[AlarmMessage], bool]

_AGAIN_S, _AGAIN_MOST_S = 10.0, 300.0
# a day without a network must not end in a thousand mails
_KEPT = 50
_MISSING = "alarms.urls_file: Apprise is not installed; pip install 'membrane-ctrl[alarms]'"
_TYPES = {"raised": "", "escalated": "failure", "reminder": "", "cleared": "success"}
# before its first tick a run connects its devices, with time-outs of its own
_STARTS_S = 30.0
_LOOK_S = 0.5
# After the run's end, for the last messages; longer would delay a service manager's restart
_LAST_S = 8.0
_SENDING_S = 300.0  # a list of mail servers, each with a minute of time-out
_TO = ("urls_file", "escalation_urls_file")  # of the configuration, in the order of the senders
_IDLE_S = 15.0  # with nothing to send; a process that hangs then could not send an alarm


class Outbox:
    """A queue of messages, each tried until it is sent; a full box drops the oldest, which
    `dropped` counts.

    `send` returns whether the message was sent; it may be slow but must not raise.
    """

    def __init__(self, send: Send) -> None:
        self._send = send
        self._waiting: deque[AlarmMessage] = deque()
        self._due_s = 0.0
        self.failures = 0  # since the last success
        self.dropped = 0

    def queue_message(self, message: AlarmMessage) -> None:
        """Queue a message."""
        self._waiting.append(message)
        if len(self._waiting) > _KEPT:
            self._waiting.popleft()
            self.dropped += 1

    @property
    def is_empty(self) -> bool:
        """All messages are sent."""
        return not self._waiting

    def step(self, now_s: float) -> None:
        """Send queued messages, oldest first, unless the last failure is too recent."""
        if now_s < self._due_s:
            return
        while self._waiting:
            if not self._send(self._waiting[0]):
                self.failures += 1
                self._due_s = now_s + pause_s(self.failures, _AGAIN_S, _AGAIN_MOST_S)
                return
            self._waiting.popleft()
            self.failures = 0


def read_urls(path: Path) -> list[str]:
    """Read the URLs of a file, one per line, ignoring empty lines and comments (`#`). Raises
    InputError.
    """
    try:
        lines = files.read_text(path, follow=True).splitlines()
    except OSError as error:
        raise errors.InputError(f"alarms: {path}: {errors.os_reason(error)}") from None
    except UnicodeDecodeError as error:
        raise errors.InputError(f"alarms: {path}: {error}") from None
    urls = [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if not urls:
        raise errors.InputError(
            f"{path}: no URL found; write one per line, e.g. mailto://user:password@example.org"
        )
    return urls


def require_sendable(config: AlarmsConfig) -> None:
    """Check before a run that alarms can be sent. Raises InputError or DeviceError."""
    for name in (config.urls_file, config.escalation_urls_file):
        if name is not None:
            read_urls(Path(name))
    if config.urls_file is not None and importlib.util.find_spec("apprise") is None:
        raise errors.DeviceError(_MISSING)


def apprise_senders(config: AlarmsConfig, run: str) -> list[Send]:
    """One sender for `urls_file`, one for `escalation_urls_file` if it is set; every message names
    the run.

    Raises DeviceError without Apprise, InputError for a bad file or URL. The error gives only the
    URL's line: it may hold a password.
    """
    apprise = _import_apprise()
    assert config.urls_file is not None
    lists = [name for name in (config.urls_file, config.escalation_urls_file) if name is not None]
    return [partial(_send_message, _make_services(apprise, Path(name)), run) for name in lists]


def _send_message(targets: Sequence[Service], run: str, message: AlarmMessage) -> bool:
    kind = _TYPES[message.kind] or {"warning": "warning", "critical": "failure"}[message.severity]
    title = f"membrane-ctrl {message.severity} {message.kind}: {message.name}"
    return send_to_all(targets, title, f"{message.text}\nrun: {run}", kind)


def _make_services(apprise: Any, path: Path) -> list[Service]:
    services = []
    for number, url in enumerate(read_urls(path), start=1):
        plugin = apprise.Apprise.instantiate(url)
        if plugin is None:
            raise errors.InputError(f"{path}: URL {number}: Apprise does not support it")
        services.append(Service(plugin))
    return services


def _import_apprise() -> Any:
    try:
        return importlib.import_module("apprise")
    except ImportError:
        raise errors.DeviceError(_MISSING) from None


def send_test_alarm(config: schema.Config, source: str, escalated: bool, as_json: bool) -> int:
    """`alarm test`: send one message to the alarm addresses, and with `escalated` to the escalation
    addresses.

    Raises InputError without addresses, DeviceError if no service accepts it.
    """
    alarms = config.alarms
    if alarms.urls_file is None:
        raise errors.InputError(
            f"{source}: alarms.urls_file: missing; name a file with one Apprise URL per line"
        )
    if escalated and alarms.escalation_urls_file is None:
        raise errors.InputError(
            f"{source}: alarms.escalation_urls_file: missing; no escalation addresses"
        )
    message = AlarmMessage("raised", "test", "warning", "this is only a test", escalated)
    senders = apprise_senders(alarms, "none, a test")
    lists = [alarms.urls_file, alarms.escalation_urls_file][: 2 if escalated else 1]
    with limited_memory():
        deaf = [file for file, send in zip(lists, senders, strict=False) if not send(message)]
    if as_json:
        print(json.dumps({"sent": not deaf}))
    if deaf:
        raise errors.DeviceError(
            f"{' and '.join(map(str, deaf))}: no service accepted the message; check "
            "addresses and network"
        )
    if not as_json:
        print("sent; check that it has arrived")
    return errors.Exit.DONE


class Watcher:
    """Turns rows and events into alarm messages; the first outbox gets all, the second only the
    escalated ones.
    """

    def __init__(self, config: AlarmsConfig, outboxes: Sequence[Outbox], now_s: float) -> None:
        self._config = config
        self._book = AlarmBook(config)
        self._outboxes = outboxes
        self._last_row_s = now_s + _STARTS_S
        self._status = RunStatus()

    @property
    def has_ended(self) -> bool:
        """The "end" event has arrived."""
        return self._status.ended

    def process_news(self, rows: Sequence[bytes], events: Sequence[bytes], now_s: float) -> None:
        """Take rows and events, and send due messages."""
        for message in events:
            self._take_event(json.loads(message), now_s)
        for row in rows:
            self._take_row(row, now_s)
        self._read_event(bool(rows), now_s)
        self._send_due(now_s)

    def report_orphan(self, now_s: float) -> None:
        """Report that the control process ended without an "end" event."""
        text = (
            "the control process ended without a report: look whether the pump runs. A board's "
            "watchdog stops its pump; on a bench of single instruments the last flow continues "
            "until `membrane-ctrl safe` runs"
        )
        self._book.take_sign(Sign("control_gone", True, "critical", text), now_s)
        self._send_due(now_s)

    def _take_event(self, line: EventLine, now_s: float) -> None:
        event = event_lines.from_dict(line)
        signs = signs_of(event.notice_changes(self._status.notices))
        self._status = self._status.after_event(event)
        match event:
            case port_events.AlarmsAcknowledged() | CommandTaken(command="ack"):
                # whoever sends `ack` has seen the alarms, even if the hold refuses it
                self._book.acknowledge_all()
        for sign in signs:
            self._book.take_sign(sign, now_s)

    def _take_row(self, message: bytes, now_s: float) -> None:
        row = TelemetryRow.unpack(message)
        for rule in self._config.rules:
            sign = sign_of_value(
                rule, getattr(row, rule.field), self._book.note_standing(rule.name)
            )
            if sign is not None:
                self._book.take_sign(sign, now_s)

    def _read_event(self, heard: bool, now_s: float) -> None:
        if heard:
            self._last_row_s = now_s
            self._book.take_sign(Sign("silent", False), now_s)
        elif now_s - self._last_row_s >= self._config.silent_s and not self.has_ended:
            text = f"no tick for {self._config.silent_s:g} s: the control process hangs"
            self._book.take_sign(Sign("silent", True, "critical", text), now_s)

    def _send_due(self, now_s: float) -> None:
        for message in self._book.step(now_s):
            for outbox in self._outboxes[: 2 if message.escalated else 1]:
                outbox.queue_message(message)
        for outbox in self._outboxes:
            outbox.step(now_s)


@dataclass(frozen=True, slots=True)
class AlarmsSpec:
    """What the process needs to know about the run."""

    clock: RunClock
    telemetry: ring.RingAddress
    events: ring.RingAddress
    config: AlarmsConfig  # rules, times and files of URLs
    run: str  # name of the run folder


def alarms_main(spec: AlarmsSpec, status: Any) -> None:
    """Watch until the run ends or the control process has gone.

    Target of a `spawn`ed process; `status` is its end of a pipe, for events about sent messages.
    """
    child.leave_at_stop()
    senders = apprise_senders(spec.config, spec.run)
    with limited_memory():
        watch_run(spec, senders, event_pipe.event_sender(status), child.parent_lives)


def watch_run(
    spec: AlarmsSpec,
    senders: Sequence[Send],
    report: Callable[[Event], None],
    parent_lives: Callable[[], bool],
) -> None:
    """Run the process's loop; `senders` are the one for all messages and the one for escalated
    ones.
    """
    clock = spec.clock
    outboxes = [
        Outbox(_report_failures(send, to, report)) for send, to in zip(senders, _TO, strict=False)
    ]
    watcher = Watcher(spec.config, outboxes, clock.now())
    with (
        closing(ring.RingReader(spec.telemetry)) as telemetry,
        closing(ring.RingReader(spec.events)) as events,
    ):
        while True:
            lives = (
                parent_lives()
            )  # before the rings: a dying parent has written its last message first
            report(child_events.Alive(_SENDING_S))
            watcher.process_news(telemetry.drain(), events.drain(), clock.now())
            if watcher.has_ended or not lives:
                break
            report(child_events.Alive(_IDLE_S))
            time.sleep(_LOOK_S)
        if not watcher.has_ended:
            watcher.report_orphan(clock.now())
    give_up_s = clock.now() + _LAST_S
    while not all(outbox.is_empty for outbox in outboxes) and clock.now() < give_up_s:
        time.sleep(_LOOK_S)
        for outbox in outboxes:
            outbox.step(clock.now())


def _report_failures(send: Send, to: str, report: Callable[[Event], None]) -> Send:
    def sending(message: AlarmMessage) -> bool:
        through = send(message)
        report(
            port_events.AlarmTold(
                alarm=message.name,
                what=message.kind,
                severity=message.severity,
                text=message.text,
                to=to,
                sent=through,
                escalated=message.escalated,
            )
        )
        return through

    return sending
