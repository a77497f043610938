"""What is explored, from a session or a run: plant, weather and present gains."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from membrane_ctrl.config.schema import LoopConfig
from membrane_ctrl.control import loop_margins
from membrane_ctrl.model import arrays, errors, telemetry
from membrane_ctrl.run_files.run import open_run
from membrane_ctrl.sessions import folder
from tuning import gains_file
from tuning.identification import closed_loop, disturbance, noise_spectrum, plant_model
from tuning.identification.record import Record
from tuning.proposal.candidate import PRESENT
from tuning.steps import design, identify, observe

# An hour is a hundred times the slowest motion that the fit uses; two of its periods are the least
# it accepts.
_LONGEST_S, SHORTEST_S = 3600.0, 2.0 * noise_spectrum.SLOWEST_S
PROPOSED = "proposed"
_COLUMNS = ("flow_um_per_s", "displacement_um", "ambient_pressure_pa", "air_temperature_c")


@dataclass(frozen=True, slots=True)
class Workpiece:
    """A loop to explore."""

    source: str  # where plant and weather come from, for the page
    model: plant_model.PlantModel
    weather: disturbance.DisturbanceModel
    loop: LoopConfig  # in use when plant and weather were recorded
    proposed: closed_loop.Gains | None  # of the session
    session: folder.SessionFolder | None  # receives the gains that a person saves
    candidates: Mapping[str, closed_loop.Gains] = field(default_factory=dict)  # of the session

    @property
    def named_gains(self) -> dict[str, closed_loop.Gains]:
        """What the sliders may start from: the present gains, those proposed, and the others."""
        found = {PRESENT: closed_loop.Gains.from_config(self.loop)}
        if self.proposed is not None:
            found[PROPOSED] = self.proposed
        others = {
            name: gains for name, gains in self.candidates.items() if gains not in found.values()
        }
        return {**found, **others}


def load_workpiece(path: Path, logs: Path) -> Workpiece:
    """Load what is explored, from a session folder or from a run folder.

    Parameters
    ----------
    path : Path
        The folder.
    logs : Path
        Folder of runs and sessions.

    Returns
    -------
    Workpiece

    Raises
    ------
    InputError
        It is neither, a session without quiet hold, or a run without 200 s of undisturbed hold.
    """
    return (
        load_from_session(folder.open_session(path))
        if (path / "session.json").exists()
        else load_from_run(path, logs)
    )


def load_from_session(opened: folder.SessionFolder) -> Workpiece:
    """Plant and weather as identified and observed in a session."""
    model, weather = (
        identify.load_identified(opened).identified.model,
        observe.load_disturbance(opened),
    )
    proposed = None
    candidates: dict[str, closed_loop.Gains] = {}
    if opened.is_done("design"):
        candidates = {row.name: row.gains for row in design.load_design(opened).candidates}
        proposed = closed_loop.Gains.from_config(
            gains_file.load_gains(opened.file_path("gains.toml")).loop
        )
    source = f"Plant and weather of the session {opened.path.name}."
    return Workpiece(source, model, weather, opened.head.before, proposed, opened, candidates)


def load_from_run(path: Path, logs: Path) -> Workpiece:
    """Load the weather of a run's longest undisturbed hold, and a plant.

    Parameters
    ----------
    path : Path
        The run.
    logs : Path
        Where the newest session is searched for, which gives the plant; without one it is as the
        configuration assumes.
    """
    run = open_run(path)
    loop = run.config.loop
    names = (*_COLUMNS, "state", "safe_level", "leak_um_per_s")
    blocks = list(run.tick_blocks(names))
    columns = {
        name: np.concatenate([block[name] for block in blocks] or [np.empty(0)]) for name in names
    }
    # The longest stretch of undisturbed hold.
    quiet = (columns["state"] == telemetry.State.HOLD) & (
        columns["safe_level"] == telemetry.SafeLevel.NONE
    )
    part = _find_longest(quiet, round(_LONGEST_S * loop.rate_hz))
    dt_s = 1.0 / loop.rate_hz
    if (part.stop - part.start) * dt_s < SHORTEST_S:
        raise errors.InputError(
            f"{path}: no undisturbed hold of {SHORTEST_S:.0f} s; choose another run or a session"
        )
    # Weather is what the plant's model does not explain of it.
    model, whose = _find_plant(logs, float(np.nanmedian(columns["leak_um_per_s"][part])))
    record = Record(dt_s, *(columns[name][part].astype(float) for name in _COLUMNS))
    try:
        weather = disturbance.observe_disturbance(record, model, loop)
    except ValueError as error:
        raise errors.InputError(f"{path}: {error}") from None
    minutes = record.duration_s / 60
    return Workpiece(
        f"Weather of {minutes:.0f} min of {run.name}; {whose}.", model, weather, loop, None, None
    )


def _find_longest(good: arrays.BoolArray, at_most: int) -> slice:
    """The longest stretch of true values; of one that is too long, the end."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], good, [False])).astype(np.int8)))
    if edges.size == 0:
        return slice(0, 0)
    starts, ends = edges[::2], edges[1::2]
    best = int(np.argmax(ends - starts))
    return slice(max(int(starts[best]), int(ends[best]) - at_most), int(ends[best]))


def _find_plant(logs: Path, leak_um_per_s: float) -> tuple[plant_model.PlantModel, str]:
    """The newest identified plant, else the assumed one with the run's own leak;
    and whose it is.
    """
    try:
        newest = folder.find_newest_session(logs)
        return identify.load_identified(
            newest
        ).identified.model, f"plant of the session {newest.path.name}"
    except errors.InputError:
        leak = leak_um_per_s if math.isfinite(leak_um_per_s) else 0.0
        plant = plant_model.PlantModel(1.0, loop_margins.DEAD_S, loop_margins.PUMP_LAG_S, leak)
        return plant, "plant as the configuration assumes it (no session has identified it)"
