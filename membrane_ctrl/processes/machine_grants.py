"""What this machine grants a process with deadlines: scheduling class, locked memory, processors,
clock.
"""

import ctypes
import os
import resource
from dataclasses import dataclass
from pathlib import Path

_CLOCK_SOURCE = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
# Of <sys/mman.h>
_MCL_CURRENT, _MCL_FUTURE = 1, 2
# Touched before the ticks, so that their first allocations cause no page faults.
_HEAP_BYTES = 16 << 20


@dataclass(frozen=True, slots=True)
class MachineGrants:
    """What a process may use.

    Attributes
    ----------
    scheduling : str
        Class and priority that `hold` gets.
    locked_bytes_most : int or None
        Memory that the process may lock; None without a limit.
    processors : tuple of int
        On which it may run.
    processors_all : int
        Of the machine.
    clock_source : str
        Of the kernel; empty if unknown. Reading `tsc` costs no system call.
    """

    scheduling: str
    locked_bytes_most: int | None
    processors: tuple[int, ...]
    processors_all: int
    clock_source: str

    @property
    def memory_words(self) -> str:
        """What may be locked, for people."""
        if self.locked_bytes_most is None:
            return "all of it may be locked"
        return (
            f"{self.locked_bytes_most / 2**20:.0f} MB may be locked, so nothing is: raise "
            "RLIMIT_MEMLOCK to unlimited (`LimitMEMLOCK=infinity` of the service)"
        )

    @property
    def processor_words(self) -> str:
        """On which processors the process may run, for people."""
        if len(self.processors) == self.processors_all:
            return f"all {self.processors_all}, shared with other programs"
        listed = ", ".join(map(str, self.processors))
        return f"{listed} of {self.processors_all}"


def find_grants() -> MachineGrants:
    """Ask the kernel; nothing changes."""
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    try:
        clock_source = _CLOCK_SOURCE.read_text().strip()
    except OSError:
        clock_source = ""
    return MachineGrants(
        scheduling=_find_scheduling(),
        locked_bytes_most=None if soft == resource.RLIM_INFINITY else soft,
        processors=tuple(sorted(os.sched_getaffinity(0))),
        processors_all=os.cpu_count() or 1,
        clock_source=clock_source,
    )


def _find_scheduling() -> str:
    """The class that a hold gets: this thread takes it for a moment if it may."""
    before, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except OSError:
        nice = os.getpriority(os.PRIO_PROCESS, 0)
        return f"ordinary, nice {nice}: real-time is not permitted (`LimitRTPRIO=`)"
    os.sched_setscheduler(0, before, parameters)
    return "real-time, priority 1"


def lock_memory() -> bool:
    """Touch memory for the ticks, and lock all that the process has and will have.

    Only without a limit: with one, an allocation beyond it would fail in the middle of a hold.
    Returns whether it is locked.
    """
    heap = bytearray(_HEAP_BYTES)
    for place in range(0, _HEAP_BYTES, resource.getpagesize()):
        heap[place] = 1
    del heap
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if soft != resource.RLIM_INFINITY:
        return False
    library = ctypes.CDLL(None, use_errno=True)
    return bool(library.mlockall(_MCL_CURRENT | _MCL_FUTURE) == 0)
