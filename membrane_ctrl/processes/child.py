"""Child processes: started with `spawn`, shielded from the terminal, and never left behind.

Ctrl-C, Ctrl-Z, Ctrl-\\, a closed terminal and the SIGTERM of `timeout` or a shutdown reach every
process of the group. Only the control process may act on them: the safe state comes before the end
of recording and alarms. So the children block these signals from their first instruction on, and
end on a different one; examples/membrane-ctrl.service relies on this.
"""

import contextlib
import importlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator
from multiprocessing import resource_tracker
from typing import Any

from membrane_ctrl.model import terminal

SPAWN_CONTEXT = multiprocessing.get_context("spawn")
_OF_THE_GROUP = (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP, signal.SIGTERM, signal.SIGTSTP)
# A child without a handler for it yet simply ends.
STOP = signal.SIGUSR1


class Child:
    """One child process.

    Parameters
    ----------
    name : str
        For messages and the process list.
    target : str
        "package.module:function". The child imports it after setting its priority, so that heavy
        imports do not compete with the tick.
    args : tuple
        Picklable arguments of the function.
    nice : int
        Niceness of the process: 5 to 10, so that the tick comes first.
    """

    def __init__(self, name: str, target: str, args: tuple[Any, ...], nice: int) -> None:
        self.name = name
        self._process = SPAWN_CONTEXT.Process(
            target=_run_target, args=(target, args, nice), name=name, daemon=True
        )

    def start(self) -> None:
        """Start the child without waiting."""
        resource_tracker.ensure_running()  # which unblocks signals when it starts
        try:
            with _group_blocked():
                self._process.start()
        except BaseException:  # a signal arrived, and the caller has no handle of the child yet
            self.stop(1.0)
            raise

    @property
    def pid(self) -> int | None:
        """Process id; None before the start."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether the child has not ended."""
        return self._process.is_alive()

    @property
    def exit_code(self) -> int | None:
        """Exit code, negative for a signal, None while it runs."""
        return self._process.exitcode

    def join(self, timeout_s: float) -> bool:
        """Wait for the child to end; True if it did."""
        self._process.join(timeout_s)
        return not self.alive

    def kill(self) -> None:
        """Send SIGKILL, which even ends a stopped process, without waiting."""
        self._process.kill()

    def stop(self, timeout_s: float) -> None:
        """Send `STOP`, then SIGKILL if the child does not end in time."""
        if self._process.pid is None:
            return
        if self.alive:
            os.kill(self._process.pid, STOP)
        if not self.join(timeout_s):
            self._process.kill()
            self._process.join()


def leave_at_stop() -> None:
    """Within a child: end on `STOP`, running its context managers, and leave SIGINT to the control
    process.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(STOP, lambda number, frame: sys.exit(0))


def parent_lives() -> bool:
    """Whether the parent still lives; True in a process that this module did not start."""
    parent = multiprocessing.parent_process()
    return parent is None or os.getppid() == parent.pid


def _run_target(target: str, args: tuple[Any, ...], nice: int) -> None:
    """Run the target, then exit at once: the interpreter's shutdown would complain about arrays in
    shared memory.
    """
    os.nice(nice)
    module, function = target.split(":")
    code = 0
    try:
        with terminal.only_text():
            getattr(importlib.import_module(module), function)(*args)
    except SystemExit as leaving:
        if isinstance(leaving.code, int):
            code = leaving.code
        else:
            code = int(leaving.code is not None)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


@contextlib.contextmanager
def _group_blocked() -> Iterator[None]:
    """Block the group's signals while a child starts, which inherits the block; this process gets
    them afterwards.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _OF_THE_GROUP)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
