"""The `uncertainty` command: Monte Carlo over geometry and pixel noise, of a set or of the change between two."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.calibration.geometry_file import read_geometry
from membrane_ctrl.calibration.geometry_spread_file import spread_of
from membrane_ctrl.errors import InputError
from membrane_ctrl.metrology.geometry_spread import GeometrySpread
from membrane_ctrl.metrology.monte_carlo import TrialBench
from membrane_ctrl.metrology.surface import parameter_to_coeffs, sag_gradient
from membrane_ctrl.metrology.uncertainty import HeightMap, linear_covariance, noise_covariance, trial_covariance
from membrane_ctrl.recording.atomic import make_folder
from membrane_ctrl.sets.result_files import write_arrays, write_json
from membrane_ctrl.sets.set_figure import Figures, SetFigure
from membrane_ctrl.trial_runner import run_everywhere

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class UncertaintyOptions:
    """What the command was asked for."""

    folder: Path
    against: Path | None
    geometry: Path | None
    trials: int
    seed: int
    workers: int | None
    scheduler: str | None
    out: Path | None
    as_json: bool


@dataclass(frozen=True)
class Spread:
    """Spread of the height of a set, or of its change since another.

    Attributes
    ----------
    covariance, linear, noise : (36, 36) arrays
        Of the parameters in mm^2: over the trials, from the Jacobian and the noise, from the noise alone.
    """

    covariance: FloatArray
    linear: FloatArray
    noise: FloatArray


def uncertainty_command(options: UncertaintyOptions) -> int:
    """Run the trials, write map, table and picture, say what came out. Raises CommandError."""
    figures = Figures(None if options.geometry is None else read_geometry(options.geometry))
    sets = [figures.of(folder) for folder in (options.folder, options.against) if folder is not None]
    spread, source = spread_of(sets[0].head.optics.geometry, options.geometry)
    print(f"geometry's spread: {source}", file=sys.stderr)
    benches = [one.bench() for one in sets]
    if len({bench.optics.geometry for bench in benches}) > 1:
        raise InputError(f"{options.against}: geometry: not that of {options.folder}; a pair has one bench")
    begin = time.perf_counter()
    parameters = run_everywhere(
        benches, spread, options.seed, options.trials, workers=options.workers, scheduler=options.scheduler
    )
    seconds = time.perf_counter() - begin
    result = _spread(benches, spread, parameters)
    mirror = sets[0].head.optics.mirror
    grid = HeightMap.over(mirror.analysis_radius_mm, mirror.radius_mm)
    table = _table(options, sets, spread, source, result, grid) | {"timing_s": {"trials": seconds}}
    out = options.out.resolve() if options.out else options.folder / "uncertainty"
    _write(out, grid, result, _height_um(sets, grid), table)
    print(json.dumps(table) if options.as_json else "\n".join(_lines(table)))
    return 0


def _spread(benches: list[TrialBench], spread: GeometrySpread, parameters: FloatArray) -> Spread:
    """Of the only set, or of the first minus the second, trial by trial."""
    own = parameters[:, 0] if len(benches) == 1 else parameters[:, 0] - parameters[:, 1]
    noise = np.sum([noise_covariance(bench) for bench in benches], axis=0)
    return Spread(trial_covariance(own), linear_covariance(benches, spread), noise)


def _height_um(sets: list[SetFigure], grid: HeightMap) -> FloatArray:
    """The height, or its change, at the points of the grid."""
    own = sets[0].figure.fit.surface.parameters
    other = sets[1].figure.fit.surface.parameters if len(sets) > 1 else np.zeros_like(own)
    return np.asarray(1e3 * grid.matrix @ (own - other))


def _table(
    options: UncertaintyOptions,
    sets: list[SetFigure],
    spread: GeometrySpread,
    source: str,
    result: Spread,
    grid: HeightMap,
) -> dict[str, Any]:
    rmse, linear, noise = (1e3 * grid.sigma(c) for c in (result.covariance, result.linear, result.noise))
    coeffs = np.sqrt(np.diag(parameter_to_coeffs() @ result.covariance @ parameter_to_coeffs().T))
    sag = sag_gradient()
    return {
        "schema": "membrane-uncertainty/1",
        "set": str(options.folder),
        "against": None if options.against is None else str(options.against),
        "verdicts": [{"set": str(one.head.folder), "verdict": one.verdict, "reason": one.reason} for one in sets],
        "trials": options.trials,
        "seed": options.seed,
        "geometry": sets[0].head.geometry.table()
        | {"names": list(spread.names), "sigmas": spread.sigmas.tolist(), "source": source},
        "rmse_um": {"mean": float(rmse.mean()), "max": float(rmse.max())},
        "linear_um": {"mean": float(linear.mean()), "max": float(linear.max())},
        "noise_um": {"mean": float(noise.mean()), "max": float(noise.max())},
        "sag_sigma_um": 1e3 * float(np.sqrt(sag @ result.covariance @ sag)),
        "coeffs_sigma_um": (1e3 * coeffs).tolist(),
    }


def _write(out: Path, grid: HeightMap, result: Spread, height_um: FloatArray, table: dict[str, Any]) -> None:
    from membrane_ctrl.sets.stability_pictures import draw_uncertainty  # matplotlib takes a second to load

    rmse = grid.picture(1e3 * grid.sigma(result.covariance))
    try:
        make_folder(out)
        write_json(out / "uncertainty.json", table)
        write_arrays(out / "rmse.npz", x_mm=grid.axis_mm, y_mm=grid.axis_mm, rmse_um=rmse)
        height = grid.picture(height_um)
        draw_uncertainty(out / "uncertainty.png", grid.axis_mm, height, rmse, table["against"] is not None)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror or error}") from None
    print(f"written to {out}", file=sys.stderr)


def _lines(table: dict[str, Any]) -> list[str]:
    what = "height" if table["against"] is None else "change of height"
    return [
        f"{what}: mean RMSE {table['rmse_um']['mean']:.4g} um, largest {table['rmse_um']['max']:.4g} um "
        f"({table['trials']} trials, seed {table['seed']})",
        f"linear      mean {table['linear_um']['mean']:.4g} um, largest {table['linear_um']['max']:.4g} um",
        f"noise alone mean {table['noise_um']['mean']:.4g} um, largest {table['noise_um']['max']:.4g} um",
        f"sag         1 sigma {table['sag_sigma_um']:.4g} um",
    ]
