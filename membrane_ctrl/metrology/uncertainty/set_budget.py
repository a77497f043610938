"""What a set itself says of its own errors: blur, a film that moved unseen, a rim that is not where
it should be.
"""

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from membrane_ctrl.config.optics import OpticsConfig, SigmasConfig
from membrane_ctrl.metrology.figure.pixel_figure import (
    LASER_NOISE_UM,
    X_TO_Y,
    FilmMotion,
    FullResult,
    motion_share,
)
from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.rays import surface_basis
from membrane_ctrl.metrology.rays.geometry import project
from membrane_ctrl.metrology.rays.rim_outline import Outline
from membrane_ctrl.metrology.rays.surface import PARAMETERS, Surface, sag_gradient
from membrane_ctrl.metrology.reconstruction import film_motion
from membrane_ctrl.metrology.uncertainty import budget, monte_carlo
from membrane_ctrl.metrology.uncertainty.geometry_spread import GeometrySpread
from membrane_ctrl.metrology.uncertainty.monte_carlo import TrialBench
from membrane_ctrl.model.arrays import FloatArray, IntArray

# A good pose leaves 0.4 mm and 0.0007 (simulated, a fifth of the sensor's pixels); rings are round
# to about 1 mm.
_RIM_OFF_MM, _RIM_SIZE = 3.0, 0.005
_BLUR_UM = 0.5  # RMS of the height: a picture is out of focus, not only seen through a lens
_UNSEEN_UM = 1000.0  # of the film's motion without a laser, before the fringes are asked
_PATCHES = 12  # a side, of the picture: coarser than fringes
# of the film's place without a laser: a hold, or a mirror left alone for minutes
_UNKNOWN_UM = 20.0
_SIGMAS = 4.0  # of the fringes' answer: the film moved
# the fringes' error in the film's place at a frame, the share of a motion within an axis that its
# correction leaves, and that of a motion from x to y: a lens of a data sheet is 1 % off
_SEEN_UM, _SEEN_SHARE, _TOLD_SHARE = 0.1, 0.05, 0.02
_STEP_MM = 0.01
_HEAVY = 1e3  # weight of the sag beside the heights


def blur_px(phase_rad: FloatArray, contrasts: FloatArray, index: IntArray, bin_px: int) -> float:
    """Width of the blur, a Gauss's sigma in pixels: the contrast falls with the fringes' frequency.

    log(swing / light) = const - sigma^2 |grad phase|^2 / 2, for x and y each with its own constant.
    A bin of m pixels is itself a blur of (m^2 - 1) / 12.

    Parameters
    ----------
    phase_rad : (2, rows, columns) array
        Phases of x and y of the bins; NaN where unknown.
    contrasts : (2, n) array
        Swing over light of some bins.
    index : (n,) int array
        Those bins.
    bin_px : int
        Side of a bin.
    """
    slopes, contrasts_left = [], []
    for axis in range(2):
        steep = (
            np.sum(np.square(np.gradient(phase_rad[axis])), axis=0).reshape(-1)[index] / bin_px**2
        )
        contrast = np.log(contrasts[axis])
        known = np.isfinite(steep) & np.isfinite(contrast)
        slopes.append(steep[known] - steep[known].mean())
        contrasts_left.append(contrast[known] - contrast[known].mean())
    steep, contrast = np.concatenate(slopes), np.concatenate(contrasts_left)
    square = -2 * float(steep @ contrast) / max(float(steep @ steep), 1e-300) - (bin_px**2 - 1) / 12
    return math.sqrt(max(square, 0.0))


@dataclass(frozen=True)
class UnseenMotion:
    """Film displacement from the x frames to the y frames, as the fringes show it."""

    moved_um: float
    sigma_um: float
    noise_um: float  # the part of `sigma_um` that another set of the bench does not share

    @property
    def sure(self) -> bool:
        """Whether the film moved."""
        return abs(self.moved_um) > _SIGMAS * self.sigma_um

    @property
    def shared_um(self) -> float:
        """The part of `sigma_um` that the bench's geometry makes."""
        return math.sqrt(max(self.sigma_um**2 - self.noise_um**2, 0.0))


def unseen_motion(bench: TrialBench, spread: GeometrySpread) -> UnseenMotion:
    """Ask the fringes whether the film moved between the x and the y frames.

    Slopes in x of one bowl and slopes in y of another do not integrate to a surface. Least squares
    over the parameters, all inputs of the geometry with their prior, and the motion: what they
    cannot explain, it does.
    """
    nominal = bench.geometry()
    base = budget.predicted_mm(bench, nominal, bench.surface)
    steps = _STEP_MM * np.eye(PARAMETERS)
    surfaces = [
        Surface.from_parameters(bench.surface.parameters + s, bench.surface.radius_mm)
        for s in steps
    ]
    fitted = np.stack(
        [(budget.predicted_mm(bench, nominal, s) - base).ravel() for s in surfaces], axis=1
    )
    explained = [
        budget.predicted_mm(bench, bench.geometry((name,), [sigma]), bench.surface) - base
        for name, sigma in zip(spread.names, spread.sigmas, strict=True)
    ]
    explained.append(budget.moves_mm(bench) * np.array([[-0.5], [0.5]]) * _UNSEEN_UM)
    inputs = np.stack([moved.ravel() for moved in explained], axis=1)
    inputs = inputs - fitted @ np.linalg.lstsq(fitted, inputs, rcond=None)[0]
    left = bench.residual_mm.ravel()
    answer, gram = np.zeros(inputs.shape[1]), inputs.T @ inputs
    for _ in range(3):  # the scatter is what the inputs do not explain
        variance = float(np.mean((left - inputs @ answer) ** 2))
        covariance = np.linalg.inv(gram / variance + np.eye(inputs.shape[1]))
        answer = covariance @ (inputs.T @ left) / variance
    noise = float((covariance @ (gram / variance) @ covariance)[-1, -1])
    # uneven light and a bent response leave residuals that neighbours share: sums over patches
    # scatter by more
    shares = (covariance[-1] @ inputs.T / variance * (left - inputs @ answer)).reshape(2, -1)
    patch = np.ravel_multi_index(
        [
            np.int64((_PATCHES - 1e-6) * (p - p.min()) / np.ptp(p))
            for p in (bench.row_px, bench.column_px)
        ],
        (_PATCHES, _PATCHES),
    )
    patches = sum(float(np.sum(np.bincount(patch, share) ** 2)) for share in shares)
    more = max(patches - noise, 0.0)
    moved_um, *sigmas = answer[-1], math.sqrt(covariance[-1, -1] + more), math.sqrt(noise + more)
    return UnseenMotion(*(_UNSEEN_UM * float(value) for value in (moved_um, *sigmas)))


def _rim_failed(outline: Outline) -> bool:
    """Whether the rim is too far from where the camera's pose puts it."""
    return abs(outline.offset_mm) > _RIM_OFF_MM or abs(outline.size_ratio - 1) > _RIM_SIZE


def rim_widening(bench: TrialBench, spread: GeometrySpread, outline: Outline | None) -> float:
    """By how much the geometry's sigmas are too small for the rim that was seen; at least 1.

    Twice what they allow is nothing to wonder at.
    """
    if outline is None:
        return 1.0
    theta, radius_mm = np.linspace(0, 2 * np.pi, 60, endpoint=False), bench.surface.radius_mm
    rim_z_mm = np.full(theta.size, bench.vertex_z_mm + bench.surface.sag_mm)
    rim = np.stack([radius_mm * np.cos(theta), radius_mm * np.sin(theta), rim_z_mm])

    def seen(names: tuple[str, ...], change: FloatArray) -> FloatArray:
        points = project(bench.geometry(names, change).geometry, rim)
        middle = points.mean(axis=1)
        return np.append(middle, np.mean(np.hypot(*(points - middle[:, None]))))

    nominal = seen((), np.zeros(0))
    off = [
        seen((n,), np.array([s])) - nominal
        for n, s in zip(spread.names, spread.sigmas, strict=True)
    ]
    # correlations are left out: they make the rim better known than its parts, and the scale then
    # too small
    sigmas = np.sqrt(np.sum(np.square(off), axis=0)) if off else np.zeros(3)
    place_mm = float(np.hypot(sigmas[0], sigmas[1])) * radius_mm / nominal[2]
    far = max(
        abs(outline.offset_mm) / math.hypot(place_mm, _RIM_OFF_MM / 3),
        abs(outline.size_ratio - 1) / math.hypot(float(sigmas[2] / nominal[2]), _RIM_SIZE / 3),
    )
    return max(1.0, far / 2)


@cache
def _alike() -> FloatArray:
    """(parameters, k) parameters of the surfaces most like the round terms beyond the fit's, with
    their sag.
    """
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-1, 1, 41)] * 2))
    inside = np.hypot(x, y) <= 1
    rows, (heights, _, _) = (
        surface_basis.basis(x[inside], y[inside])[0].T,
        surface_basis.round_basis(x[inside], y[inside]),
    )
    rim = surface_basis.round_basis(np.ones(1), np.zeros(1))[0]
    table = np.vstack([rows, _HEAVY * sag_gradient()])
    return np.asarray(np.linalg.lstsq(table, np.vstack([heights.T, _HEAVY * rim.T]), rcond=None)[0])


def law_effect(
    patches: budget.Patches, radius_mm: float, inverse: FloatArray, slope_variance: float = 0.0
) -> tuple[FloatArray, float]:
    """(parameters,) error of the parameters, in mm, for a film whose bowl is not Hencky's, as its
    residual slopes show it.

    The second answer is what noise of the points' slopes adds to its square.

    Pre-strain, another Poisson ratio or a ring's moment bend the round profile beyond the terms and
    the excess. Least squares take some of that for other terms, and the rest is missing from the
    sag.
    """
    x, y = patches.places_mm / radius_mm
    _, *of = surface_basis.basis(x, y)
    _, *beyond = surface_basis.round_basis(x, y)
    absorbed = (
        inverse
        @ sum((a * patches.count) @ b.T for a, b in zip(of, beyond, strict=True))
        / radius_mm**2
    )
    left = np.hstack([b - absorbed.T @ a for a, b in zip(of, beyond, strict=True)]).T
    weights = np.sqrt(np.tile(patches.count, 2))
    answer = (absorbed - _alike()) @ np.linalg.pinv(left * weights[:, None]) * radius_mm
    return answer @ (patches.slopes.ravel() * weights), slope_variance * float(np.sum(answer**2))


def _law(full: FullResult, slope_variance: FloatArray) -> budget.Source:
    patches, variance = budget.Patches.of_grid(full.grid), float(slope_variance.mean())
    effect, noise = law_effect(patches, full.surface.radius_mm, full.fit.normal.inverse, variance)
    says = "film that is not Hencky's: round slopes that no term explains"
    return budget.Source("film_law", says, math.nan, effect[:, None], common=False, noise_mm2=noise)


@dataclass(frozen=True)
class Examined:
    """Budget of a figure, and what makes it doubtful."""

    budget: budget.Budget
    doubts: tuple[str, ...]


def examine(
    optics: OpticsConfig,
    checked: Checked,
    full: FullResult,
    spread: GeometrySpread,
    noise_adu: float,
    outline: Outline | None,
) -> Examined:
    """The budget, widened by what the set says of itself. Raises ArithmeticError if the spread is
    too wide.
    """
    state, shifts = checked.state, [checked.stack.shifts_rad(used) for used in checked.view.used]
    exact, places_px = np.zeros((2, state.index.size)), checked.places_px(state.index)
    bench = TrialBench.of_points(
        optics,
        checked.tracer,
        state.surface,
        state.points,
        places_px,
        exact,
        monte_carlo.TRIAL_POINTS,
    )
    sigmas = optics.geometry.sigmas or SigmasConfig()
    moved = FilmMotion.of(checked)
    film, doubts = _film(bench, spread, moved)
    blur = budget.blur_source(bench, _blur_px(checked))
    disc = optics.mirror.analysis_radius_mm / optics.mirror.radius_mm
    if budget.Budget((blur,), disc).total()["height_rms_um"] > _BLUR_UM:
        doubts.append(f"the picture is blurred by {blur.sigma:.1f} px (1 sigma): focus the camera")
    if outline is not None and _rim_failed(outline):
        doubts.append(
            f"the rim is {outline.offset_mm:.1f} mm off the prediction and "
            f"{outline.size_ratio:.4f} of its size: "
            "check the camera's pose, the lens and mirror.radius_mm"
        )
    slope_variance = full.slope_variance(optics, shifts, noise_adu)
    sources = [
        *budget.geometry_sources(bench, spread, rim_widening(bench, spread, outline)),
        *budget.bench_sources(bench, sigmas),
        *film,
        _vertex(bench, sigmas, checked, film[0].sigma),
        _law(full, slope_variance),
        blur,
        *budget.frame_sources(
            bench, optics, shifts, _film_um(moved), math.hypot(budget.LIGHT, checked.light_left)
        ),
        *budget.pixel_sources(full, slope_variance, noise_adu),
    ]
    return Examined(budget.Budget(tuple(sources), disc), tuple(doubts))


def _blur_px(checked: Checked) -> float:
    index, light = checked.state.index, checked.view.light.reshape(-1)
    contrasts = checked.view.swing_adu.reshape(2, -1)[:, index] / light[index]
    return blur_px(checked.phase_rad, contrasts, index, checked.binned.bin_px)


def vertex_um(readings_um: FloatArray, laser_noise_um: float) -> float:
    """1 sigma of the vertex' place from the laser's noise, or without a laser."""
    known = np.isfinite(readings_um).all()
    return laser_noise_um / math.sqrt(readings_um.size) if known else _UNKNOWN_UM


def _vertex(
    bench: TrialBench, sigmas: SigmasConfig, checked: Checked, moved_um: float
) -> budget.Source:
    """Where the vertex is: by the laser, or nobody knows; half a motion from x to y is in the
    frames' mean.
    """
    readings = checked.stack.readings_um
    noise_um = vertex_um(readings, LASER_NOISE_UM)
    if not np.isfinite(readings).all():
        return budget.vertex_source(
            bench, math.hypot(noise_um, moved_um / 2), "place of the vertex, without a laser"
        )
    scale_um = 1e3 * sigmas.laser_relative * abs(bench.vertex_z_mm)
    says = "place of the vertex, by the laser's noise and scale"
    return budget.vertex_source(bench, math.hypot(noise_um, scale_um), says)


def _film_um(film: FilmMotion) -> float:
    """RMS motion of the film left in the phases of the frames."""
    left = (_SEEN_UM, _SEEN_SHARE * film.moved_um) if film.worth_correcting else (film.moved_um,)
    return math.hypot(*left, film.noise_um)


def _film(
    bench: TrialBench, spread: GeometrySpread, film: FilmMotion
) -> tuple[list[budget.Source], list[str]]:
    """The film's motion from x to y: by the laser, else by the fringes."""
    if math.isfinite(film.x_to_y_sigma_um):
        left = _TOLD_SHARE if film.worth_correcting else 1.0
        sigma_um = math.hypot(
            film.x_to_y_sigma_um, left * float(film.told_um[0].mean() - film.told_um[1].mean())
        )
        says = "motion of the film from x to y, by the laser"
        return [budget.film_source(bench, (sigma_um,), says, paired=False)], []
    moved = unseen_motion(bench, spread)
    says = "motion of the film from x to y, without a laser"
    source = budget.film_source(bench, (moved.moved_um, moved.shared_um), says, paired=True)
    says = "noise of the fringes that show the film's motion from x to y"
    noise = replace(
        budget.film_source(bench, (moved.noise_um,), says, paired=False), name="film_seen_um"
    )
    if not moved.sure:
        return [source, noise], []
    says = (
        f"the film moved by {moved.moved_um:+.0f} +- {moved.sigma_um:.0f} µm from the x to the y "
        "frames"
    )
    return [source, noise], [f"{says}, seen in the fringes: record the laser's readings"]


def left_by_laser_um(readings_um: FloatArray, within_um: float, laser_noise_um: float) -> float:
    """Motion from x to y that is left in the phases, with `within_um` RMS among the frames of an
    axis.

    Corrected motion leaves the laser's noise. What is not corrected is at most what the laser saw,
    and hardly more than a film does that moves so little from frame to frame. Without readings that
    is all that is known.
    """
    noise_um = laser_noise_um * math.sqrt(4 / readings_um.size)
    if film_motion.worth_correcting(readings_um, laser_noise_um):
        return noise_um
    if not np.isfinite(readings_um).all():
        return X_TO_Y * within_um
    seen_um = float(np.subtract(*(part.mean() for part in np.split(readings_um, 2))))
    share = motion_share(within_um, noise_um)
    return math.hypot(share * seen_um, math.sqrt(share) * noise_um)
