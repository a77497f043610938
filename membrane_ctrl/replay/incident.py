"""An incident: a recorded stretch of a run as a test, with the decisions that today's code takes in it.

`tests/incidents/<name>/` holds the run's configuration and inputs, and `incident.toml` with the decisions expected.
Where the incident shows that the controller decided wrongly, a person writes there what it should have decided: the
test then fails until it does.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tomli_w

from membrane_ctrl import __version__
from membrane_ctrl.config import toml_file as config_file
from membrane_ctrl.config.schema import Config
from membrane_ctrl.config.toml_file import load
from membrane_ctrl.controller.tick import TickBatch
from membrane_ctrl.model import errors, files, plain_json, shape_estimate, telemetry
from membrane_ctrl.model.run_events import from_dict
from membrane_ctrl.replay.replay import (
    Decision,
    Replay,
    decisions_of,
    without_repeats,
)
from membrane_ctrl.run_files import inputs_file, run_folder

# What a replay needs of a run folder: configuration, inputs, recorded decisions, recorded rows.


# A row is found in the recording by its time, which Rerun keeps in whole nanoseconds.
_SAME_TIME_S = 2e-9


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """A run folder, opened for a replay."""

    folder: Path
    config: Config
    inputs: inputs_file.InputsReader
    decisions: list[Decision]
    told_until_s: float  # the event log ends here, if a crash cut it
    config_damage: str = ""  # not the configuration that the run had

    def row_at(self, time_s: float) -> telemetry.TelemetryRow | None:
        """The row that was recorded then; None if the recording does not have it."""
        from membrane_ctrl.replay.repair import read_rows
        from membrane_ctrl.run_files.segments import FAULTS

        for path in sorted(self.folder.glob("*.rrd")):
            try:
                rows = read_rows(path)
            except FAULTS:
                continue
            near = np.flatnonzero(np.abs(rows[:, 0] - time_s) < _SAME_TIME_S)
            if near.size:
                values = rows[near[0]].tolist()
                return telemetry.TelemetryRow(time_s, *values[1:])
        return None


def open_run(folder: Path) -> RecordedRun:
    """Open a run. Raises InputError in one line that names the folder and what is missing."""
    if not (folder / "config.toml").is_file():
        raise errors.InputError(f"{folder}: not a run folder: there is no config.toml in it")
    inputs = inputs_file.InputsReader(folder)
    if not inputs.paths:
        raise errors.InputError(f"{folder}: no inputs-*.bin: this run was recorded without what a replay needs")
    events = run_folder.read_events(folder, [])
    cut = not any(event.get("kind") == "end" for event in events)
    decisions = decisions_of((run_folder.event_s(line), from_dict(line)) for line in events)
    told_until_s = max((run_folder.event_s(event) for event in events), default=0.0) if cut else math.inf
    config = load(folder / "config.toml", Config, follow=False)
    right = plain_json.comment_is_right(files.read_text(folder / "config.toml"))
    damage = "" if right else "config.toml: does not fit its checksum (damaged or edited)"
    return RecordedRun(folder, config, inputs, decisions, told_until_s, damage)


SCHEMA = "membrane-incident/1"
INCIDENTS = Path("tests/incidents")
_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")
# An incident lives in the repository: what is larger than this is a recording.
_BYTES_MAX = 4_000_000


def write_incident(
    run: RecordedRun, found: Replay, name: str, begin: int, to_s: float, incidents: Path = INCIDENTS
) -> Path:
    """Make a test of a replay.

    Parameters
    ----------
    run : RecordedRun
        Its inputs are copied.
    found : Replay
        Its decisions are what the test expects.
    name : str
        Of the folder: small letters, digits, dash and underscore.
    begin : int
        Tick the test begins with: the run's first, or one that has the controller's memory with it.
    to_s : float
        Where the test ends.
    incidents : Path
        Where incidents are.

    Raises
    ------
    InputError
        A name that is none or taken, no such folder, or more than a repository should hold.
    """
    if not _NAME.fullmatch(name):
        raise errors.InputError(f"--to-test {name!r}: use small letters, digits, '-' and '_'")
    if not incidents.is_dir():
        raise errors.InputError(f"{incidents}: no such folder; run this in the project's own folder")
    folder = incidents / name
    if folder.exists():
        raise errors.InputError(f"{folder}: is there already; choose another name")
    folder.mkdir()
    file = inputs_file.InputsFile(folder, __version__)
    for frame in _between(run.inputs.since(found.begin_s), begin, to_s):
        file.append(TickBatch(frame.records, frame.tails, frame.memories), list(frame.estimates.values()))
    file.close()
    about = {
        "schema": SCHEMA,
        "what": f"replay of {run.folder.resolve().name}",
        "recorded_by": run.inputs.program,
        "decisions": [{"time_s": round(d.time_s, 3), "what": d.what} for d in without_repeats(found.decisions)],
    }
    (folder / "incident.toml").write_text(tomli_w.dumps(about), encoding="utf-8")
    (folder / "config.toml").write_text(config_file.dump(run.config), encoding="utf-8")
    size = sum(path.stat().st_size for path in folder.iterdir())
    if size > _BYTES_MAX:
        for path in folder.iterdir():
            path.unlink()
        folder.rmdir()
        raise errors.InputError(
            f"--to-test: {size / 1e6:.0f} MB is too much for a test; narrow it with --from and --to"
        )
    return folder


def _between(frames: inputs_file.InputsReader, begin: int, to_s: float) -> Iterator[inputs_file.InputsFrame]:
    before: dict[
        float, shape_estimate.ShapeEstimate
    ] = {}  # a shape may have come a frame ahead of the tick that used it
    for frame in frames:
        if len(frame.records) and frame.records["now_s"][0] > to_s:
            return
        wanted = (frame.records["now_s"] <= to_s) & (frame.records["tick"] >= begin)
        ticks = set(frame.records["tick"][wanted].tolist())
        tails = {tick: tail for tick, tail in frame.tails.items() if tick in ticks}
        memories = {tick: memory for tick, memory in frame.memories.items() if tick == begin}
        if ticks:
            yield inputs_file.InputsFrame(frame.records[wanted], tails, memories, before | frame.estimates)
        before = {} if ticks else frame.estimates
