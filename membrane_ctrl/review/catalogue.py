"""The catalogue of runs: lists and filters them, and finds one by its name."""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from membrane_ctrl.model import acquisition_events, errors, events, files, run_events
from membrane_ctrl.model.standing_fault import fault_of_end, standing_fault_after
from membrane_ctrl.run_files import (
    event_log,
    retention,
    run_config,
    run_lookup,
    summary_file,
    table_specs,
)
from membrane_ctrl.run_files.run import origin_of
from membrane_ctrl.run_files.table_store.reader import TableReader

# A file of this name in a run's folder keeps it from being pruned.
KEPT_FILE = ".keep"
_LEVEL_S = 1.0


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
    geometry: str  # hash of the last one in use; empty without a camera
    held_s: float = math.nan  # these are the parts of a run by `hold_parts.HoldParts`
    faults_s: float = math.nan
    paused_s: float = math.nan
    moving_s: float = math.nan
    # flow against its configured curve as last learned, and one standard error
    pump_scale: float = math.nan
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

    def accepts_entry(self, entry: RunEntry) -> bool:
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


def list_entries(logs_dir: Path, wanted: Filter | None = None) -> list[RunEntry]:
    """List the runs of a folder, oldest first.

    Parameters
    ----------
    logs_dir : Path
        Folder of the runs.
    wanted : Filter or None
        Criteria of the runs to list; None: all.

    Returns
    -------
    list of RunEntry
        A run that cannot be read has an entry whose `exit` gives the reason.

    Raises
    ------
    InputError
        There is no such folder.
    """
    require_folder(logs_dir)
    found = [_entry_or_why(folder) for folder in list_run_folders(logs_dir)]
    return [item for item in found if wanted is None or wanted.accepts_entry(item)]


def require_folder(logs_dir: Path) -> None:
    """Raise InputError if the folder of the runs does not exist."""
    if not logs_dir.is_dir():
        raise errors.InputError(
            f"{logs_dir}: no such folder; give the folder of the runs with --logs"
        )


def _entry_or_why(folder: Path) -> RunEntry:
    """An entry; an unreadable folder gives a line that states it, not an error."""
    try:
        return read_entry(folder)
    except OSError as error:
        began = origin_of(folder, ())
        why = f"cannot be read ({errors.os_reason(error)})"
        nan = math.nan
        return RunEntry(folder, began, nan, nan, nan, 0, why, nan, nan, "", nan, 0, False, "")


def read_entry(folder: Path) -> RunEntry:
    """One run's line, from its small files only; without a summary, also from the end of its 1 s
    level.
    """
    notes: list[str] = []
    log = event_log.read_events(folder, notes)
    summary: dict[str, Any] = summary_file.read_summary(folder, notes) or {}
    config = run_config.read_config(folder, notes)
    stored = summary.get("held")
    duration_s = _read_number(summary.get("duration_s"))
    held = stored if isinstance(stored, dict) else {}
    # A run that was killed has no summary
    if not math.isfinite(duration_s):
        duration_s = _recorded_s(folder)
    # The last learned pump and the geometry in use
    newest_first = [each.event for each in reversed(log)]
    pump = next((e for e in newest_first if isinstance(e, events.PumpLearned)), None)
    geometries = (e for e in newest_first if isinstance(e, acquisition_events.GeometryInUse))
    geometry = next(geometries, None)
    return RunEntry(
        folder=folder,
        started_utc=origin_of(folder, log),
        duration_s=duration_s,
        std_um=_read_number(held.get("std_um")),
        in_band=_read_number(held.get("in_band")),
        faults=sum(isinstance(each.event, events.Fault) for each in log),
        exit=str(summary.get("exit", "open")),
        kp_per_s=config.loop.kp_per_s,
        ti_s=config.loop.ti_s,
        configuration=_read_hash(folder / "config.toml"),
        size_mb=retention.size_bytes(folder) / 1e6,
        marks=sum(isinstance(each.event, run_events.Mark) for each in log),
        kept=(folder / KEPT_FILE).exists(),
        geometry="" if geometry is None else geometry.hash,
        held_s=_read_number(held.get("held_s")),
        faults_s=_read_number(held.get("faults_s")),
        paused_s=_read_number(held.get("paused_s")),
        moving_s=_read_number(held.get("moving_s")),
        pump_scale=math.nan if pump is None else _read_number(pump.scale),
        pump_sigma=math.nan if pump is None else _read_number(pump.sigma),
        ended_in=_fault_of_end(log, summary.get("exit")),
    )


def resolve_run(run: str | Path, logs_dir: str | Path = "logs") -> Path:
    """Return the folder of a run.

    Raises InputError if no run, or more than one, matches.

    Parameters
    ----------
    run : str or Path
        A path; a run's name or a part of it, below the logs; or `last`.
    logs_dir : str or Path
        Folder of the runs.
    """
    run = Path(run)
    logs_dir = Path(logs_dir)
    if run.exists() or not logs_dir.is_dir():
        return run
    known = list_run_folders(logs_dir)
    if str(run) == "last" and known:
        return known[-1]
    near = [folder for folder in known if folder.name == str(run)]
    near = near or [folder for folder in known if str(run) in folder.name]
    if len(near) > 1:
        raise errors.InputError(
            f"{run}: several runs match: {', '.join(folder.name for folder in near[:4])}"
        )
    return near[0] if near else run


def list_run_folders(logs_dir: Path) -> list[Path]:
    """The folders of runs, by name; hidden ones are remains of deleted runs."""
    return [
        folder
        for folder in sorted(logs_dir.iterdir())
        if not folder.name.startswith(".") and may_be_run(folder)
    ]


def may_be_run(folder: Path) -> bool:
    """Whether a folder is a run, as far as can be seen."""
    try:
        return run_lookup.is_run(folder)
    except OSError:  # unreadable: unknown whether it is a run
        return True


def as_dict(run: RunEntry) -> dict[str, Any]:
    """An entry as plain data."""
    texts = {"folder": str(run.folder), "started_utc": run.started_utc.isoformat()}
    return {"name": run.name} | asdict(run) | texts


def _fault_of_end(log: Sequence[event_log.LoggedEvent], exit_: object) -> str:
    """Name of the fault in which a run ended, or is; empty without one."""
    standing: events.Fault | None = None
    for each in log:
        standing = standing_fault_after(standing, each.event)
    fault = fault_of_end(standing, exit_ if isinstance(exit_, str) else None)
    return "" if fault is None else fault.name


def _recorded_s(folder: Path) -> float:
    """End of a run's 1 s level."""
    newest = TableReader(folder, table_specs.LEVELS[_LEVEL_S], []).read_newest("time_s")
    if newest is None:
        return math.nan
    return float(newest.as_py()) + _LEVEL_S


def _read_number(value: object) -> float:
    if not isinstance(value, (int, float)):
        return math.nan
    return float(value)


def _read_hash(path: Path) -> str:
    try:
        return hashlib.sha256(files.read_bytes(path, files.SMALL_BYTES)).hexdigest()[:8]
    except OSError:
        return ""
