"""Notices by Apprise: mail, chat, web hook and a hundred more, each an URL (https://appriseit.com)."""

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
from membrane_ctrl.model.errors import DeviceError, Exit, InputError, os_reason

# Notices on their way: tried again until they are through, none twice, and never a pile of them.


Send = Callable[[Notice], bool]

_AGAIN_S, _AGAIN_MOST_S = 10.0, 300.0
# a day without network must not end in a thousand mails
_KEPT = 50


class Outbox:
    """A queue in front of a sender that may fail.

    Parameters
    ----------
    send : callable
        Returns whether the notice is through; may take its time, must not raise.

    Attributes
    ----------
    dropped : int
        The oldest of a full box.
    failing : bool
        The last attempt failed.
    """

    def __init__(self, send: Send) -> None:
        self._send = send
        self._waiting: deque[Notice] = deque()
        self._due_s = 0.0
        self._again_s = _AGAIN_S
        self.dropped = 0
        self.failing = False

    def post(self, notice: Notice) -> None:
        """Put a notice in."""
        self._waiting.append(notice)
        if len(self._waiting) > _KEPT:
            self._waiting.popleft()
            self.dropped += 1

    @property
    def empty(self) -> bool:
        """All are through."""
        return not self._waiting

    def step(self, now_s: float) -> None:
        """Send what waits, oldest first, unless the last failure is too fresh."""
        if now_s < self._due_s:
            return
        while self._waiting:
            if not self._send(self._waiting[0]):
                self.failing = True
                self._due_s = now_s + self._again_s
                self._again_s = min(2.0 * self._again_s, _AGAIN_MOST_S)
                return
            self._waiting.popleft()
            self.failing, self._again_s = False, _AGAIN_S


_MISSING = "alarms.urls_file: Apprise is not installed; pip install 'membrane-ctrl[alarms]'"
_TYPES = {"raised": "", "escalated": "failure", "reminder": "", "cleared": "success"}


def read_urls(path: Path) -> list[str]:
    """The URLs of a file, one a line; empty lines and those after `#` are passed over. Raises InputError."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise InputError(f"alarms: {path}: {os_reason(error)}") from None
    except UnicodeDecodeError as error:
        raise InputError(f"alarms: {path}: {error}") from None
    urls = [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if not urls:
        raise InputError(f"{path}: no URL in it; one a line, e.g. mailto://user:password@example.org")
    return urls


def require_sendable(config: port.AlarmsConfig) -> None:
    """Refuse in one line, and before a run begins, what could not be sent. Raises InputError or DeviceError."""
    for name in (config.urls_file, config.escalation_urls_file):
        if name is not None:
            read_urls(Path(name))
    if config.urls_file is not None and importlib.util.find_spec("apprise") is None:
        raise DeviceError(_MISSING)


def apprise_senders(config: port.AlarmsConfig, run: str) -> list[Send]:
    """Senders for the configuration's URLs: of `urls_file`, and of `escalation_urls_file` if there is one.

    Two, as they fail apart: what has reached the people at the bench has not reached those behind them.

    Parameters
    ----------
    config : AlarmsConfig
        Whose `urls_file` is set.
    run : str
        Named in every notice.

    Raises
    ------
    DeviceError
        Apprise is not installed.
    InputError
        A file or a URL that is none; the URL is named by its line only, as it holds passwords.
    """
    apprise = _apprise()
    assert config.urls_file is not None
    files = [name for name in (config.urls_file, config.escalation_urls_file) if name is not None]
    return [partial(_send, _plugins(apprise, Path(name)), run) for name in files]


def _send(targets: Sequence[Any], run: str, notice: Notice) -> bool:
    kind = _TYPES[notice.kind] or {"warning": "warning", "critical": "failure"}[notice.severity]
    title = f"membrane-ctrl {notice.severity} {notice.kind}: {notice.name}"
    return _notify(targets, title, f"{notice.text}\nrun: {run}", kind)


def _notify(targets: Sequence[Any], title: str, body: str, kind: str) -> bool:
    """Tell every target; through if one is: a dead chat server must not repeat the mail for ever."""
    sent = []
    for target in targets:
        try:
            sent.append(bool(target.notify(title=title, body=body, notify_type=kind)))
        except Exception as error:  # a plug-in's own trouble
            logging.getLogger(__name__).warning("%s: %s", type(target).__name__, type(error).__name__)
            sent.append(False)
    return any(sent)


def _plugins(apprise: Any, path: Path) -> list[Any]:
    plugins = []
    for number, url in enumerate(read_urls(path), start=1):
        plugin = apprise.Apprise.instantiate(url)
        if plugin is None:
            raise InputError(f"{path}: URL {number} is none that Apprise knows")
        plugins.append(plugin)
    return plugins


def _apprise() -> Any:
    try:
        return importlib.import_module("apprise")
    except ImportError:
        raise DeviceError(_MISSING) from None


# `alarm test`: does a notice arrive?


def send_test_alarm(config: schema.Config, source: str, escalated: bool, as_json: bool) -> int:
    """Send one notice to all whom an alarm would reach.

    Parameters
    ----------
    config : Config
        With `[alarms]`.
    source : str
        Where it came from, for messages.
    escalated : bool
        Also to those of the escalation.
    as_json : bool
        Print the result as JSON.

    Raises
    ------
    InputError, DeviceError
        Nothing to send to; nothing was taken.
    """
    alarms = config.alarms
    if alarms.urls_file is None:
        raise InputError(f"{source}: alarms.urls_file: missing; name a file with one Apprise URL a line")
    if escalated and alarms.escalation_urls_file is None:
        raise InputError(f"{source}: alarms.escalation_urls_file: missing; there is nobody to escalate to")
    notice = Notice("raised", "test", "warning", "this is a test; nothing is wrong", escalated)
    senders = apprise_senders(alarms, "none, a test")
    files = [alarms.urls_file, alarms.escalation_urls_file][: 2 if escalated else 1]
    deaf = [file for file, send in zip(files, senders, strict=False) if not send(notice)]
    if as_json:
        print(json.dumps({"sent": not deaf}))
    if deaf:
        raise DeviceError(f"{' and '.join(map(str, deaf))}: no service took the notice; check addresses and network")
    if not as_json:
        print("sent; look whether it has arrived")
    return Exit.DONE
