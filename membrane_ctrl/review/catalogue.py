"""The catalogue of runs: list, filter, show, prune; a run, and a time of it, as people write and
read them.
"""

import contextlib
import hashlib
import math
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from membrane_ctrl.model import errors, events, files, run_events
from membrane_ctrl.model.arrays import Column
from membrane_ctrl.model.clock import parse_duration_s
from membrane_ctrl.model.standing_fault import fault_of_end, standing_fault_after
from membrane_ctrl.run_files import disk_budget, run_folder, table_specs
from membrane_ctrl.run_files.run import Run, origin_of
from membrane_ctrl.run_files.table_store.reader import TableReader

# A file of this name in a run's folder keeps it from being pruned.
KEPT_FILE = ".keep"
_LEVEL_S = 1.0
_POINTS = 80  # of a run's small line


@dataclass(frozen=True, slots=True)
class RunEntry:
    """One line of the catalogue."""

    folder: Path
    started_utc: datetime
    # up to the end of its tables if in progress or if its recorder was killed; NaN without tables
    duration_s: float
    # of 1 s means of the settled hold: of the true centre on the twin, else of the reading
    std_um: float
    in_band: float  # share of these within the band
    faults: int
    exit: str  # "done", "trip", ...; "open" without a summary
    kp_per_s: float
    ti_s: float
    configuration: str  # first 8 digits of the SHA-256 of `config.toml`
    size_mb: float
    marks: int  # annotations
    kept: bool  # the folder has a file `.keep` and is never pruned
    geometry: str  # hash of the last one in force; empty without a camera
    held_s: float = math.nan  # these are the parts of a run as `hold_parts.HoldParts` tells them
    faults_s: float = math.nan
    paused_s: float = math.nan
    moving_s: float = math.nan
    pump_scale: float = (
        math.nan
    )  # flow against its configured curve as last learned, and one standard error
    pump_sigma: float = math.nan
    ended_in: str = ""  # name of the fault in which the run ended, or is; empty without one

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.folder.name


@dataclass(frozen=True, slots=True)
class Filter:
    """Criteria for runs; None: any."""

    since_utc: datetime | None = None
    until_utc: datetime | None = None
    least_s: float | None = None
    most_std_um: float | None = None
    with_faults: bool | None = None
    configuration: str | None = None
    text: str | None = None

    def takes(self, entry: RunEntry) -> bool:
        """Whether an entry meets the criteria."""
        return (
            (self.since_utc is None or entry.started_utc >= self.since_utc)
            and (self.until_utc is None or entry.started_utc < self.until_utc)
            and (self.least_s is None or entry.duration_s >= self.least_s)
            and (self.most_std_um is None or entry.std_um <= self.most_std_um)
            and (self.with_faults is None or (entry.faults > 0) == self.with_faults)
            and (
                self.configuration is None
                or entry.configuration.startswith(self.configuration.lower())
            )
            and (self.text is None or self.text in entry.name)
        )


def entries(logs_dir: Path, wanted: Filter | None = None) -> list[RunEntry]:
    """The runs of a folder, oldest first. Raises InputError if there is no such folder."""
    _require_folder(logs_dir)
    found = [_entry_or_why(folder) for folder in folders(logs_dir)]
    return [item for item in found if wanted is None or wanted.takes(item)]


def _require_folder(logs_dir: Path) -> None:
    if not logs_dir.is_dir():
        raise errors.InputError(
            f"{logs_dir}: no such folder; give the folder of the runs with --logs"
        )


def _entry_or_why(folder: Path) -> RunEntry:
    """An entry; an unreadable folder gives a line that says so, not an error."""
    try:
        return entry(folder)
    except OSError as error:
        began, why = origin_of(folder, ()), f"cannot be read ({errors.os_reason(error)})"
        nan = math.nan
        return RunEntry(folder, began, nan, nan, nan, 0, why, nan, nan, "", nan, 0, False, "")


def entry(folder: Path) -> RunEntry:
    """One run's line, from its small files only; without a summary, also from the end of its 1 s
    level.
    """
    notes: list[str] = []
    log = run_folder.read_events(folder, notes)
    summary: dict[str, Any] = run_folder.read_summary(folder, notes) or {}
    config = run_folder.read_config(folder, notes)
    told, duration_s = summary.get("held"), _number(summary.get("duration_s"))
    held = told if isinstance(told, dict) else {}
    pump = next(
        (each.event for each in reversed(log) if isinstance(each.event, events.PumpLearned)), None
    )
    return RunEntry(
        folder=folder,
        started_utc=origin_of(folder, log),
        duration_s=duration_s if math.isfinite(duration_s) else _recorded_s(folder),
        std_um=_number(held.get("std_um")),
        in_band=_number(held.get("in_band")),
        faults=sum(isinstance(each.event, events.Fault) for each in log),
        exit=str(summary.get("exit", "open")),
        kp_per_s=config.loop.kp_per_s,
        ti_s=config.loop.ti_s,
        configuration=_hash(folder / "config.toml"),
        size_mb=disk_budget.size_bytes(folder) / 1e6,
        marks=sum(isinstance(each.event, run_events.Mark) for each in log),
        kept=(folder / KEPT_FILE).exists(),
        geometry=next(
            (
                e.event.hash
                for e in reversed(log)
                if isinstance(e.event, run_events.GeometryInForce)
            ),
            "",
        ),
        **{
            name: _number(held.get(name)) for name in ("held_s", "faults_s", "paused_s", "moving_s")
        },
        pump_scale=math.nan if pump is None else _number(pump.scale),
        pump_sigma=math.nan if pump is None else _number(pump.sigma),
        ended_in=_fault_of_end(log, summary.get("exit")),
    )


def resolve(run: str | Path, logs_dir: str | Path = "logs") -> Path:
    """Find the run's folder: a path; a run's name, or the end of it, below `logs`; or `last`.

    Raises InputError if no run, or more than one, matches.
    """
    run, logs_dir = Path(run), Path(logs_dir)
    if run.exists() or not logs_dir.is_dir():
        return run
    known = folders(logs_dir)
    if str(run) == "last" and known:
        return known[-1]
    near = [folder for folder in known if folder.name == str(run)]
    near = near or [folder for folder in known if str(run) in folder.name]
    if len(near) > 1:
        raise errors.InputError(
            f"{run}: several runs match: {', '.join(folder.name for folder in near[:4])}"
        )
    return near[0] if near else run


def folders(logs_dir: Path) -> list[Path]:
    """The folders of runs, by name; hidden ones are remains of deleted runs."""
    return [
        folder
        for folder in sorted(logs_dir.iterdir())
        if not folder.name.startswith(".") and may_be_run(folder)
    ]


def may_be_run(folder: Path) -> bool:
    """Whether a folder is a run, as far as can be told."""
    try:
        return run_folder.is_run(folder)
    except OSError:  # unreadable: unknown whether it is a run
        return True


def to_prune(
    logs_dir: Path, now_utc: datetime, keep_days: float | None, keep_gb: float | None
) -> list[tuple[disk_budget.OldRun, str]]:
    """The runs that the recorder's retention rule (`disk_budget`) would delete, and why; oldest
    first.
    """
    _require_folder(logs_dir)
    if keep_days is None and keep_gb is None:
        raise errors.InputError("runs prune: give --keep-days, --keep-gb or both")
    runs = disk_budget.deletable_runs(logs_dir, logs_dir / "none", now_utc)
    return disk_budget.expired(runs, 0, keep_gb, keep_days, now_utc)


def prune(runs: Sequence[disk_budget.OldRun]) -> dict[Path, str]:
    """Delete the folders of runs, skipping undeletable ones. Returns those that stay, and why."""
    stay: dict[Path, str] = {}
    for run in runs:
        try:
            disk_budget.delete_run(run)
        except OSError as error:
            stay[run.folder] = errors.os_reason(error)
    return stay


def as_dict(run: RunEntry) -> dict[str, Any]:
    """An entry as plain data."""
    texts = {"folder": str(run.folder), "started_utc": run.started_utc.isoformat()}
    return {"name": run.name} | asdict(run) | texts


def _fault_of_end(log: Sequence[run_folder.LoggedEvent], exit_: object) -> str:
    """Name of the fault in which a run ended, or is; empty without one."""
    standing: events.Fault | None = None
    for each in log:
        standing = standing_fault_after(standing, each.event)
    fault = fault_of_end(standing, exit_ if isinstance(exit_, str) else None)
    return "" if fault is None else fault.name


def _recorded_s(folder: Path) -> float:
    """End of a run's 1 s level."""
    newest = TableReader(folder, table_specs.LEVELS[_LEVEL_S], []).newest("time_s")
    return math.nan if newest is None else float(newest.as_py()) + _LEVEL_S


def _number(value: object) -> float:
    return float(value) if isinstance(value, (int, float)) else math.nan


def _hash(path: Path) -> str:
    try:
        return hashlib.sha256(files.read_bytes(path, files.SMALL_BYTES)).hexdigest()[:8]
    except OSError:
        return ""


_END_LEVEL_S = 60.0


def span(seconds: float) -> str:
    """A duration: `41 s`, `30 min 5 s`, `7 h 59 min`, `30 d 4 h`."""
    if not math.isfinite(seconds):
        return "?"
    whole = round(seconds)
    for large, small, unit, part in (
        (86400, 3600, "d", "h"),
        (3600, 60, "h", "min"),
        (60, 1, "min", "s"),
    ):
        if whole >= large:
            rest = whole % large // small
            return f"{whole // large} {unit}" + (f" {rest} {part}" if rest else "")
    return f"{whole} s"


def number(value: float | None, digits: int = 3) -> str:
    """A number to the given digits; a dash for none."""
    if value is None or not math.isfinite(value):
        return "–"
    return f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:.0f}"


def one_line(text: str) -> str:
    """A person's text in one line: spaces replace line ends and other unprintable characters."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


def moment_s(text: str, origin_utc: datetime) -> float:
    """Seconds of the run for a written time: `03:12[:30]` (UTC), ISO 8601, or `+90s`, `+1h5m` from
    its start.

    A time of day means its first occurrence after the start of the run. The plus sign may be
    omitted.

    Raises InputError if it is none of these.
    """
    text = text.strip()
    if re.fullmatch(r"\+? *0+[dhms]?", text):  # the start, which is not a valid duration
        return 0.0
    if text.startswith("+"):
        return parse_duration_s(text[1:])
    clock = re.fullmatch(r"(\d{1,2}):(\d{2})(?::([0-5]\d(?:\.\d+)?))?", text)
    try:
        if clock:
            day = origin_utc.replace(
                hour=int(clock[1]), minute=int(clock[2]), second=0, microsecond=0
            )
            moment = day + timedelta(seconds=float(clock[3] or 0))
            # this means the minute in which the run began, not the one of the next day
            if moment < origin_utc - timedelta(seconds=60):
                moment += timedelta(days=1)
        else:
            moment = datetime.fromisoformat(text)
            moment = moment if moment.tzinfo else moment.replace(tzinfo=origin_utc.tzinfo)
    except ValueError:
        with contextlib.suppress(errors.InputError):
            return parse_duration_s(text)
        raise errors.InputError(
            f"time {text!r}: write 03:12, 2026-11-21T03:12:00 or +90m from the start (UTC)"
        ) from None
    return (moment - origin_utc).total_seconds()


def part_s(origin_utc: datetime, start: str | None, end: str | None) -> tuple[float, float]:
    """The part of a run between two written times; None: unlimited. Raises InputError."""
    start_s = -math.inf if start is None else moment_s(start, origin_utc)
    until_s = math.inf if end is None else moment_s(end, origin_utc)
    if not start_s < until_s:
        raise errors.InputError(f"--from {start} is not before --to {end}")
    return start_s, until_s


def end_s(run: Run) -> float:
    """End of a run's data, in seconds from its start, rounded up to whole minutes;
    0 without data.
    """
    time_s = run.level(_END_LEVEL_S, names=("rows",))["time_s"]
    return float(time_s[-1]) + _END_LEVEL_S if time_s.size else 0.0


def not_in(run: Run, asked: str) -> errors.InputError:
    """The error for a time outside a run."""
    went = f"{run.utc(0):%Y-%m-%d %H:%M} to {run.utc(end_s(run)):%Y-%m-%d %H:%M} UTC"
    return errors.InputError(f"{asked}: not in the run, which lasted from {went}")


# Every hold starts with some seconds that do not count; more means a ramping setpoint.
_MOVING_LEAST_S = 60.0


def beside(faults_s: float, paused_s: float, moving_s: float, whole_s: float) -> list[str]:
    """What there was beside the hold, with its share of the whole time; NaN where that is not
    known.
    """
    parts = (
        ("faults", faults_s, 0.0),
        ("paused", paused_s, 0.0),
        ("moving or settling", moving_s, _MOVING_LEAST_S),
    )
    told = [(name, time_s) for name, time_s, least_s in parts if time_s > least_s]
    return [
        f"{name} {span(time_s)} ({100 * time_s / max(whole_s, time_s):.3g} %)"
        for name, time_s in told
    ]


def sparkline(values: Sequence[float] | Column, width: int = 160, height: int = 28) -> str:
    """A small SVG line; gaps where values are missing."""
    y = np.asarray(values, dtype=np.float64)
    if y.size > _POINTS:
        y = np.array([part.mean() for part in np.array_split(y, _POINTS)])
    known = np.isfinite(y)
    if known.sum() < 2:
        return ""
    low, high = y[known].min(), y[known].max()
    rows = height - 3 - (y - low) / max(high - low, 1e-12) * (height - 6)
    columns = np.arange(y.size) * width / max(y.size - 1, 1)
    path = " ".join(
        f"{'L' if place and known[place - 1] else 'M'}{column:.1f},{row:.1f}"
        for place, (column, row) in enumerate(zip(columns, rows, strict=True))
        if known[place]
    )
    return (
        f'<svg width="{width}" height="{height}" viewBox="0 0 {width} {height}" role="img">'
        f'<path d="{path}" fill="none" stroke="currentColor" stroke-width="1.2"/></svg>'
    )
