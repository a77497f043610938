"""Child processes: started with `spawn`, out of reach of the terminal, and never left behind.

Ctrl-C, Ctrl-\\ and a terminal that is closed reach every process of the foreground group, and so does the SIGTERM
of `timeout` or of a machine that shuts down; only the control process may act on them, as the safe state comes first,
and the recording and the last alarm come after it. So these signals are blocked from before the children's first
instruction, and a child is asked to end by another one; examples/membrane-ctrl.service relies on it.
"""

import contextlib
import importlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from typing import Any

from membrane_ctrl.model import events, run_events, terminal

_CONTEXT = multiprocessing.get_context("spawn")
_OF_THE_GROUP = (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP, signal.SIGTERM)
# Until a child has a handler for it, it simply ends.
STOP = signal.SIGUSR1


class Child:
    """One child process.

    Parameters
    ----------
    name : str
        What it is called in messages and in the process list.
    target : str
        "package.module:function". Imported in the child, after its priority is set, so that heavy imports do
        not compete with the tick.
    args : tuple
        Picklable arguments of the function.
    nice : int
        How much the child steps back behind the control process.
    """

    def __init__(self, name: str, target: str, args: tuple[Any, ...], nice: int) -> None:
        self.name = name
        self._process = _CONTEXT.Process(target=_main, args=(target, args, nice), name=name, daemon=True)

    def start(self) -> None:
        """Start it; returns at once."""
        resource_tracker.ensure_running()  # it unblocks signals when it starts
        try:
            with _group_blocked():
                self._process.start()
        except BaseException:  # the signal that came meanwhile: who asked for the child does not know of it yet
            self.stop(1.0)
            raise

    @property
    def pid(self) -> int | None:
        """Its number; None before it was started."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """It has not ended."""
        return self._process.is_alive()

    @property
    def exit_code(self) -> int | None:
        """Exit code, negative for a signal, None while it runs."""
        return self._process.exitcode

    def join(self, timeout_s: float) -> bool:
        """Wait for its own end; True if it came."""
        self._process.join(timeout_s)
        return not self.alive

    def kill(self) -> None:
        """SIGKILL, which a stopped process obeys as well; does not wait for its end."""
        self._process.kill()

    def stop(self, timeout_s: float) -> None:
        """`STOP`, and SIGKILL if that does not end it in time."""
        if self._process.pid is None:
            return
        if self.alive:
            os.kill(self._process.pid, STOP)
        if not self.join(timeout_s):
            self._process.kill()
            self._process.join()


def leave_at_stop() -> None:
    """Within a child: `STOP` ends it, with its context managers, and SIGINT is left to the control process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(STOP, lambda number, frame: sys.exit(0))


def parent_lives() -> bool:
    """Whether the process that started this one is still there; True in a process that nobody here started."""
    parent = multiprocessing.parent_process()
    return parent is None or os.getppid() == parent.pid


def _main(target: str, args: tuple[Any, ...], nice: int) -> None:
    """Run the target, then leave without taking the interpreter down piece by piece.

    Arrays that still look into shared memory would otherwise be met by its destructor, which complains on stderr.
    """
    os.nice(nice)
    module, function = target.split(":")
    code = 0
    try:
        with terminal.only_text():
            getattr(importlib.import_module(module), function)(*args)
    except SystemExit as leaving:
        code = leaving.code if isinstance(leaving.code, int) else int(leaving.code is not None)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


@contextlib.contextmanager
def _group_blocked() -> Iterator[None]:
    """The child inherits the mask, from its first instruction on; this process gets what came meanwhile."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _OF_THE_GROUP)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def pipe() -> Any:
    """Both ends of a two-way pipe between this process and a child."""
    return _CONTEXT.Pipe()


# What a child process says to the control process over its pipe, without ever waiting for it.


def alive(for_s: float) -> run_events.Alive:
    """It is at work, and will say so again within `for_s` seconds (`ManagedChild` sees that it does)."""
    return run_events.Alive(for_s)


def reporter(status: Connection | None) -> Callable[[events.Event], None]:
    """A function that sends an event over `status` if there is room for it now, and otherwise lets it go."""
    if status is None:
        return lambda event: None
    os.set_blocking(status.fileno(), False)

    def report(event: events.Event) -> None:
        try:
            status.send({key: _short(value) for key, value in event.to_dict().items()})
        except OSError:  # full, or nobody at the other end: recording goes on
            return

    return report


def _short(value: Any) -> Any:
    """A message this short goes into a pipe whole or not at all, so that the other end never sees half of one."""
    return value[:1000] if isinstance(value, str) else value


# The tick (and the twin, which stands for devices) before everything else on the machine, where it allows that.


# The lowest real-time priority is above every ordinary process; kernel threads that need to be first stay first
_REAL_TIME = 1


def raise_priority() -> str:
    """Give this process a real-time class; the children it starts later do not inherit it.

    A tick takes some 2 % of a core, and the kernel keeps 5 % of each second for the others whatever a real-time
    process does. Without the right to it (root, CAP_SYS_NICE, or `LimitRTPRIO=` of the service) nothing changes.

    Returns
    -------
    str
        "real-time" or "ordinary", for the record.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(_REAL_TIME))
    except (OSError, AttributeError):  # no right to it, or not Linux
        return "ordinary"
    return "real-time"
