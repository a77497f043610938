"""Incidents in `tests/incidents`: read, and replayed with today's code."""

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path

from membrane_ctrl.config import toml_file as config_file
from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.snapshot import UnknownSnapshotError
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model import errors
from membrane_ctrl.replay.replay import Decision, find_unmatched, recorded_ticks, replay_record
from membrane_ctrl.run_files import inputs_file

# A decision may come this much earlier or later after a change of the control code, and still be
# the same one.
_SLACK_S = 1.0


@dataclass(frozen=True, slots=True)
class Incident:
    """What `incident.toml` says."""

    folder: Path
    what: str
    expected: list[Decision]


def _read_decision(item: dict[str, object]) -> Decision:
    kind, _, name = str(item["what"]).partition(" ")
    return Decision(float(str(item["time_s"])), kind, name)


def read_incident(folder: Path) -> Incident:
    """Read an incident. Raises InputError."""
    try:
        about = tomllib.loads((folder / "incident.toml").read_text(encoding="utf-8"))
        expected = [_read_decision(item) for item in about["decisions"]]
        return Incident(folder, str(about["what"]), expected)
    except (OSError, tomllib.TOMLDecodeError, KeyError, TypeError, ValueError) as error:
        raise errors.InputError(f"{folder}/incident.toml: {error}") from None


def check_incident(incident: Incident) -> list[str]:
    """Replay an incident; where today's decisions are not the expected ones, as sentences."""
    inputs = inputs_file.InputsReader(incident.folder)
    config = config_file.load_toml(incident.folder / "config.toml", Config)
    begin = next((int(frame.records["tick"][0]) for frame in inputs if len(frame.records)), 1)
    try:
        found = replay_record(
            config, recorded_ticks(inputs, begin), zernike_projection(), 0.0, math.inf
        )
    except UnknownSnapshotError as error:
        return [f"{error}: make the incident again from its run"]
    return [*inputs.damage, *find_unmatched(incident.expected, found.decisions, _SLACK_S)]
