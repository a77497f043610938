"""The command `film RUN...`: stiffness, creep and expected drift of a film from its runs."""

import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from membrane_ctrl.measure.result_files import write_json, write_picture
from membrane_ctrl.metrology.film.film_law import FilmLaw
from membrane_ctrl.model import errors, files, program
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.review.statistics.film_creep import FilmCreep, fit_creep
from membrane_ctrl.run_files.run import Run, open_run

_LEVEL_S = 60.0
_DAY_S = 86_400.0
_GAUGE = "mean_gauge_pressure_pa"
_SURE = 1.96  # sigmas of a 95 % interval


def film_run_command(
    folders: Sequence[Path],
    prestrain: float,
    poisson: float,
    out: Path | None,
    pictures: bool,
    as_json: bool,
) -> int:
    """Fit the creep of a film to its runs, write `creep.json` and print the result.

    Parameters
    ----------
    folders : sequence of Path
        Runs with figures and a pressure gauge; the first has the mirror's radius.
    prestrain : float
        Strain of the flat film, m/m.
    poisson : float
        Poisson's ratio of the film.
    out : Path or None
        Folder of the results; None: `film` in the last run's folder.
    pictures : bool
        Draw the stiffness over time, too.
    as_json : bool
        Print the table as one line of JSON instead of text.

    Returns
    -------
    int
        0, the exit code.

    Raises
    ------
    RejectedError
        A run has no figures or no gauge, or the readings are too few for a law of creep.
    CommandError
        A run cannot be read, or the result cannot be written.
    """
    # The readings of all runs: sag by figures, pressure by the gauge.
    runs = [open_run(folder) for folder in folders]
    radius_mm = runs[0].config.optics.mirror.radius_mm
    time_s, sag_mm, pressure_pa = (
        np.concatenate(part) for part in zip(*map(_read_cycles, runs), strict=True)
    )

    # By the law the pressure is in proportion to the stiffness E t at the same sag.
    law = FilmLaw(prestrain, poisson, 1.0, radius_mm)
    try:
        stiffness = pressure_pa / law.pressure_pa(law.with_sag(sag_mm))
        creep = fit_creep(time_s, np.log(stiffness), _DAY_S)
    except ValueError as error:
        raise errors.RejectedError(f"film: {error}") from None

    # At the same pressure a softer film is deeper: the change of sag for a logarithm of stiffness.
    now = law.with_sag(sag_mm[np.argmax(time_s)])
    softer = FilmLaw(prestrain, poisson, math.exp(-1e-3), radius_mm).under_pressure(
        law.pressure_pa(now)
    )
    um_per_log = -1e6 * float(softer.sag_mm - now.sag_mm)

    # The result.
    table = _make_table(runs, stiffness, creep, um_per_log) | {
        "prestrain": prestrain,
        "poisson": poisson,
    }
    folder = (out or runs[-1].folder / "film").resolve()
    with errors.convert_write_errors(folder):
        files.make_folder(folder)
        write_json(folder / "creep.json", table)
        if pictures:
            _draw_stiffness(folder / "creep.png", (time_s - time_s.min()) / 3600, stiffness / 1e3)
    print(f"written to {folder}", file=sys.stderr)
    print(json.dumps(table) if as_json else "\n".join(_format_table(table)))
    return 0


def _read_cycles(run: Run) -> tuple[FloatArray, FloatArray, FloatArray]:
    """UTC in s, sag in mm and gauge pressure in Pa of the cycles of a run that gave a figure."""
    # Figures of the cycles, and minute means of the gauge.
    shapes = run.shapes()
    level = run.level(_LEVEL_S, names=(_GAUGE,))
    known = np.isfinite(level[_GAUGE])
    middle_s = level["time_s"][known] + _LEVEL_S / 2
    good = np.isfinite(shapes.sag_um) & np.isin(shapes.verdict, ("ok", "degraded"))
    good &= _find_distance_s(shapes.time_s, middle_s) <= _LEVEL_S
    if not good.any():
        raise errors.RejectedError(
            f"{run.folder}: without figures and a gauge a run shows nothing of its film"
        )

    # The pressure at the time of each figure, between the middles of the minutes.
    time_s = np.asarray(shapes.time_s[good], float)
    pressure_pa = np.interp(time_s, middle_s, level[_GAUGE][known])
    return (
        time_s + run.origin_utc.timestamp(),
        np.asarray(shapes.sag_um[good], float) / 1e3,
        pressure_pa,
    )


def _find_distance_s(time_s: FloatArray, known_s: FloatArray) -> FloatArray:
    """Distance (n,) of times (n,) to the nearest known one (m,), increasing; infinite without one.

    Over hours without a gauge the weather changes the pressure: no straight line bridges them.
    """
    if not known_s.size:
        return np.full(time_s.size, np.inf)
    place = np.searchsorted(known_s, time_s)
    before_s = known_s[np.maximum(place - 1, 0)]
    after_s = known_s[np.minimum(place, known_s.size - 1)]
    return np.minimum(np.abs(time_s - before_s), np.abs(time_s - after_s))


def _make_table(
    runs: Sequence[Run], stiffness: FloatArray, creep: FilmCreep, um_per_log: float
) -> dict[str, Any]:
    return {
        **program.file_origin("membrane-creep/1"),
        "runs": [run.name for run in runs],
        "hours": creep.span_s / 3600,
        "stiffness_n_per_m": float(np.median(stiffness)),
        "percent_per_decade": 100 * creep.per_decade,
        "scatter_percent": 100 * creep.scatter,
        "tomorrow_um": {
            "value": creep.drift * um_per_log,
            "sigma": creep.drift_sigma * abs(um_per_log),
        },
        "creeps": creep.is_certain,
    }


def _format_table(table: dict[str, Any]) -> list[str]:
    creep = "none that these readings show"
    if table["creeps"]:
        creep = f"{table['percent_per_decade']:+.3g} % of E t in a decade of time"
    change_um = table["tomorrow_um"]["value"]
    half_width_um = _SURE * table["tomorrow_um"]["sigma"]
    low_um = change_um - half_width_um
    high_um = change_um + half_width_um
    return [
        f"runs       {len(table['runs'])}, over {table['hours']:.1f} h; each reading scatters by "
        f"{table['scatter_percent']:.2g} %",
        f"E t        {table['stiffness_n_per_m'] / 1e3:.2f} kN/m, if the pre-strain is "
        f"{1e6 * table['prestrain']:g} µm/m and nu {table['poisson']:g}",
        f"creep      {creep}",
        f"tomorrow   at the same pressure the sag changes by {change_um:+.3g} µm in 24 h; "
        f"95 %: {low_um:+.3g} to {high_um:+.3g} µm, without the weather",
    ]


def _draw_stiffness(path: Path, hours: FloatArray, stiffness_kn_per_m: FloatArray) -> None:
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(8, 4), layout="constrained")
    panel = drawing.subplots()
    panel.plot(hours, stiffness_kn_per_m, ".", markersize=2)
    panel.set(title="Stiffness that sag and pressure show", xlabel="hours", ylabel="E t (kN/m)")
    write_picture(path, drawing)
