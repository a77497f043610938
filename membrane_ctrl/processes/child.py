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
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

from membrane_ctrl.model import errors, events, terminal

_CONTEXT = multiprocessing.get_context("spawn")
_OF_THE_GROUP = (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP, signal.SIGTERM, signal.SIGTSTP)
# A child without a handler for it yet simply ends.
STOP = signal.SIGUSR1
_CONNECT_S = 30

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


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
    """

    def __init__(self, name: str, target: str, args: tuple[Any, ...], nice: int) -> None:
        self.name = name
        self._process = _CONTEXT.Process(
            target=_main, args=(target, args, nice), name=name, daemon=True
        )

    def start(self) -> None:
        """Start the child without waiting."""
        resource_tracker.ensure_running()  # which unblocks signals when it starts
        try:
            with _group_blocked():
                self._process.start()
        except BaseException:  # a signal arrived, and the caller does not know the child yet
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


class Program:
    """One of our commands as a child: in a process group of its own, its output appended to a file
    of its user.

    With the option `--with-hold` it ends when this process dies (`end_with_parent`). A command that
    cannot be started counts as one that has ended.
    """

    def __init__(self, name: str, arguments: Sequence[str], log: Path, nice: int) -> None:
        self.name = name
        self._arguments, self._log, self._nice = arguments, log, nice
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the program without waiting."""
        program = [sys.executable, "-m", "membrane_ctrl", *self._arguments]
        stdin = subprocess.PIPE if "--with-hold" in self._arguments else subprocess.DEVNULL
        with contextlib.suppress(OSError), _appending(self._log) as log:
            self._process = subprocess.Popen(
                program, stdin=stdin, stdout=log, stderr=log, process_group=0
            )
            os.setpriority(os.PRIO_PROCESS, self._process.pid, self._nice)

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
        return None if self._process is None else self._process.returncode

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
def _appending(log: Path) -> Iterator[int]:
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
    """End this program with SIGTERM when its standard input closes: the `Program` that started it
    has died.
    """

    def wait() -> None:
        while os.read(0, 1024):  # not `sys.stdin`: its lock would abort the interpreter's end
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, name="parent", daemon=True).start()


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


def _main(target: str, args: tuple[Any, ...], nice: int) -> None:
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
        code = leaving.code if isinstance(leaving.code, int) else int(leaving.code is not None)
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


def pipe() -> Any:
    """Make a two-way pipe between this process and a child."""
    return _CONTEXT.Pipe()


def reporter(status: Connection | None) -> Callable[[events.Event], None]:
    """Return a function that sends an event over `status`, or drops it if the pipe is full; it
    never waits.
    """
    if status is None:
        return lambda event: None
    os.set_blocking(status.fileno(), False)

    def report(event: events.Event) -> None:
        try:
            status.send({key: _short(value) for key, value in event.to_dict().items()})
        except OSError:  # full, or closed at the other end
            return

    return report


def _short(value: Any) -> Any:
    """Shorten a message so that a pipe takes it whole or not at all."""
    return value[:1000] if isinstance(value, str) else value


def raise_priority() -> str:
    """Give this process, but not its children, a real-time class; returns "real-time" or
    "ordinary".

    A tick takes about 2 % of a core, and the kernel reserves 5 % of each second for ordinary
    processes. Without permission (root, CAP_SYS_NICE, or `LimitRTPRIO=` of the service) nothing
    changes.
    """
    try:
        # the lowest real-time priority: above every ordinary process, below the kernel's own
        # threads
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    except (OSError, AttributeError):  # not permitted, or not Linux
        return "ordinary"
    return "real-time"


@contextlib.contextmanager
def results_of(
    job: Callable[[_Item], _Result],
    items: Sequence[_Item],
    workers: int = 1,
    scheduler: str | None = None,
) -> Iterator[Iterable[_Result]]:
    """Results of a job for each item, in order: in this process, on processes, or on a Dask cluster
    instead.

    Raises InputError if Dask is not installed or its address is wrong, DeviceError if it does not
    answer or a worker was killed.
    """
    if scheduler is not None:
        with _dask_client(scheduler) as client:
            yield (future.result() for future in client.map(job, items, pure=False))
    elif workers > 1:
        from concurrent.futures.process import BrokenProcessPool, ProcessPoolExecutor

        try:
            with ProcessPoolExecutor(workers, mp_context=_CONTEXT) as pool:
                yield pool.map(job, items)
        except BrokenProcessPool:
            raise errors.DeviceError(
                "a worker was killed, perhaps for want of memory; use fewer --workers"
            ) from None
    else:
        yield map(job, items)


def _dask_client(address: str) -> Any:
    try:
        distributed = importlib.import_module("distributed")
    except ImportError:
        text = (
            "--scheduler: Dask is not installed; install the extra `dask` (pip install "
            "'membrane-ctrl[dask]')"
        )
        raise errors.InputError(text) from None
    try:
        return distributed.Client(address, timeout=_CONNECT_S)
    except ValueError as error:
        raise errors.InputError(f"--scheduler {address}: {error}") from None
    except OSError as error:  # includes time-outs
        raise errors.DeviceError(f"--scheduler {address}: does not answer ({error})") from None
