"""What a replay needs of a run folder: configuration, inputs, recorded decisions, recorded rows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from membrane_ctrl.config import Config
from membrane_ctrl.config_file import load
from membrane_ctrl.errors import InputError
from membrane_ctrl.recording.atomic import read_text
from membrane_ctrl.recording.checked_text import comment_is_right
from membrane_ctrl.recording.inputs_file import InputsReader
from membrane_ctrl.replay import Decision, decisions_of
from membrane_ctrl.review.folder import event_s, read_events
from membrane_ctrl.telemetry import TelemetryRow

# A row is found in the recording by its time, which Rerun keeps in whole nanoseconds.
_SAME_TIME_S = 2e-9


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """A run folder, opened for a replay."""

    folder: Path
    config: Config
    inputs: InputsReader
    decisions: list[Decision]
    told_until_s: float  # the event log ends here, if a crash cut it
    config_damage: str = ""  # not the configuration that the run had

    def row_at(self, time_s: float) -> TelemetryRow | None:
        """The row that was recorded then; None if the recording does not have it."""
        from membrane_ctrl.recording.read_back import read_rows
        from membrane_ctrl.review.rrd_salvage import FAULTS

        for path in sorted(self.folder.glob("*.rrd")):
            try:
                rows = read_rows(path)
            except FAULTS:
                continue
            near = np.flatnonzero(np.abs(rows[:, 0] - time_s) < _SAME_TIME_S)
            if near.size:
                values = rows[near[0]].tolist()
                return TelemetryRow(time_s, *values[1:])
        return None


def open_run(folder: Path) -> RecordedRun:
    """Open a run. Raises InputError in one line that names the folder and what is missing."""
    if not (folder / "config.toml").is_file():
        raise InputError(f"{folder}: not a run folder: there is no config.toml in it")
    inputs = InputsReader(folder)
    if not inputs.paths:
        raise InputError(f"{folder}: no inputs-*.bin: this run was recorded without what a replay needs")
    events = read_events(folder, [])
    cut = not any(event.get("kind") == "end" for event in events)
    told_until_s = max((event_s(event) for event in events), default=0.0) if cut else math.inf
    config = load(folder / "config.toml", Config, follow=False)
    right = comment_is_right(read_text(folder / "config.toml"))
    damage = "" if right else "config.toml: does not fit its checksum (damaged or edited)"
    return RecordedRun(folder, config, inputs, decisions_of(events), told_until_s, damage)
