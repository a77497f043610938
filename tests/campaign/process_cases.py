"""Faults of real processes: what is done to a hold, and what must follow."""

from __future__ import annotations

import asyncio
import contextlib
import resource
import signal
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from campaign_bench import Run

from membrane_ctrl.model.errors import Exit

UPSET = Path(__file__).parent / "upset"
HANG_S = 3.0
WALL_CLOCK = "wall-clock-step"  # a file that says by how many seconds it is off
CLOCK, DISK = "a wall clock of its own", "a small disk"
_DAY_S = 86_400
# The board has stopped the pump by itself; the first tick afterwards finds one of these.
_STOPPED = (
    "watchdog_tripped",
    "board_fault",
    "device_silent",
    "displacement_frozen",
    "late",
    "displacement_missing",
)
_CUT = ("link_lost",)
_QUIET = ("device_silent", "link_lost", "displacement_missing")


@dataclass(frozen=True, slots=True)
class ProcessCase:
    """One fault of the processes of a hold, or two at once.

    Attributes
    ----------
    act : callable
        Does it, and waits for what must follow; undoes it where the rest of the run needs that.
    exit : int
        Exit code; for a run that a safety trip does not end, that of the interruption at the end.
    faults : tuple of str
        What the first cause may be called; empty: nothing may trip.
    stops_pump : bool
        The board must have stopped the pump within its watchdog period.
    lost_s : float
        Telemetry that may be lost.
    needs : str
        `CLOCK` or `DISK`, which not every machine gives.
    """

    name: str
    act: Callable[[Run], Awaitable[None]]
    exit: int = Exit.INTERRUPTED
    faults: tuple[str, ...] = ()
    stops_pump: bool = False
    lost_s: float = 0.0
    needs: str = ""


async def stop_control(run: Run) -> None:
    run.signal(signal.SIGSTOP)
    await asyncio.sleep(HANG_S)
    run.signal(signal.SIGCONT)


async def kill_control(run: Run) -> None:
    run.signal(signal.SIGKILL)


async def hang_loop(run: Run) -> None:
    run.signal(signal.SIGUSR1)
    await asyncio.sleep(HANG_S)


async def kill_recorder(run: Run) -> None:
    run.recorder().kill()
    await run.until(lambda: run.happened("child_restarted", child="recorder"))


async def stop_recorder(run: Run) -> None:
    run.recorder().suspend()
    await run.until(lambda: run.happened("child_restarted", child="recorder"))
    assert run.happened("child_silent", child="recorder", killed=True)


async def slow_disk(run: Run) -> None:
    """A disk that takes 10 s for a second of data: seen from outside, the recorder stops and
    continues.
    """
    recorder = run.recorder()
    recorder.suspend()
    await asyncio.sleep(10.0)
    recorder.resume()
    await asyncio.sleep(2.0)
    assert not run.happened("child_silent")


async def full_disk(run: Run) -> None:
    with filled(run.folder / "logs"):
        await asyncio.sleep(8.0)
        assert run.plant.pumping
    await run.until(lambda: run.happened("recorder_recovered"))


async def full_file(run: Run) -> None:
    """No file of the recorder may grow: what a quota does."""
    pid = run.recorder().pid
    limits = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, limits[1]))
    await asyncio.sleep(6.0)
    assert run.plant.pumping
    resource.prlimit(pid, resource.RLIMIT_FSIZE, limits)
    await run.until(lambda: run.happened("recorder_recovered"))


async def power_cycle(run: Run) -> None:
    run.board.power_cycle()


async def cut_network(run: Run) -> None:
    run.board.faults.hang_up = True
    await run.until(lambda: not run.plant.pumping)
    run.board.faults.hang_up = False


async def silence_board(run: Run) -> None:
    run.board.faults.silent = True
    await run.until(lambda: not run.plant.pumping)
    run.board.faults.silent = False


async def unplug_laser(run: Run) -> None:
    run.board.faults.no_displacement = True
    await run.until(lambda: not run.plant.pumping)


def step_clock(seconds: int) -> Callable[[Run], Awaitable[None]]:
    async def act(run: Run) -> None:
        (run.folder / WALL_CLOCK).write_text(str(seconds))
        await asyncio.sleep(4.0)
        assert run.plant.pumping

    return act


async def recorder_killed_and_network_cut(run: Run) -> None:
    run.recorder().kill()
    await cut_network(run)


async def clock_stepped_and_loop_hangs(run: Run) -> None:
    (run.folder / WALL_CLOCK).write_text(str(-_DAY_S))
    await hang_loop(run)


async def full_disk_and_no_laser(run: Run) -> None:
    with filled(run.folder / "logs"):
        await unplug_laser(run)


async def kill_both(run: Run) -> None:
    recorder = run.recorder()
    run.signal(signal.SIGKILL)
    recorder.kill()
    await asyncio.sleep(6.0)  # `repair` takes a run that changed within 5 s for one in progress


async def stopped_recorder_and_power_cycle(run: Run) -> None:
    run.recorder().suspend()
    run.board.power_cycle()


@contextlib.contextmanager
def filled(folder: Path) -> Iterator[None]:
    """A disk without a byte left."""
    filler = folder / ".filler"
    try:
        with filler.open("wb", buffering=0) as file, contextlib.suppress(OSError):
            while True:
                file.write(bytes(1 << 12))
        yield
    finally:
        filler.unlink()


TRIP = int(Exit.SAFETY_TRIP)
PROCESS_CASES: tuple[ProcessCase, ...] = (
    ProcessCase("control process stopped for 3 s", stop_control, TRIP, _STOPPED, stops_pump=True),
    # a tick that was late at the kill is no telemetry
    ProcessCase(
        "control process killed", kill_control, -signal.SIGKILL, stops_pump=True, lost_s=0.1
    ),
    ProcessCase("event loop hangs for 3 s", hang_loop, TRIP, _STOPPED, stops_pump=True),
    ProcessCase("recorder killed", kill_recorder),
    ProcessCase("recorder stopped", stop_recorder),
    ProcessCase("slow disk: recorder stands for 10 s", slow_disk),
    ProcessCase("disk full for 8 s", full_disk, lost_s=10.0, needs=DISK),
    ProcessCase("recorder's files may not grow for 6 s", full_file, lost_s=8.0),
    ProcessCase("board loses its power", power_cycle, TRIP, _CUT),
    ProcessCase("network cut", cut_network, TRIP, _CUT),
    ProcessCase("board does not answer", silence_board, TRIP, _QUIET),
    ProcessCase("laser unplugged", unplug_laser, TRIP, ("displacement_missing",)),
    ProcessCase("wall clock a day ahead", step_clock(_DAY_S), needs=CLOCK),
    ProcessCase("wall clock a day back", step_clock(-_DAY_S), needs=CLOCK),
    ProcessCase("recorder killed, network cut", recorder_killed_and_network_cut, TRIP, _CUT),
    ProcessCase(
        "recorder stopped, board loses its power", stopped_recorder_and_power_cycle, TRIP, _CUT
    ),
    ProcessCase(
        "control process and recorder killed",
        kill_both,
        -signal.SIGKILL,
        stops_pump=True,
        lost_s=1.5,
    ),
    ProcessCase(
        "wall clock a day back, event loop hangs",
        clock_stepped_and_loop_hangs,
        TRIP,
        _STOPPED,
        True,
        needs=CLOCK,
    ),
    ProcessCase(
        "disk full, laser unplugged",
        full_disk_and_no_laser,
        TRIP,
        ("displacement_missing",),
        lost_s=10.0,
        needs=DISK,
    ),
)
