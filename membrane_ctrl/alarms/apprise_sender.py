"""Notices by Apprise: mail, chat, web hook and a hundred more, each an URL (https://appriseit.com)."""

from __future__ import annotations

import importlib
import importlib.util
import logging
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from membrane_ctrl.alarms.book import Notice
from membrane_ctrl.alarms.outbox import Send
from membrane_ctrl.errors import DeviceError, InputError
from membrane_ctrl.port_config import AlarmsConfig

_MISSING = "alarms.urls_file: Apprise is not installed; pip install 'membrane-ctrl[alarms]'"
_TYPES = {"raised": "", "escalated": "failure", "reminder": "", "cleared": "success"}


def read_urls(path: Path) -> list[str]:
    """The URLs of a file, one a line; empty lines and those after `#` are passed over. Raises InputError."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise InputError(f"alarms: {path}: {(error.strerror or str(error)).lower()}") from None
    except UnicodeDecodeError as error:
        raise InputError(f"alarms: {path}: {error}") from None
    urls = [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if not urls:
        raise InputError(f"{path}: no URL in it; one a line, e.g. mailto://user:password@example.org")
    return urls


def require_sendable(config: AlarmsConfig) -> None:
    """Refuse in one line, and before a run begins, what could not be sent. Raises InputError or DeviceError."""
    for name in (config.urls_file, config.escalation_urls_file):
        if name is not None:
            read_urls(Path(name))
    if config.urls_file is not None and importlib.util.find_spec("apprise") is None:
        raise DeviceError(_MISSING)


def apprise_senders(config: AlarmsConfig, run: str) -> list[Send]:
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
