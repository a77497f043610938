"""Starts the service for the runs of a hold if none is there, so that every hold has a page.

The service is a program in a session of its own, at a low priority: it outlives the hold. It ends
an hour after its last viewer and its last hold; in continuous integration (environment variable
`CI`) it ends with the hold that started it.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from membrane_ctrl.config.port import LOCAL
from membrane_ctrl.config.service import DEFAULT_PORT
from membrane_ctrl.control_port import service_link
from membrane_ctrl.model import errors
from membrane_ctrl.model.optional import describe_missing, find_missing_page_library
from membrane_ctrl.processes.command_process import CommandProcess

LOG_NAME = "service.log"
_IDLE_WORDS = ("--idle-end", "1h")
_NICE = 10
_ENDS_S = 10.0
_STARTS_S = 10.0


def start_page_service(
    logs: Path, configuration: Path | None, stack: ExitStack, warn: Callable[[str], None]
) -> str:
    """Start a service for a folder of runs unless one is there.

    Parameters
    ----------
    logs : Path
        Folder of the runs.
    configuration : Path or None
        Of this hold: the service offers those beside it.
    stack : ExitStack
        In continuous integration, it ends the service.
    warn : callable
        Gets one line if there will be no page.

    Returns
    -------
    str
        The link to the page; empty without a page.
    """
    if (link := service_link.find_service(logs)) is not None:
        return link
    if (missing := find_missing_page_library()) is not None:
        warn(f"no page: {describe_missing('it', missing, 'web')}")
        return ""
    port = _find_free_port()
    folder = Path() if configuration is None else configuration.resolve().parent
    words = ["serve", "--logs", str(logs), "--port", str(port), "--configurations", str(folder)]
    try:
        link = service_link.add_key(f"http://{LOCAL}:{port}/")
        if os.environ.get("CI"):
            service = CommandProcess("service", [*words, "--with-hold"], logs / LOG_NAME, _NICE)
            service.start()
            stack.callback(service.stop, _ENDS_S)
        else:
            _start_in_session([*words, *_IDLE_WORDS], logs / LOG_NAME)
    except (errors.DeviceError, OSError, subprocess.TimeoutExpired) as error:
        warn(f"no page: {error}")
        return ""
    return link


def _start_in_session(words: list[str], log: Path) -> None:
    """Start one of our commands in a session of its own, no child of this program, and forget it.
    Raises OSError.
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND | os.O_NOFOLLOW
    handle = os.open(log, flags, 0o600)
    detached = ["nice", "-n", str(_NICE), "setsid", "--fork", sys.executable]
    with os.fdopen(handle, "wb") as output:
        subprocess.run(
            [*detached, "-m", "membrane_ctrl", *words],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            check=False,
            timeout=_STARTS_S,
        )


def _find_free_port() -> int:
    """Return the service's usual port, or any free one if another program has it."""
    try:
        with socket.create_server((LOCAL, DEFAULT_PORT)):
            return DEFAULT_PORT
    except OSError:
        with socket.create_server((LOCAL, 0)) as listener:
            return int(listener.getsockname()[1])
