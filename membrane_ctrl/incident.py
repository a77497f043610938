"""An incident: a recorded stretch of a run as a test, with the decisions that today's code takes in it.

`tests/incidents/<name>/` holds the run's configuration and inputs, and `incident.toml` with the decisions expected.
Where the incident shows that the controller decided wrongly, a person writes there what it should have decided: the
test then fails until it does.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tomli_w

from membrane_ctrl import __version__, config_file
from membrane_ctrl.config import Config
from membrane_ctrl.errors import InputError
from membrane_ctrl.metrology.hencky import zernike_projection
from membrane_ctrl.recorded_run import RecordedRun
from membrane_ctrl.recording.inputs_file import Frame, InputsFile, InputsReader
from membrane_ctrl.replay import Decision, Replay, recorded_ticks, replay, unmatched, without_repeats
from membrane_ctrl.tick_record import TickBatch

SCHEMA = "membrane-incident/1"
INCIDENTS = Path("tests/incidents")
_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")
# A decision may come this much earlier or later after a change of the control code, and still be the same one.
_SLACK_S = 1.0
# An incident lives in the repository: what is larger than this is a recording.
_BYTES_MAX = 4_000_000


@dataclass(frozen=True, slots=True)
class Incident:
    """What `incident.toml` says."""

    folder: Path
    what: str
    expected: list[Decision]


def write_incident(run: RecordedRun, found: Replay, name: str, to_s: float, incidents: Path = INCIDENTS) -> Path:
    """Make a test of a replay.

    Parameters
    ----------
    run : RecordedRun
        Its inputs are copied from its first tick on (a controller has a memory) to `to_s`.
    found : Replay
        Its decisions are what the test expects.
    name : str
        Of the folder: small letters, digits, dash and underscore.
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
        raise InputError(f"--to-test {name!r}: use small letters, digits, '-' and '_'")
    if not incidents.is_dir():
        raise InputError(f"{incidents}: no such folder; run this in the project's own folder")
    folder = incidents / name
    if folder.exists():
        raise InputError(f"{folder}: is there already; choose another name")
    folder.mkdir()
    file = InputsFile(folder, __version__)
    for frame in _until(run.inputs, to_s):
        file.append(TickBatch(frame.records, frame.tails), list(frame.estimates.values()))
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
        raise InputError(f"--to-test: {size / 1e6:.0f} MB is too much for a test; end it earlier with --to")
    return folder


def _until(frames: InputsReader, to_s: float) -> Iterator[Frame]:
    for frame in frames:
        wanted = frame.records["now_s"] <= to_s
        if not np.any(wanted) and len(frame.records):
            return
        yield Frame(frame.records[wanted], frame.tails, frame.estimates)


def read_incident(folder: Path) -> Incident:
    """Read an incident. Raises InputError."""
    try:
        about = tomllib.loads((folder / "incident.toml").read_text(encoding="utf-8"))
        expected = [Decision(float(item["time_s"]), str(item["what"])) for item in about["decisions"]]
        return Incident(folder, str(about["what"]), expected)
    except (OSError, tomllib.TOMLDecodeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{folder}/incident.toml: {error}") from None


def check_incident(incident: Incident) -> list[str]:
    """Replay an incident; where today's decisions are not the expected ones, as sentences."""
    inputs = InputsReader(incident.folder)
    config = config_file.load(incident.folder / "config.toml", Config)
    found = replay(config, recorded_ticks(inputs), zernike_projection(), 0.0, math.inf)
    return [*inputs.damage, *unmatched(incident.expected, found.decisions, _SLACK_S)]
