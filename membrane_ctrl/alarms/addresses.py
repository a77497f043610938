"""The services that get alarms: files of Apprise URLs, such as mail, chat and web hooks
(https://appriseit.com).
"""

import importlib
import importlib.util
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from membrane_ctrl.alarms.book import AlarmMessage
from membrane_ctrl.alarms.memory_limit import limited_memory
from membrane_ctrl.alarms.outbox import Send
from membrane_ctrl.alarms.sending import Service, send_to_all
from membrane_ctrl.config import schema
from membrane_ctrl.config.alarms import AlarmsConfig
from membrane_ctrl.model import errors, files

_MISSING = "alarms.urls_file: Apprise is not installed; pip install 'membrane-ctrl[alarms]'"
_TYPES = {"raised": "", "escalated": "failure", "reminder": "", "cleared": "success"}


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
    """Return one sender for `urls_file`, and one for `escalation_urls_file` if it is set.

    Parameters
    ----------
    config : AlarmsConfig
        Names the files with the addresses.
    run : str
        Name of the run, which every message names.

    Raises
    ------
    DeviceError
        Without Apprise.
    InputError
        For a bad file or URL. The error gives only the URL's line: it may hold a password.
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
    """`alarm test`: send one message to the alarm addresses.

    Parameters
    ----------
    config : Config
        `alarms.urls_file` names the file with the addresses, one Apprise URL a line.
    source : str
        Its file, for messages.
    escalated : bool
        Send it also to those of `alarms.escalation_urls_file`.
    as_json : bool
        Print `{"sent": true}` or `false` instead of a line for people.

    Returns
    -------
    int
        The exit code of the command.

    Raises
    ------
    InputError
        No addresses are configured, or one is not an address.
    DeviceError
        No service of a list accepts the message, or Apprise is not installed.
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
    lists: list[str | None] = [alarms.urls_file]
    if escalated:
        lists.append(alarms.escalation_urls_file)
    with limited_memory():
        failed = [file for file, send in zip(lists, senders, strict=False) if not send(message)]
    if as_json:
        print(json.dumps({"sent": not failed}))
    if failed:
        raise errors.DeviceError(
            f"{' and '.join(map(str, failed))}: no service accepted the message; check "
            "addresses and network"
        )
    if not as_json:
        print("sent; check that it has arrived")
    return errors.Exit.DONE
