"""Runs a command on a busy machine that pauses now and then, as a virtual one does: `make shake`.

`python tests/shake.py [--every A B] [--still A B] [--hogs N] [--seed N] COMMAND...` stops all
processes of the command for `still` seconds at random moments, `every` so many seconds. The clock
continues meanwhile.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import time
from contextlib import suppress

import psutil

HOG = [sys.executable, "-c", "while True: pass"]


def processes_of(session: int) -> set[int]:
    """Processes of the command, orphans too, that no test has stopped already."""
    found = set()
    for process in psutil.process_iter():
        with suppress(psutil.Error, ProcessLookupError):
            if os.getsid(process.pid) == session and process.status() != psutil.STATUS_STOPPED:
                found.add(process.pid)
    return found


def stand_still(session: int, seconds: float) -> None:
    """Stop them all, including new ones, and let them continue."""
    stopped: set[int] = set()
    while more := processes_of(session) - stopped:
        for pid in more:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGSTOP)
        stopped |= more
    time.sleep(seconds)
    for pid in stopped:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)


def main() -> int:
    """The command's exit code."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--every", type=float, nargs=2, default=(8.0, 15.0))
    parser.add_argument("--still", type=float, nargs=2, default=(1.0, 1.5))
    parser.add_argument("--hogs", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("command", nargs=argparse.REMAINDER)
    asked = parser.parse_args()
    draw = random.Random(asked.seed)
    hogs = [subprocess.Popen(HOG) for _ in range(asked.hogs)]
    command = subprocess.Popen(asked.command, start_new_session=True)
    count = 0
    try:
        while True:
            try:
                return command.wait(draw.uniform(*asked.every))
            except subprocess.TimeoutExpired:
                stand_still(command.pid, draw.uniform(*asked.still))
                count += 1
    finally:
        for pid in processes_of(command.pid):
            os.kill(pid, signal.SIGKILL)
        for hog in hogs:
            hog.kill()
        print(f"stood still {count} times")


if __name__ == "__main__":
    sys.exit(main())
