"""One fault of real processes: a hold against the emulated board,
and what must be true afterwards.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import shutil
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from campaign_bench import PATIENCE_S, WATCHDOG_S, Run, WatchedPlant, make_plant, running
from process_cases import CLOCK, DISK, HANG_S, UPSET, WALL_CLOCK, ProcessCase

from membrane_ctrl.config.schema import LimitsConfig
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.replay.repair import repair_run
from membrane_ctrl.run_files.latched_fault import LatchedFile
from membrane_ctrl.run_files.run import open_run

RATE_HZ = 50.0
_SMALL_DISK_MB = 24
_GAUGE_SLACK_PA = 1.5  # three sigma of the gauge


@dataclass(frozen=True, slots=True)
class ProcessResult:
    """Result of a case.

    Attributes
    ----------
    exit : str
        As the summary has it.
    cause : str
        The first cause; empty: nothing tripped.
    pump_s : float
        From the fault until the board's pump stood; NaN if it went on.
    lost_s : float
        Telemetry that is in no table.
    restarts : int
        Of the recorder.
    violations : tuple of str
    """

    name: str
    exit: str
    cause: str
    pump_s: float
    lost_s: float
    restarts: int
    violations: tuple[str, ...]


def missing(case: ProcessCase) -> str:
    """Why this machine cannot run the case; empty if it can."""
    if case.needs == CLOCK and shutil.which("cc") is None:
        return "no C compiler for the preloaded wall clock"
    if (
        case.needs == DISK
        and subprocess.run(["unshare", "-m", "true"], capture_output=True, check=False).returncode
    ):
        return "no right to mount a small disk"
    return ""


async def run_process_case(case: ProcessCase, folder: Path) -> ProcessResult:
    """Run it, and check everything it left."""
    plant = make_plant()
    environment = {"PYTHONPATH": str(UPSET), "HANG_S": str(HANG_S)}
    if case.needs == CLOCK:
        environment |= wall_clock(folder)
    with small_disk(folder / "logs") if case.needs == DISK else contextlib.nullcontext():
        async with running(folder, plant, "[recording]\nmin_free_mb = 1\n", environment) as run:
            since_s = time.monotonic()
            await case.act(run)
            pump_s = await pump_stood_s(plant, since_s) if case.stops_pump else math.nan
            if case.exit == Exit.INTERRUPTED:
                run.process.send_signal(2)
            code = await run.ended()
        return judged(case, run, code, pump_s)


async def pump_stood_s(plant: WatchedPlant, since_s: float) -> float:
    """How long after the fault the board's pump ran."""
    give_up_s = time.monotonic() + PATIENCE_S
    while not any(o.time_s > since_s and o.pump_fraction == 0 for o in plant.outputs):
        assert time.monotonic() < give_up_s, "the pump was never stopped"
        await asyncio.sleep(0.02)
    return plant.pump_ran_on_s(since_s)


def judged(case: ProcessCase, run: Run, code: int, pump_s: float) -> ProcessResult:
    """The invariants, on what the run has left."""
    (run_dir,) = (path for path in (run.folder / "logs").iterdir() if path.is_dir())
    if not (
        run_dir / "summary.json"
    ).exists():  # controller and recorder are dead: a person repairs it
        repair_run(run_dir)
    summary = json.loads((run_dir / "summary.json").read_text())
    faults = run.faults()
    cause = faults[0] if faults else ""
    latched = LatchedFile(run.folder / "logs").read()
    lost_s = lost_telemetry_s(run_dir, run.killed_utc_s)
    checks = {
        f"exit {code} in place of {case.exit}": code == case.exit,
        f"first cause {cause!r}": cause in case.faults if case.faults else not cause,
        f"pump ran on for {pump_s:.2f} s": not case.stops_pump
        or pump_s <= WATCHDOG_S + 2 * run.plant.longest_gap_s,
        "the pump runs after the end": not run.plant.pumping,
        "latched file": (latched is not None) == (case.exit == Exit.SAFETY_TRIP),
        f"latched as {latched and latched.name!r}": latched is None or latched.name == cause,
        f"{lost_s:.2f} s of telemetry lost": lost_s <= case.lost_s,
        "deeper than the limit": run.plant.displacement_max_um
        <= LimitsConfig().displacement_max_um,
        "pressure above the limit": run.plant.gauge_pressure_max_pa
        <= LimitsConfig().gauge_pressure_max_pa + _GAUGE_SLACK_PA,
        "no segment can be opened": any(run_dir.glob("*.rrd")),
        "moments in UTC and in seconds of the run part": utc_is_steady(run),
    }
    violations = tuple(what for what, holds in checks.items() if not holds)
    restarts = int((summary.get("recorder") or {}).get("restarts", 0))
    return ProcessResult(
        case.name, str(summary["exit"]), cause, pump_s, lost_s, restarts, violations
    )


def lost_telemetry_s(run_dir: Path, killed_utc_s: float | None = None) -> float:
    """Seconds of ticks missing in every table, up to the run's last tick or the kill."""
    run = open_run(run_dir)
    table = run.ticks(["tick"])
    ticks = table.column("tick").to_numpy()
    if not len(ticks):
        return math.inf
    ends = [
        json.loads(line)
        for line in (run_dir / "events.jsonl").read_text().splitlines()
        if '"end"' in line
    ]
    last = max([ticks[-1], *(event["ticks"] for event in ends if "ticks" in event)])
    assert len(np.unique(ticks)) == len(ticks), "a tick is there twice"
    gaps_s = float(last - len(ticks)) / RATE_HZ
    if killed_utc_s is None:
        return gaps_s
    killed_s = killed_utc_s - run.utc(0.0).timestamp()
    return gaps_s + max(0.0, killed_s - float(table.column("time_s")[-1].as_py()) - 1.0 / RATE_HZ)


def utc_is_steady(run: Run) -> bool:
    """Whether the events' UTC agrees with the run's own seconds, whatever the wall clock does."""
    from datetime import datetime

    starts = [
        datetime.fromisoformat(e["time_utc"]).timestamp() - e["mono_s"]
        for e in run.events
        if "mono_s" in e
    ]
    return max(starts) - min(starts) < 0.01


@contextlib.contextmanager
def small_disk(folder: Path) -> Iterator[None]:
    """A file system of some MB."""
    folder.mkdir()
    size = f"size={_SMALL_DISK_MB}m"
    subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", str(folder)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def wall_clock(folder: Path) -> dict[str, str]:
    """Environment of a process whose wall clock can be stepped by a file."""
    library = folder / "wall_clock.so"
    subprocess.run(
        ["cc", "-shared", "-fPIC", "-o", str(library), str(UPSET / "wall_clock.c"), "-ldl"],
        check=True,
    )
    return {"LD_PRELOAD": str(library), "WALL_CLOCK_STEP": str(folder / WALL_CLOCK)}


def process_table(results: list[ProcessResult]) -> list[str]:
    """The results as Markdown."""
    rows = [
        "| fault | ends | first cause | pump stood after | telemetry lost | recorder replaced |",
        "|---|" + "---|" * 5,
    ]
    for r in results:
        pump = "-" if math.isnan(r.pump_s) else f"{r.pump_s:.2f} s"
        bad = f" **{'; '.join(r.violations)}**" if r.violations else ""
        rows.append(
            f"| {r.name} | {r.exit} | {r.cause or '-'} | {pump} | {r.lost_s:.2f} s | "
            f"{r.restarts}{bad} |"
        )
    return rows
