"""Runs a program of a stage and shows what it prints."""

import signal
import subprocess
import sys
from collections.abc import Callable, Sequence

_ENDS_S = 120.0
OWN_PROGRAM = (sys.executable, "-m", "membrane_ctrl")


def run_shown(words: Sequence[str], show: Callable[[str], None]) -> int:
    """Run a program, show its lines as they come, and return its exit code.

    An interrupted session interrupts it, and waits until it has ended.

    Parameters
    ----------
    words : sequence of str
        Program and arguments; no shell is used.
    show : callable
        Gets each line of its output and errors, indented, without line end.

    Raises
    ------
    subprocess.TimeoutExpired
        An interrupted program does not end within two minutes.
    """
    with subprocess.Popen(
        words,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        encoding="utf-8",
        errors="replace",
    ) as process:
        assert process.stdout is not None
        try:
            for line in process.stdout:
                show(f"  {line.rstrip()}")
            return process.wait()
        except BaseException:
            process.send_signal(signal.SIGINT)
            process.wait(_ENDS_S)
            raise
