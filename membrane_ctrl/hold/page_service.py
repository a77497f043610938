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
import threading
import time
from collections.abc import Callable
from pathlib import Path

from membrane_ctrl.config.port import LOCAL
from membrane_ctrl.config.service import DEFAULT_PORT
from membrane_ctrl.control_port import service_link
from membrane_ctrl.model import errors, terminal
from membrane_ctrl.model.optional import describe_missing, find_missing_page_library

LOG_NAME = "service.log"
_IDLE_WORDS = ("--idle-end", "1h")
_NICE = 10
_STARTS_S = 120.0
_ENDS_S = 10.0
_LOOK_S = 0.1
_TAIL_BYTES = 2000


class PageService:
    """The service that has the page of a folder of runs.

    Parameters
    ----------
    logs : Path
        Folder of the runs.
    link : str
        To the page.
    process : Popen or None
        None: another program has started the service.
    """

    def __init__(
        self, logs: Path, link: str, process: subprocess.Popen[bytes] | None = None
    ) -> None:
        self._logs = logs
        self.link = link
        self._process = process

    def find_problem(self) -> str:
        """Why the service that was started has ended; empty if it runs."""
        if self._process is None or self._process.poll() is None:
            return ""
        return _read_last_line(self._logs / LOG_NAME) or f"code {self._process.returncode}"

    def wait_until_it_serves(self, patience_s: float) -> str:
        """Wait until the service is ready; returns why it is not, empty if it is."""
        give_up_s = time.monotonic() + patience_s
        while not self.is_ready():
            if problem := self.find_problem():
                return problem
            if time.monotonic() > give_up_s:
                return f"not ready within {patience_s:.0f} s; see {self._logs / LOG_NAME}"
            time.sleep(_LOOK_S)
        return ""

    def is_ready(self) -> bool:
        """Whether the service has named its address, and the one that was started listens there.

        Another program's may be reachable for browsers alone, behind a proxy.
        """
        link = service_link.find_service(self._logs)
        if not link:
            return False
        self.link = link
        return self._process is None or service_link.is_answering(link)

    def announce(self, print_line: Callable[[str], None]) -> None:
        """State the link as soon as the service is ready, or why it is not, from a thread."""

        def wait_and_print() -> None:
            problem = self.wait_until_it_serves(_STARTS_S)
            print_line(f"no page: {problem}" if problem else f"page: {self.link}")

        threading.Thread(target=wait_and_print, name="page link", daemon=True).start()

    def forget(self) -> None:
        """Leave the service to itself: it continues."""
        if self._process is not None and self._process.poll() is None:
            # it is not ours to wait for: without a code its end would be reported as a leak
            self._process.returncode = 0

    def stop(self) -> None:
        """End the service that was started."""
        if self._process is None:
            return
        self._process.terminate()
        try:
            self._process.wait(_ENDS_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stdin is not None:
            self._process.stdin.close()


def start_page_service(
    logs: Path, configuration: Path | None, warn: Callable[[str], None], ends_with_us: bool
) -> PageService | None:
    """Start a service for a folder of runs unless one is there.

    Parameters
    ----------
    logs : Path
        Folder of the runs.
    configuration : Path or None
        Of this hold: the service offers those beside it.
    warn : callable
        Gets one line if there will be no page.
    ends_with_us : bool
        Whether the service ends with this program; else it continues, and ends an hour after its
        last use.

    Returns
    -------
    PageService or None
        None without a page.
    """
    # One that follows this folder already shows the new hold, too
    if (link := service_link.find_service(logs)) is not None:
        return PageService(logs, link)
    if (missing := find_missing_page_library()) is not None:
        warn(f"no page: {describe_missing('it', missing, 'web')}")
        return None
    port = _find_free_port()
    if configuration is None:
        folder = Path()
    else:
        folder = configuration.resolve().parent
    words = ["serve", "--logs", str(logs), "--port", str(port), "--configurations", str(folder)]
    words += ["--with-hold"] if ends_with_us else _IDLE_WORDS
    try:
        link = service_link.add_key(f"http://{LOCAL}:{port}/")
        process = _start_in_session(words, logs / LOG_NAME, ends_with_us)
    except (errors.DeviceError, OSError) as error:
        warn(f"no page: {error}")
        return None
    return PageService(logs, link, process)


def _start_in_session(words: list[str], log: Path, ends_with_us: bool) -> subprocess.Popen[bytes]:
    """Start one of our commands in a session of its own. Raises OSError."""
    log.parent.mkdir(parents=True, exist_ok=True)
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND | os.O_NOFOLLOW
    handle = os.open(log, flags, 0o600)
    with os.fdopen(handle, "wb") as output:
        process = subprocess.Popen(
            ["nice", "-n", str(_NICE), sys.executable, "-m", "membrane_ctrl", *words],
            # its standard input closes when this program dies
            stdin=subprocess.PIPE if ends_with_us else subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            start_new_session=True,
        )
    # takes its exit code when it ends: it must not remain as a zombie
    threading.Thread(target=process.wait, name="page service", daemon=True).start()
    return process


def _read_last_line(log: Path) -> str:
    """Return the last line that a program has written."""
    try:
        text = log.read_bytes()[-_TAIL_BYTES:].decode("utf-8", "replace")
    except OSError:
        return ""
    lines = text.strip().splitlines()
    return terminal.one_line(lines[-1]).removeprefix("membrane-ctrl: ") if lines else ""


def _find_free_port() -> int:
    """Return the service's usual port, or any free one if another program has it."""
    try:
        with socket.create_server((LOCAL, DEFAULT_PORT)):
            return DEFAULT_PORT
    except OSError:
        with socket.create_server((LOCAL, 0)) as listener:
            return int(listener.getsockname()[1])
