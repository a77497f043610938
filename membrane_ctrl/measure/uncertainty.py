"""The `uncertainty` command: Monte Carlo over geometry and pixel noise, of a set or of the change
between two.
"""

import json
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from membrane_ctrl.geometry import file, spread_file
from membrane_ctrl.measure.measurement import Figures, SetFigure
from membrane_ctrl.measure.result_files import write_arrays, write_json
from membrane_ctrl.measure.set_statement import SetStatement, state_set
from membrane_ctrl.metrology.rays.surface import parameter_to_coeffs, sag_gradient
from membrane_ctrl.metrology.uncertainty import (
    geometry_spread,
    height_map,
    linear_covariance,
    monte_carlo,
    trial_bench,
)
from membrane_ctrl.metrology.uncertainty.motion_evidence import MotionFinding
from membrane_ctrl.model import errors, files, program, terminal
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.processes.worker_pool import run_jobs

# Runs Monte Carlo trials: in this process, on all cores, or on a Dask cluster: the same numbers to
# twelve digits.

# trials per job: a tenth of a second, so that the bar moves and no worker waits for long
_BATCH = 100
# A process takes about two seconds to start (imports, compiled loops): less work than this stays in
# this process.
_WORTH_PROCESSES = 5000


def run_everywhere(
    benches: Sequence[trial_bench.TrialBench],
    spread: geometry_spread.GeometrySpread,
    seed: int,
    trials: int,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
) -> FloatArray:
    """Run Monte Carlo trials in this process, on its cores, or on a Dask cluster.

    The numbers are the same to twelve digits. A terminal shows a progress bar.

    Parameters
    ----------
    benches : sequence of TrialBench
        The sets; all of one trial share its geometry.
    spread : GeometrySpread
        Covariance of poses, lens and screen.
    seed, trials : int
        Seed, and number of trials.
    workers : int or None
        Number of processes; None: one for little work, else one for each core.
    scheduler : str or None
        Address of a Dask scheduler to use instead, such as tcp://host:8786.

    Returns
    -------
    (trials, sets, parameters) array
        Parameters of the surface, mm, as `monte_carlo.run_trials`.

    Raises
    ------
    InputError
        Dask is not installed, or the spread is too wide for the fit to converge.
    DeviceError
        The scheduler does not answer.
    """
    batches = [range(first, min(first + _BATCH, trials)) for first in range(0, trials, _BATCH)]
    job = partial(monte_carlo.run_trials, benches, spread, seed)
    if workers is None:
        workers = 1
        if trials * len(benches) >= _WORTH_PROCESSES:
            workers = os.cpu_count() or 1
    try:
        with run_jobs(job, batches, min(workers, len(batches)), scheduler) as results:
            return np.concatenate(list(terminal.track_progress(results, "trials", len(batches))))
    except ArithmeticError as error:
        raise errors.InputError(f"uncertainty: {error}") from None


@dataclass(frozen=True)
class UncertaintyOptions:
    """Options of the command."""

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
    covariance : (parameters, parameters) array
        Covariance of the parameters over the trials, mm^2.
    linear : (parameters, parameters) array
        The same from the Jacobian and the noise.
    noise : (parameters, parameters) array
        The same from the noise alone.
    budget : (parameters, parameters) array
        The same from the budgets of `measure`, with film, light, blur and the remaining slopes of
        each set.
    motion : MotionFinding or None
        Motions of the bench between two sets.
    """

    covariance: FloatArray
    linear: FloatArray
    noise: FloatArray
    budget: FloatArray
    motion: MotionFinding | None


def uncertainty_command(options: UncertaintyOptions) -> int:
    """Run the trials, write map, table and picture, and report. Raises CommandError."""
    # The sets, and the spread of their geometry.
    given = None
    if options.geometry is not None:
        given = file.read_geometry(options.geometry)
    folders = [folder for folder in (options.folder, options.against) if folder is not None]
    figures = Figures(given)
    sets = [figures.measure_folder(folder) for folder in folders]
    spread, source = spread_file.geometry_spread(sets[0].head.optics, options.geometry)
    print(f"geometry: {source}", file=sys.stderr)
    benches = [one.make_trial_bench() for one in sets]
    if len({bench.optics.geometry for bench in benches}) > 1:
        raise errors.InputError(
            f"{options.against}: geometry: differs from {options.folder}; a pair needs one bench"
        )

    # The statements on both sets, the trials, and the budget.
    stated = [state_set(folder, given, options.geometry) for folder in folders]
    begin_s = time.perf_counter()
    parameters = run_everywhere(
        benches,
        spread,
        options.seed,
        options.trials,
        workers=options.workers,
        scheduler=options.scheduler,
    )
    seconds = time.perf_counter() - begin_s
    budget_mm2, motion = _combine_budgets(stated)
    result = _compute_spread(benches, spread, parameters, budget_mm2, motion)

    # The map, the table and the picture.
    mirror = sets[0].head.optics.mirror
    grid = height_map.HeightMap.over_disc(mirror.analysis_radius_mm, mirror.radius_mm)
    table = _make_comparison_table(options, sets, stated, spread, source, result, grid)
    table["timing_s"] = {"trials": seconds}
    out = options.out.resolve() if options.out else options.folder / "uncertainty"
    shown_mm = sets[0].figure.fit.surface.parameters
    if len(sets) > 1:
        shown_mm = shown_mm - sets[1].figure.fit.surface.parameters
    _write_comparison(out, grid, result, 1e3 * grid.matrix @ shown_mm, table)
    print(json.dumps(table) if options.as_json else "\n".join(_format_comparison(table)))
    return 0


def _combine_budgets(
    stated: Sequence[SetStatement],
) -> tuple[FloatArray, MotionFinding | None]:
    """Covariance (parameters, parameters), mm^2, of the only set by its budget, or of its change
    since the second, and the motions of the bench in it.
    """
    own, *earlier = (each.budget for each in stated)
    if not earlier:
        return own.covariance(True) + own.covariance(False), None
    return own.change_covariance(earlier[0]), own.find_motion(earlier[0])


def _compute_spread(
    benches: list[trial_bench.TrialBench],
    spread: geometry_spread.GeometrySpread,
    parameters: FloatArray,
    budget: FloatArray,
    motion: MotionFinding | None,
) -> Spread:
    """Spread of the only set, or of the first minus the second, trial by trial."""
    # The parameters, or their change: a trial has one geometry, whose common effect cancels.
    own = parameters[:, 0]
    if len(benches) > 1:
        own = own - parameters[:, 1]
    noise = np.sum([linear_covariance.noise_covariance(bench) for bench in benches], axis=0)
    return Spread(
        monte_carlo.trial_covariance(own),
        linear_covariance.linear_covariance(benches, spread),
        noise,
        budget,
        motion,
    )


def _make_comparison_table(
    options: UncertaintyOptions,
    sets: list[SetFigure],
    stated: list[SetStatement],
    spread: geometry_spread.GeometrySpread,
    source: str,
    result: Spread,
    grid: height_map.HeightMap,
) -> dict[str, Any]:
    """The content of `uncertainty.json`."""

    def summarise(covariance_mm2: FloatArray) -> dict[str, float]:
        """Mean and largest standard deviation of the height over the map, µm."""
        sigma_um = 1e3 * grid.sigma(covariance_mm2)
        return {"mean": float(sigma_um.mean()), "max": float(sigma_um.max())}

    # Motions of the bench between two sets, if there are two.
    motion_um = None
    moved = ""
    if result.motion is not None:
        motion_um = summarise(result.motion.covariance_mm2)
        if result.motion.is_proven:
            moved = result.motion.describe()

    # Standard deviations of the sag, g^T C g, and of the Noll terms.
    sag = sag_gradient()
    to_coeffs = parameter_to_coeffs()
    coeffs_mm = np.sqrt(np.diag(to_coeffs @ result.covariance @ to_coeffs.T))
    return {
        **program.file_origin("membrane-uncertainty/1"),
        "set": str(options.folder),
        "against": None if options.against is None else str(options.against),
        "verdicts": [
            {"set": str(one.head.folder)} | each.table()
            for one, each in zip(sets, stated, strict=True)
        ],
        "trials": options.trials,
        "seed": options.seed,
        "geometry": sets[0].head.geometry.make_table()
        | {"names": list(spread.names), "sigmas": spread.sigmas.tolist(), "source": source},
        "rmse_um": summarise(result.covariance),
        "linear_um": summarise(result.linear),
        "noise_um": summarise(result.noise),
        "budget_um": summarise(result.budget),
        "motion_um": motion_um,
        "moved": moved,
        "sag_sigma_um": 1e3 * float(np.sqrt(sag @ result.covariance @ sag)),
        "coeffs_sigma_um": (1e3 * coeffs_mm).tolist(),
    }


def _write_comparison(
    out: Path,
    grid: height_map.HeightMap,
    result: Spread,
    height_um: FloatArray,
    table: dict[str, Any],
) -> None:
    """Write table, map and picture; `height_um` (points,) is the height, or its change."""
    from membrane_ctrl.measure.stability_pictures import draw_uncertainty

    axis_mm = grid.axis_mm
    rmse_um = grid.picture(1e3 * grid.sigma(result.covariance))
    budget_um = grid.picture(1e3 * grid.sigma(result.budget))
    height = grid.picture(height_um)
    is_change = table["against"] is not None
    with errors.convert_write_errors(out):
        files.make_folder(out)
        write_json(out / "uncertainty.json", table)
        write_arrays(
            out / "rmse.npz", x_mm=axis_mm, y_mm=axis_mm, rmse_um=rmse_um, budget_um=budget_um
        )
        draw_uncertainty(out / "uncertainty.png", axis_mm, height, rmse_um, is_change)
    print(f"written to {out}", file=sys.stderr)


def _format_comparison(table: dict[str, Any]) -> list[str]:
    """The result as lines of text."""
    what = "height"
    if table["against"] is not None:
        what = "change of height"
    motion = []
    if table["motion_um"] is not None:
        motion.append(
            f"            of it motions of the bench between the sets: mean "
            f"{table['motion_um']['mean']:.4g} µm, largest {table['motion_um']['max']:.4g} µm"
        )
    if table["moved"]:
        motion.append(f"moved       {table['moved']}")
    sets = [line for each in table["verdicts"] for line in _format_verdict(each)]
    return [
        *sets,
        f"{what}: mean RMSE {table['rmse_um']['mean']:.4g} µm, largest "
        f"{table['rmse_um']['max']:.4g} µm "
        f"({table['trials']} trials, seed {table['seed']})",
        f"linear      mean {table['linear_um']['mean']:.4g} µm, largest "
        f"{table['linear_um']['max']:.4g} µm",
        f"noise alone mean {table['noise_um']['mean']:.4g} µm, largest "
        f"{table['noise_um']['max']:.4g} µm",
        f"sag         1 sigma {table['sag_sigma_um']:.4g} µm",
        f"budget      mean {table['budget_um']['mean']:.4g} µm, largest "
        f"{table['budget_um']['max']:.4g} µm: "
        "also film, light, blur and slopes left of each set",
        *motion,
    ]


def _format_verdict(each: dict[str, Any]) -> list[str]:
    """How good a set is, and how well its geometry is known."""
    reason = ""
    if each["reason"]:
        reason = f": {each['reason']}"
    known = each["geometry_known"]
    return [
        f"{each['set']}: {each['verdict']}{reason}",
        f"geometry    {known['state']}: {known['source']}",
    ]
