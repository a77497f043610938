"""A command of this program as a child process, for example a tuning session or the web page."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path


class CommandProcess:
    """One of our commands as a child: in a process group of its own, its output appended to a file
    of its user.

    With the option `--with-hold` it ends when this process dies (`end_with_parent`). A command that
    cannot be started counts as one that has ended.
    """

    def __init__(self, name: str, arguments: Sequence[str], log: Path, nice: int) -> None:
        self.name = name
        self._arguments = arguments
        self._log = log
        self._nice = nice
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the program without waiting."""
        program = [sys.executable, "-m", "membrane_ctrl", *self._arguments]
        if "--with-hold" in self._arguments:
            stdin = subprocess.PIPE
        else:
            stdin = subprocess.DEVNULL
        with contextlib.suppress(OSError), _open_log(self._log) as log:
            self._process = subprocess.Popen(
                program, stdin=stdin, stdout=log, stderr=log, process_group=0
            )
            # a child never gets a higher priority than the program that started it
            own_niceness = os.getpriority(os.PRIO_PROCESS, 0)
            niceness = max(own_niceness, self._nice)
            os.setpriority(os.PRIO_PROCESS, self._process.pid, niceness)

    @property
    def alive(self) -> bool:
        """Whether the program runs."""
        if self._process is None or self._process.poll() is None:
            return self._process is not None
        if self._process.stdin is not None:
            self._process.stdin.close()
        return False

    @property
    def exit_code(self) -> int | None:
        """Exit code, negative for a signal, None while it runs."""
        if self._process is None:
            return None
        return self._process.returncode

    def join(self, timeout_s: float) -> bool:
        """Wait for the program to end; True if it did."""
        with contextlib.suppress(AttributeError, subprocess.TimeoutExpired):
            self._process.wait(timeout_s)  # type: ignore[union-attr]
        return not self.alive

    def kill(self) -> None:
        """Send SIGKILL without waiting."""
        if self._process is not None:
            self._process.kill()

    def stop(self, timeout_s: float) -> None:
        """Send SIGTERM, then SIGKILL if the program does not end in time."""
        if self._process is None:
            return
        self._process.terminate()
        if not self.join(timeout_s):
            self.kill()
            self.join(timeout_s)


@contextlib.contextmanager
def _open_log(log: Path) -> Iterator[int]:
    """A file that only its user may read: the output may hold the link that lets in; or nothing if
    it cannot be.
    """
    try:
        handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    except OSError:
        handle = os.open(os.devnull, os.O_WRONLY)
    try:
        yield handle
    finally:
        os.close(handle)


def end_with_parent() -> None:
    """End this program with SIGTERM when its standard input closes.

    That happens when the process of the `CommandProcess` that started it has died.
    """

    def wait() -> None:
        while os.read(0, 1024):  # not `sys.stdin`: its lock would abort the interpreter's end
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, name="parent", daemon=True).start()
