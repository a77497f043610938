"""Notices through Apprise: mail, chat, web hook and many more, each a URL (https://appriseit.com)."""

import importlib
import importlib.util
import json
import logging
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from membrane_ctrl.alarms.book import Notice
from membrane_ctrl.config import port, schema
from membrane_ctrl.model import clock, errors, files

Send = Callable[[Notice], bool]

_AGAIN_S, _AGAIN_MOST_S = 10.0, 300.0
# a day without a network must not end in a thousand mails
_KEPT = 50


class Outbox:
    """A queue of notices, each tried until it is sent; a full box drops the oldest, which `dropped` counts.

    `send` returns whether the notice was sent; it may be slow but must not raise.
    """

    def __init__(self, send: Send) -> None:
        self._send = send
        self._waiting: deque[Notice] = deque()
        self._due_s = 0.0
        self._failures = 0
        self.dropped = 0

    @property
    def failing(self) -> bool:
        """The last attempt failed."""
        return self._failures > 0

    def post(self, notice: Notice) -> None:
        """Queue a notice."""
        self._waiting.append(notice)
        if len(self._waiting) > _KEPT:
            self._waiting.popleft()
            self.dropped += 1

    @property
    def empty(self) -> bool:
        """All notices are sent."""
        return not self._waiting

    def step(self, now_s: float) -> None:
        """Send queued notices, oldest first, unless the last failure is too recent."""
        if now_s < self._due_s:
            return
        while self._waiting:
            if not self._send(self._waiting[0]):
                self._failures += 1
                self._due_s = now_s + clock.pause_s(self._failures, _AGAIN_S, _AGAIN_MOST_S)
                return
            self._waiting.popleft()
            self._failures = 0


_MISSING = "alarms.urls_file: Apprise is not installed; pip install 'membrane-ctrl[alarms]'"
_TYPES = {"raised": "", "escalated": "failure", "reminder": "", "cleared": "success"}


def read_urls(path: Path) -> list[str]:
    """Read the URLs of a file, one per line, ignoring empty lines and comments (`#`). Raises InputError."""
    try:
        lines = files.read_text(path, follow=True).splitlines()
    except OSError as error:
        raise errors.InputError(f"alarms: {path}: {errors.os_reason(error)}") from None
    except UnicodeDecodeError as error:
        raise errors.InputError(f"alarms: {path}: {error}") from None
    urls = [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if not urls:
        raise errors.InputError(f"{path}: no URL found; write one per line, e.g. mailto://user:password@example.org")
    return urls


def require_sendable(config: port.AlarmsConfig) -> None:
    """Check before a run that alarms can be sent. Raises InputError or DeviceError."""
    for name in (config.urls_file, config.escalation_urls_file):
        if name is not None:
            read_urls(Path(name))
    if config.urls_file is not None and importlib.util.find_spec("apprise") is None:
        raise errors.DeviceError(_MISSING)


def apprise_senders(config: port.AlarmsConfig, run: str) -> list[Send]:
    """One sender for `urls_file`, one for `escalation_urls_file` if it is set; every notice names the run.

    Raises DeviceError without Apprise, InputError for a bad file or URL. The error gives only the URL's line: it may
    hold a password.
    """
    apprise = _apprise()
    assert config.urls_file is not None
    lists = [name for name in (config.urls_file, config.escalation_urls_file) if name is not None]
    return [partial(_send, _plugins(apprise, Path(name)), run) for name in lists]


def _send(targets: Sequence[Any], run: str, notice: Notice) -> bool:
    kind = _TYPES[notice.kind] or {"warning": "warning", "critical": "failure"}[notice.severity]
    title = f"membrane-ctrl {notice.severity} {notice.kind}: {notice.name}"
    return _notify(targets, title, f"{notice.text}\nrun: {run}", kind)


def _notify(targets: Sequence[Any], title: str, body: str, kind: str) -> bool:
    """Notify every target; one success suffices: a dead chat server must not repeat the mail forever."""
    sent = []
    for target in targets:
        try:
            sent.append(bool(target.notify(title=title, body=body, notify_type=kind)))
        except Exception as error:  # plug-ins raise anything
            logging.getLogger(__name__).warning("%s: %s", type(target).__name__, type(error).__name__)
            sent.append(False)
    return any(sent)


def _plugins(apprise: Any, path: Path) -> list[Any]:
    plugins = []
    for number, url in enumerate(read_urls(path), start=1):
        plugin = apprise.Apprise.instantiate(url)
        if plugin is None:
            raise errors.InputError(f"{path}: URL {number}: Apprise does not support it")
        plugins.append(plugin)
    return plugins


def _apprise() -> Any:
    try:
        return importlib.import_module("apprise")
    except ImportError:
        raise errors.DeviceError(_MISSING) from None


def send_test_alarm(config: schema.Config, source: str, escalated: bool, as_json: bool) -> int:
    """`alarm test`: send one notice to the alarm addresses, and with `escalated` to the escalation addresses.

    Raises InputError without addresses, DeviceError if no service accepts it.
    """
    alarms = config.alarms
    if alarms.urls_file is None:
        raise errors.InputError(f"{source}: alarms.urls_file: missing; name a file with one Apprise URL per line")
    if escalated and alarms.escalation_urls_file is None:
        raise errors.InputError(f"{source}: alarms.escalation_urls_file: missing; no escalation addresses")
    notice = Notice("raised", "test", "warning", "this is only a test", escalated)
    senders = apprise_senders(alarms, "none, a test")
    lists = [alarms.urls_file, alarms.escalation_urls_file][: 2 if escalated else 1]
    deaf = [file for file, send in zip(lists, senders, strict=False) if not send(notice)]
    if as_json:
        print(json.dumps({"sent": not deaf}))
    if deaf:
        raise errors.DeviceError(
            f"{' and '.join(map(str, deaf))}: no service accepted the notice; check addresses and network"
        )
    if not as_json:
        print("sent; check that it has arrived")
    return errors.Exit.DONE
