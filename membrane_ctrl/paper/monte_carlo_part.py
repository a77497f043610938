"""Part: the paper's Monte Carlo of the height, in each reading of its text, and of a change.

A trial draws a, b and alpha, and noise of the pixels, and reconstructs the surface. The paper does
not say what else follows a wrong angle, and that decides the result:

- a pixel keeps its ray (the camera's pose follows a and alpha), as `measure` does, or keeps the
  x_0 and y_0 of the nominal geometry;
- the error of the protractor acts in the y equations as geometry has it, by a sin(alpha) and the
  height of the screen's points: with a sign opposite to that in x, as astigmatism;
- or it acts in the x equations only, or in those of y as in those of x, as power.

Readings are judged without the scatter of trials: by the effect of one standard uncertainty of each
input, summed in squares. With 100 trials an RMSE is 7 % off, which can decide a verdict.

The paper's 4 to 5 µm of a pair are the same Monte Carlo of the change between two sets that share a
trial's geometry.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial

import numpy as np

from membrane_ctrl.metrology.phase.phase_steps import equal_shifts, phase_sigma_rad
from membrane_ctrl.metrology.phase.screen_scale import mm_per_rad
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.terminal import track_progress
from membrane_ctrl.paper import pictures
from membrane_ctrl.paper.aperture_grid import ApertureGrid
from membrane_ctrl.paper.bench import PIXEL_NOISE_ADU, MeasuredBench, PaperOptions
from membrane_ctrl.paper.comparison import Agreement, PaperStatement, PartResult, judge_within
from membrane_ctrl.paper.convergence_parts import make_seen_points, solve_by_paper
from membrane_ctrl.paper.reference_iteration import (
    POWERS,
    PolynomialSurface,
    SeenPoints,
    SlopeChange,
    make_height_matrix,
    make_parabola,
    predict_seen,
    reconstruct,
)
from membrane_ctrl.paper.reference_pmd import PaperGeometry, compute_slope, predict_screen
from membrane_ctrl.processes.worker_pool import run_jobs

PAPER_MEAN_UM = 24.8
PAPER_PAIR_UM = (4.0, 5.0)
_SIDE = 101  # points along the map
_POINTS = 1500  # determine the 36 terms
_START_ITERATIONS = 8
_BATCH = 10  # trials per job: the bar moves, and no worker waits for long
# From the nominal solution: each contracts fifty-fold, so that 50 µm become 1e-5 µm.
_TRIAL_ITERATIONS = 4
_RAY_STEPS = 6  # from a ray to the nominal surface: 1e-6 mm are left
_X_SQUARED = POWERS.index((2, 0))
_Y_SQUARED = POWERS.index((0, 2))
# The paper's 100 trials scatter by 7 %; three of these.
_WITHIN = 0.21
# Motion of the centre between two sets: far more than the paper's loop leaves.
_PAIR_UM = 10.0


class AngleReading(StrEnum):
    """What follows a wrong angle."""

    PIXEL_RAYS = "pixels keep their rays"
    FIXED_POINTS = "points keep x and y"
    ANGLE_IN_X = "points keep x and y, alpha wrong in the x equations only"
    ANGLE_AS_IN_X = "points keep x and y, alpha acts in y as in x"


@dataclass(frozen=True, slots=True)
class TrialInputs:
    """What all trials share.

    Attributes
    ----------
    seen : SeenPoints
        The measurement.
    nominal : PolynomialSurface
        Its solution with the nominal geometry.
    geometry : PaperGeometry
        Nominal a, b and alpha.
    sigmas : (float, float, float)
        Standard uncertainties of a and b, mm, and of alpha, rad.
    screen_sigma_mm : float
        Noise of a point's place on the screen.
    analysis_radius_mm : float
    seed : int
    """

    seen: SeenPoints
    nominal: PolynomialSurface
    geometry: PaperGeometry
    sigmas: tuple[float, float, float]
    screen_sigma_mm: float
    analysis_radius_mm: float
    seed: int


@dataclass(frozen=True, slots=True)
class _Trial:
    """Errors that a trial draws; without noise by default."""

    a_mm: float = 0.0
    b_mm: float = 0.0
    alpha_rad: float = 0.0
    screen_mm: FloatArray | float = 0.0


def compare_monte_carlo(bench: MeasuredBench) -> PartResult:
    """RMSE maps of the height, in each reading."""
    # What the trials vary: geometry and screen points, from the solution of the bench.
    mirror = bench.optics.mirror
    seen = make_seen_points(bench, _POINTS)
    start = make_parabola(40.0, mirror.radius_mm)
    inputs = TrialInputs(
        seen,
        solve_by_paper(bench, start, _START_ITERATIONS, _POINTS).surface,
        bench.geometry,
        bench.geometry_sigmas,
        _screen_sigma_mm(bench, seen),
        mirror.analysis_radius_mm,
        bench.options.seed,
    )
    grid = ApertureGrid.over_disc(mirror.analysis_radius_mm, _SIDE)
    x_mm, y_mm = grid.places_mm
    to_height = make_height_matrix(x_mm, y_mm, mirror.radius_mm)

    # RMSE over the trials: the height is linear in the coefficients.
    coeffs_mm = _run_everywhere(inputs, bench.options)
    heights_um = 1e3 * coeffs_mm @ to_height.T
    rmse_um = dict(zip(AngleReading, np.std(heights_um, axis=0, ddof=1), strict=True))

    # The same without the scatter of trials: the effects of one sigma, summed in squares.
    effects_um = {
        reading: _compute_effects_um(inputs, to_height, reading) for reading in AngleReading
    }
    expected_um = {
        reading: np.sqrt(np.sum(np.square(list(effects.values())), axis=0))
        for reading, effects in effects_um.items()
    }
    budget_um = {
        name: float(np.mean(np.abs(change)))
        for name, change in effects_um[AngleReading.PIXEL_RAYS].items()
    }

    # Between two sets the geometry cancels.
    pair_um = float(np.mean(compute_pair_rmse_um(inputs, to_height, bench.options.trials)))

    comparisons = [
        compare_with_paper(reading, rmse_um[reading], expected_um[reading], bench.options.trials)
        for reading in AngleReading
    ]
    comparisons.append(_state_pair(pair_um, bench.options.trials))
    comparisons += [_state_part(name, value) for name, value in budget_um.items()]
    numbers = {
        "trials": bench.options.trials,
        "mean_um": {reading.name: float(np.mean(rmse_um[reading])) for reading in AngleReading},
        "max_um": {reading.name: float(np.max(rmse_um[reading])) for reading in AngleReading},
        "expected_mean_um": {
            reading.name: float(np.mean(expected_um[reading])) for reading in AngleReading
        },
        "pair_mean_um": pair_um,
        "budget_mean_um": budget_um,
    }
    maps = {str(reading): grid.fill_map(rmse_um[reading]) for reading in AngleReading}
    drawn = {"RMSE of the height": pictures.draw_maps(maps, grid.axis_mm, "µm")}
    return PartResult(comparisons, numbers, drawn)


def _state_pair(pair_um: float, trials: int) -> PaperStatement:
    """The mean RMSE of the change between two sets."""
    return PaperStatement(
        "RMSE of the change between two sets, mean over the mirror, µm",
        "4 to 5",
        f"{pair_um:.2g}",
        judge_within(pair_um, *PAPER_PAIR_UM),
        f"{trials} trials; the centre moves by {_PAIR_UM:g} µm between the sets; "
        "the geometry cancels, and the paper's 0.4 ADU of white noise average out",
    )


def _state_part(name: str, value_um: float) -> PaperStatement:
    """The mean effect of one input of the geometry."""
    return PaperStatement(
        f"part of {name}, mean over the mirror, µm (pixels keep their rays)",
        "",
        f"{value_um:.3g}",
        Agreement.UNSTATED,
        "by a change of one standard uncertainty",
    )


def run_trials(inputs: TrialInputs, numbers: Sequence[int]) -> FloatArray:
    """Solve trials, each with one draw of the errors, in every reading of the paper.

    Parameters
    ----------
    inputs : TrialInputs
        What all trials share.
    numbers : sequence of int
        Numbers of the trials: each seeds its own errors, so that batches can run anywhere.

    Returns
    -------
    (trials, readings, terms) array
        Coefficients of `PolynomialSurface`, mm; the readings in the order of `AngleReading`.
    """
    trials = [_draw(inputs, number) for number in numbers]
    return np.array(
        [[_solve_trial(inputs, trial, reading) for reading in AngleReading] for trial in trials]
    )


def _run_everywhere(inputs: TrialInputs, options: PaperOptions) -> FloatArray:
    """All trials, in this process or on a Dask cluster: the same numbers."""
    batches = [
        range(first, min(first + _BATCH, options.trials))
        for first in range(0, options.trials, _BATCH)
    ]
    job = partial(run_trials, inputs)
    with run_jobs(job, batches, 1, options.scheduler) as results:
        return np.concatenate(
            list(track_progress(results, "trials of the Monte Carlo", len(batches)))
        )


def compare_with_paper(
    reading: AngleReading, rmse_um: FloatArray, expected_um: FloatArray, trials: int
) -> PaperStatement:
    """Compare one reading of the paper's text with the paper's mean and maximum.

    Parameters
    ----------
    reading : AngleReading
        How the angle's error is read.
    rmse_um : (points,) array
        RMSE of the height over the trials.
    expected_um : (points,) array
        The same without scatter, which is judged.
    trials : int
        Their number.
    """
    mean_um = float(np.mean(rmse_um))
    max_um = float(np.max(rmse_um))
    expected_mean_um = float(np.mean(expected_um))
    low = PAPER_MEAN_UM * (1 - _WITHIN)
    high = PAPER_MEAN_UM * (1 + _WITHIN)
    return PaperStatement(
        f"RMSE of the height, mean and largest, µm: {reading}",
        "24.8 and about 50",
        f"{mean_um:.1f} and {max_um:.0f}",
        judge_within(expected_mean_um, low, high),
        f"{trials} trials, whose RMSE scatters by {100 / math.sqrt(2 * (trials - 1)):.0f} %; "
        f"without scatter {expected_mean_um:.1f} and {np.max(expected_um):.0f}, which is judged",
    )


def _compute_effects_um(
    inputs: TrialInputs, to_height: FloatArray, reading: AngleReading
) -> dict[str, FloatArray]:
    """Change (points,) of the height by one standard uncertainty of a, b or alpha alone."""
    a_mm, b_mm, alpha_rad = inputs.sigmas
    trials = {
        "a": _Trial(a_mm=a_mm),
        "b": _Trial(b_mm=b_mm),
        "alpha": _Trial(alpha_rad=alpha_rad),
    }
    # Errors that the nominal solution has itself cancel.
    nominal_mm = _solve_trial(inputs, _Trial(), reading)
    return {
        name: 1e3 * to_height @ (_solve_trial(inputs, trial, reading) - nominal_mm)
        for name, trial in trials.items()
    }


def compute_pair_rmse_um(inputs: TrialInputs, to_height: FloatArray, trials: int) -> FloatArray:
    """RMSE of the change between two sets, whose geometry has the same error.

    Parameters
    ----------
    inputs : TrialInputs
        The bench, its first surface, and the errors to draw.
    to_height : (points, terms) array
        From coefficients to heights.
    trials : int
        How many errors are drawn.

    Returns
    -------
    (points,) array
        Standard deviation of the change over the trials, µm.
    """
    # The bench sees two bowls: the nominal one, and one whose centre moved.
    moved_mm = inputs.nominal.coeffs_mm.copy()
    moved_mm[[_X_SQUARED, _Y_SQUARED]] += _PAIR_UM / 1e3
    surfaces = (inputs.nominal, PolynomialSurface(moved_mm, inputs.nominal.radius_mm))
    pair = [
        replace(
            inputs, seen=predict_seen(inputs.geometry, inputs.seen.rays, surface), nominal=surface
        )
        for surface in surfaces
    ]

    # Both are solved with the same wrong geometry; the second set has noise of its own.
    changes_mm = []
    for number in range(trials):
        trial = _draw(inputs, number)
        noise_mm = _draw(inputs, trials + number).screen_mm
        before_mm = _solve_trial(pair[0], trial, AngleReading.PIXEL_RAYS)
        later = replace(trial, screen_mm=noise_mm)
        changes_mm.append(_solve_trial(pair[1], later, AngleReading.PIXEL_RAYS) - before_mm)
    return np.asarray(np.std(1e3 * np.array(changes_mm) @ to_height.T, axis=0, ddof=1))


def _screen_sigma_mm(bench: MeasuredBench, seen: SeenPoints) -> float:
    """Noise of a point's place on the screen.

    A point stands for several pixels: its noise is that of their mean.
    """
    # Noise of one pixel's phase (section 1 of docs/explanation/metrology.md), averaged over the
    # pixels of the bench's camera that one point stands for.
    swing_adu = bench.full.quality.modulation_share * (2**bench.optics.camera.bits - 1)
    shifts_rad = equal_shifts(bench.optics.pattern.steps)
    of_pixel_rad = phase_sigma_rad(shifts_rad, PIXEL_NOISE_ADU, swing_adu)
    share = seen.screen_mm.shape[1] / (bench.pixels.index.size * bench.pixels_of_camera)
    return float(of_pixel_rad * mm_per_rad(bench.optics.pattern) * math.sqrt(share))


def _draw(inputs: TrialInputs, number: int) -> _Trial:
    """The errors of a trial, which depend on its number and the seed alone."""
    random = np.random.default_rng((inputs.seed, number))
    a_mm, b_mm, alpha_rad = random.standard_normal(3) * inputs.sigmas
    noise_mm = inputs.screen_sigma_mm * random.standard_normal(inputs.seen.screen_mm.shape)
    return _Trial(float(a_mm), float(b_mm), float(alpha_rad), noise_mm)


def _solve_trial(inputs: TrialInputs, trial: _Trial, reading: AngleReading) -> FloatArray:
    """Coefficients (terms,) of the surface of one trial, mm."""
    nominal = inputs.nominal
    wrong = PaperGeometry(
        inputs.geometry.a_mm + trial.a_mm,
        inputs.geometry.b_mm + trial.b_mm,
        inputs.geometry.alpha_rad + trial.alpha_rad,
    )

    # A wrong angle turns the camera with its rays, or leaves the points where they were.
    rays = inputs.seen.rays
    fixed_mm: FloatArray | None = None
    if reading is AngleReading.PIXEL_RAYS:
        rays = _turn_about_y(rays, trial.alpha_rad)
    else:
        fixed_mm = _intersect_surface(inputs.geometry, rays, nominal)

    # In the y equations the angle acts as the geometry has it, not at all, or as in those of x.
    y_geometry: PaperGeometry | None = None
    y_change: SlopeChange | None = None
    if reading in (AngleReading.ANGLE_IN_X, AngleReading.ANGLE_AS_IN_X):
        y_geometry = replace(wrong, alpha_rad=inputs.geometry.alpha_rad)
    if reading is AngleReading.ANGLE_AS_IN_X:
        y_change = partial(_change_y, inputs.geometry, wrong)
    found = reconstruct(
        wrong,
        SeenPoints(rays, inputs.seen.screen_mm + trial.screen_mm),
        nominal,
        nominal.radius_mm,
        inputs.analysis_radius_mm,
        _TRIAL_ITERATIONS,
        fixed_mm=fixed_mm,
        y_geometry=y_geometry,
        y_change=y_change,
    )
    return found.surface.coeffs_mm


def _change_y(
    nominal: PaperGeometry, wrong: PaperGeometry, points_mm: FloatArray, slope_y: FloatArray
) -> FloatArray:
    """Change (n,) of y slopes by an angle that enters the y equations as it enters those of x."""
    turned = PaperGeometry(nominal.a_mm, nominal.b_mm, wrong.alpha_rad)
    _, y_mm, height_mm = points_mm
    screen_mm = predict_screen(nominal, y_mm, height_mm, slope_y)
    return compute_slope(turned, y_mm, height_mm, screen_mm) - slope_y


def _turn_about_y(rays: FloatArray, angle_rad: float) -> FloatArray:
    """Rays (3, n) of a camera that stands higher by an angle, and still looks at the vertex."""
    cosine = math.cos(angle_rad)
    sine = math.sin(angle_rad)
    turn = np.array([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]])
    return turn @ rays


def _intersect_surface(
    geometry: PaperGeometry, rays: FloatArray, surface: PolynomialSurface
) -> FloatArray:
    """Places (2, n) where rays meet a surface."""
    # To the level of the last height, then the height there; each step contracts by slope times
    # inclination.
    pinhole_mm = geometry.pinhole_mm[:, None]
    height_mm: FloatArray | float = 0.0
    for _ in range(_RAY_STEPS):
        place_mm = pinhole_mm + (height_mm - pinhole_mm[2]) / rays[2] * rays
        height_mm = surface.height_mm(place_mm[0], place_mm[1])
    return np.asarray(place_mm[:2])
