"""`film RUN...`: the film's stiffness over the hours of runs, its creep, and tomorrow's drift.

Creep: a loaded film goes on giving way, ever more slowly; what it will do tomorrow, with an
interval. Polymers creep about evenly in the logarithm of the time since the load, or by a small
power of it, but none exactly. So y, the logarithm of the stiffness E t that sag and pressure show,
is a curve over u = ln(t + t0),

    y = a + b u + W(u) + noise

with W a curve of unknown bends (the integral of a random walk: a smoothing spline). A power law is
such a curve. How much it bends, t0, and for how long the noise lasts (weather makes errors of
hours) are not known: the results are averages over all three, weighted with how well each agrees
with the readings.
"""

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from membrane_ctrl.measure.result_files import write_json, write_picture
from membrane_ctrl.metrology.film.film_law import FilmLaw
from membrane_ctrl.model import errors, files, program
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.run_files.run import Run, open_run

LEAST = 8  # readings: fewer determine no law
_BLOCKS = 60
_ONSETS = np.logspace(-4, 0.5, 8)  # t0 over the time of the readings
_BENDS = np.append(0.0, np.logspace(-2, 4, 10))  # of W over a unit of u, in the noise's sigma
_LASTING = (0.0, 0.5, 0.8, 0.95)  # correlation of the noise from one reading to the next
_AHEAD = 2.0  # longest look ahead over the time of the readings


@dataclass(frozen=True)
class FilmCreep:
    """What the readings say of one film."""

    span_s: float  # from the first reading to the last
    per_decade: float  # of y, at the end, when the time since the load grows tenfold
    drift: float  # of y over the time that was asked for, from the last reading on, and its 1 sigma
    drift_sigma: float
    scatter: float  # of a reading about the law

    @property
    def sure(self) -> bool:
        """Whether the film creeps at all, beyond doubt."""
        return abs(self.drift) > 2 * self.drift_sigma


def fit_creep(time_s: FloatArray, y: FloatArray, ahead_s: float) -> FilmCreep:
    """Fit the law to readings (n,) of the logarithm of the stiffness.

    Raises ValueError for fewer than `LEAST` readings, or a look ahead of more than twice their
    time.
    """
    order = np.argsort(time_s)
    time_s, y = _blocks(np.asarray(time_s, float)[order], np.asarray(y, float)[order])
    if time_s.size < LEAST:
        raise ValueError(
            f"{time_s.size} readings are too few for a law of creep; {LEAST} are needed"
        )
    span_s = float(time_s[-1] - time_s[0])
    if ahead_s > _AHEAD * span_s:
        raise ValueError(
            f"readings over {span_s / 3600:.1f} h say nothing of {ahead_s / 3600:.0f} h ahead"
        )
    t = np.append((time_s - time_s[0]) / span_s, 1 + ahead_s / span_s)
    found = np.array([_one(t, y, *each) for each in product(_ONSETS, _BENDS, _LASTING)])
    weight = np.exp(found[:, 0] - np.max(found[:, 0]))
    weight /= weight.sum()
    _, drifts, variances, decades, scatters = found.T
    drift = float(weight @ drifts)
    sigma = math.sqrt(float(weight @ (variances + (drifts - drift) ** 2)))
    return FilmCreep(span_s, float(weight @ decades), drift, sigma, float(weight @ scatters))


def _blocks(time_s: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means over blocks of equal time."""
    span_s = float(np.ptp(time_s)) if time_s.size else 0.0
    if time_s.size <= _BLOCKS or span_s == 0:
        return time_s, y
    block = np.minimum(((time_s - time_s[0]) / span_s * _BLOCKS).astype(int), _BLOCKS - 1)
    count = np.bincount(block)
    full = count > 0
    return np.bincount(block, time_s)[full] / count[full], np.bincount(block, y)[full] / count[full]


def _one(
    t: FloatArray, y: FloatArray, onset: float, bend: float, lasting: float
) -> tuple[float, float, float, float, float]:
    """One law: log evidence, drift to the last t from the one before, its variance, drift per
    decade, scatter.

    t (n + 1,) is in units of the readings' time; the last one is ahead of the n readings y.
    """
    u = np.log(t + onset) - math.log(onset)
    less, more = np.minimum.outer(u, u), np.maximum.outer(u, u)
    curve = bend**2 * less**2 * (3 * more - less) / 6
    noise = lasting ** np.abs(np.subtract.outer(np.arange(y.size), np.arange(y.size)))
    root = np.linalg.cholesky(curve[:-1, :-1] + noise)
    design = np.stack([np.ones(y.size), u[:-1] - u[-2]], axis=1)
    both = np.linalg.solve(root, np.column_stack([design, y, curve[:-1, -1] - curve[:-1, -2]]))
    a, b, onto = both[:, :2], both[:, 2], both[:, 3]
    inverse = np.linalg.inv(a.T @ a)
    line = inverse @ (a.T @ b)
    left, free = b - a @ line, y.size - 2
    variance = max(float(left @ left), 1e-30) / free
    step = np.array([0.0, u[-1] - u[-2]])
    drift = float(step @ line + onto @ left)
    short = step - a.T @ onto
    own = curve[-1, -1] + curve[-2, -2] - 2 * curve[-1, -2] - onto @ onto + short @ inverse @ short
    evidence = (
        -np.sum(np.log(np.diag(root)))
        - np.linalg.slogdet(a.T @ a)[1] / 2
        - free / 2 * math.log(variance)
    )
    decade = math.log(10) * drift / float(u[-1] - u[-2])
    return float(evidence), drift, variance * float(own), decade, math.sqrt(variance)


_LEVEL_S, _DAY_S = 60.0, 86_400.0
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
    """Read the runs, fit the creep, write `creep.json` and its picture. Raises CommandError."""
    runs = [open_run(folder) for folder in folders]
    radius_mm = runs[0].config.optics.mirror.radius_mm
    time_s, sag_mm, pressure_pa = (
        np.concatenate(part) for part in zip(*map(_readings, runs), strict=True)
    )
    law = FilmLaw(prestrain, poisson, 1.0, radius_mm)
    try:
        stiffness = pressure_pa / law.pressure_pa(law.with_sag(sag_mm))
        creep = fit_creep(time_s, np.log(stiffness), _DAY_S)
    except ValueError as error:
        raise errors.RejectedError(f"film: {error}") from None
    # at the same pressure a softer film is deeper, as the law says
    now = law.with_sag(sag_mm[np.argmax(time_s)])
    softer = FilmLaw(prestrain, poisson, math.exp(-1e-3), radius_mm).under(law.pressure_pa(now))
    um_per_log = -1e6 * float(softer.sag_mm - now.sag_mm)
    table = _table(runs, stiffness, creep, um_per_log) | {
        "prestrain": prestrain,
        "poisson": poisson,
    }
    folder = (out or runs[-1].folder / "film").resolve()
    with errors.writing(folder):
        files.make_folder(folder)
        write_json(folder / "creep.json", table)
        if pictures:
            _draw(folder / "creep.png", (time_s - time_s.min()) / 3600, stiffness / 1e3)
    print(f"written to {folder}", file=sys.stderr)
    print(json.dumps(table) if as_json else "\n".join(_lines(table)))
    return 0


def _readings(run: Run) -> tuple[FloatArray, FloatArray, FloatArray]:
    """UTC in s, sag in mm and gauge pressure in Pa of the cycles of a run that gave a figure."""
    shapes, level = run.shapes(), run.level(_LEVEL_S, names=(_GAUGE,))
    known = np.isfinite(level[_GAUGE])
    good = np.isfinite(shapes.sag_um) & np.isin(shapes.verdict, ("ok", "degraded"))
    if not (known.any() and good.any()):
        raise errors.RejectedError(
            f"{run.folder}: without figures and a gauge a run says nothing of its film"
        )
    time_s = np.asarray(shapes.time_s[good], float)
    middle_s = level["time_s"][known] + _LEVEL_S / 2
    pressure_pa = np.interp(time_s, middle_s, level[_GAUGE][known])
    return (
        time_s + run.origin_utc.timestamp(),
        np.asarray(shapes.sag_um[good], float) / 1e3,
        pressure_pa,
    )


def _table(
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
        "creeps": creep.sure,
    }


def _lines(table: dict[str, Any]) -> list[str]:
    drift = table["tomorrow_um"]
    low, high = (drift["value"] + sign * _SURE * drift["sigma"] for sign in (-1, 1))
    creeps = f"creep      {table['percent_per_decade']:+.3g} % of E t in a decade of time"
    return [
        f"runs       {len(table['runs'])}, over {table['hours']:.1f} h; each reading scatters by "
        f"{table['scatter_percent']:.2g} %",
        f"E t        {table['stiffness_n_per_m'] / 1e3:.2f} kN/m, if the pre-strain is "
        f"{1e6 * table['prestrain']:g} µm/m and nu {table['poisson']:g}",
        creeps if table["creeps"] else "creep      none that these readings show",
        f"tomorrow   at the same pressure the sag changes by {drift['value']:+.3g} µm in 24 "
        f"h; 95 %: {low:+.3g} to "
        f"{high:+.3g} µm, without the weather",
    ]


def _draw(path: Path, hours: FloatArray, stiffness_kn_per_m: FloatArray) -> None:
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(8, 4), layout="constrained")
    panel = drawing.subplots()
    panel.plot(hours, stiffness_kn_per_m, ".", markersize=2)
    panel.set(title="Stiffness that sag and pressure show", xlabel="hours", ylabel="E t (kN/m)")
    write_picture(path, drawing)
