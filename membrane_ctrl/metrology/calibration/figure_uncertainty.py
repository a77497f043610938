"""A figure's uncertainty after the calibration: height, sag, Zernike terms, with and without a
tilt.

With a wrong geometry the fit gives a wrong surface: dq = -(J_q^T W J_q)^-1 J_q^T W J_g dg, whose
blocks are known. The laser sets the vertex, with its own error.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.calibration import normal_equations
from membrane_ctrl.metrology.calibration.solver import Problem, Solution, solve
from membrane_ctrl.metrology.phase import phase_steps
from membrane_ctrl.metrology.rays import bench_parameters, forward_model
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.surface import (
    PARAMETERS,
    Surface,
    parameter_to_coeffs,
    sag_gradient,
)
from membrane_ctrl.metrology.reconstruction import bin_grid
from membrane_ctrl.model.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class Propagated:
    """Standard deviations that come from the geometry and the laser."""

    height_rms_um: float  # over the analysed disc; the figure is the height without its best plane
    figure_rms_um: float
    sag_um: float  # of the rim above the vertex
    zernike_um: FloatArray  # (terms,) in Noll's order; 2 and 3 are the tilt


def surface_response(solution: Solution, index: int) -> FloatArray:
    """d surface / d (optical parameters, vertex' height), (parameters, OPTICAL + 1), of one set."""
    sums = solution.equations[index].sums
    order = [
        *range(forward_model.LOCAL, forward_model.LOCAL + bench_parameters.OPTICAL),
        PARAMETERS,
    ]
    return np.asarray(-np.linalg.solve(sums[:PARAMETERS, :PARAMETERS], sums[:PARAMETERS, order]))


def surface_covariance(solution: Solution, index: int) -> FloatArray:
    """Covariance (parameters, parameters) in mm^2 of the parameters of one set's surface."""
    response = surface_response(solution, index)
    geometry = solution.covariance[: bench_parameters.OPTICAL, : bench_parameters.OPTICAL]
    vertex = response[:, -1] * solution.problem.references.laser_sigma_um * 1e-3
    return np.asarray(response[:, :-1] @ geometry @ response[:, :-1].T + np.outer(vertex, vertex))


def propagate(solution: Solution, index: int, analysis_radius_mm: float) -> Propagated:
    """Propagate to the quantities of a figure like that of one set."""
    covariance = surface_covariance(solution, index)
    heights, plane = disc(analysis_radius_mm / solution.problem.radius_mm)
    flat = without_plane(heights, plane)
    to_coeffs = parameter_to_coeffs()
    return Propagated(
        height_rms_um=_rms_um(heights, covariance),
        figure_rms_um=_rms_um(flat, covariance),
        sag_um=sag_um(covariance),
        zernike_um=1e3 * np.sqrt(np.diag(to_coeffs @ covariance @ to_coeffs.T)),
    )


def sag_um(covariance: FloatArray) -> float:
    """Standard deviation of the sag from a covariance (parameters, parameters) in mm^2 of a
    surface's parameters.
    """
    return 1e3 * float(np.sqrt(sag_gradient() @ covariance @ sag_gradient()))


def disc(radius: float) -> tuple[FloatArray, FloatArray]:
    """Heights (n, parameters) of a surface over a disc of some radii, and the plane's columns (n,
    3).
    """
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-radius, radius, 41)] * 2))
    inside = np.hypot(x, y) <= radius
    x, y = x[inside], y[inside]
    return np.asarray(forward_model.basis(x, y)[0].T), np.stack([np.ones_like(x), x, y], axis=1)


def without_plane(heights: FloatArray, plane: FloatArray) -> FloatArray:
    """Heights (n, ...) less their best plane."""
    return np.asarray(heights - plane @ np.linalg.lstsq(plane, heights, rcond=None)[0])


def _rms_um(heights: FloatArray, covariance: FloatArray) -> float:
    return 1e3 * float(np.sqrt(np.mean(np.einsum("ij,jk,ik->i", heights, covariance, heights))))


# Which combinations of parameters the sets do not determine, and their effect on a figure, in
# words.
#
# In units of the hand measurements' sigmas, the covariance has eigenvalues between 0 (the sets know
# far better) and 1 (they know nothing). A combination near 1 is named by its largest parts and by
# the effect of one sigma on the surface.

WEAK = 0.5  # of the hand's sigma: the sets have not even doubled the knowledge
_PART = 0.3  # of a unit combination: smaller parts are not named
_MOSTLY = 0.8  # share of a change's square that its name must explain
_NOTHING_UM = 0.5


@dataclass(frozen=True)
class Combination:
    """A direction in the space of parameters."""

    left: float  # sigma after over sigma before; 1: the sets say nothing
    parts: tuple[
        tuple[str, float], ...
    ]  # of one sigma, in the parameters' units, the largest first
    height_um: float  # effect of one sigma on the surface, RMS, and without the best plane
    figure_um: float
    words: str  # name of that effect


def condition_number(solution: Solution) -> float:
    """Of the free parameters' covariance in units of the hand measurements' sigmas."""
    values = np.linalg.eigvalsh(_scaled(solution)[0])
    return float(values[-1] / values[0])


def weak_combinations(
    solution: Solution, index: int, analysis_radius_mm: float
) -> tuple[Combination, ...]:
    """Combinations that the sets leave undetermined, the worst first; `index` is the set whose
    surface shows it.
    """
    covariance, free = _scaled(solution)
    values, vectors = np.linalg.eigh(covariance)
    out = []
    for value, vector in sorted(zip(values, vectors.T, strict=True), key=lambda pair: -pair[0]):
        if value < WEAK**2:
            break
        amounts = vector * np.sqrt(value) * solution.problem.sigmas[free]
        order = np.argsort(-np.abs(vector))
        parts = tuple(
            (bench_parameters.NAMES[free[k]], float(amounts[k]))
            for k in order
            if abs(vector[k]) > _PART
        )
        out.append(
            _described(
                solution, index, analysis_radius_mm, float(np.sqrt(value)), parts, free, amounts
            )
        )
    return tuple(out)


def _scaled(solution: Solution) -> tuple[FloatArray, IntArray]:
    free = np.flatnonzero(solution.problem.sigmas > 0)
    scale = solution.problem.sigmas[free]
    return solution.covariance[np.ix_(free, free)] / np.outer(scale, scale), free


def _described(
    solution: Solution,
    index: int,
    radius_mm: float,
    left: float,
    parts: tuple[tuple[str, float], ...],
    free: IntArray,
    amounts: FloatArray,
) -> Combination:
    optical = free < bench_parameters.OPTICAL
    change = surface_response(solution, index)[:, free[optical]] @ amounts[optical]
    heights, plane = disc(radius_mm / solution.problem.radius_mm)
    moved_um = 1e3 * heights @ change
    figure_um = without_plane(moved_um, plane)
    height, figure = (float(np.sqrt(np.mean(part**2))) for part in (moved_um, figure_um))
    named = [
        (bench_parameters.ALL[bench_parameters.NAMES.index(name)], amount) for name, amount in parts
    ]
    says = "; ".join(
        f"{amount:+.2g} {parameter.unit}: {parameter.says}" for parameter, amount in named
    )
    effect = _effect(solution, index, moved_um, figure_um, plane)
    return Combination(left, parts, height, figure, f"{effect} ({says})")


def _effect(
    solution: Solution, index: int, moved_um: FloatArray, figure_um: FloatArray, plane: FloatArray
) -> str:
    """The name of a change of the surface: one of the motions of a rigid body, a scale, or a
    figure.
    """
    total = float(np.mean(moved_um**2))
    if total < _NOTHING_UM**2:
        return "nothing that a figure shows"
    kept = f"; {np.sqrt(np.mean(figure_um**2)):.2g} µm RMS of figure"
    if 1 - float(np.mean(figure_um**2)) / total > _MOSTLY:
        slope = np.linalg.lstsq(plane, moved_um, rcond=None)[0][1:]
        return f"a tilt of the surface by {np.hypot(*slope):.2g} µm at the rim{kept}"
    x, y = plane[:, 1], plane[:, 2]
    surface = solution.states[index].surface.parameters
    height, by_x, by_y = (part.T @ surface for part in forward_model.basis(x, y))
    for name, field in (
        ("a scale of the surface", height),
        ("a turn about z", x * by_y - y * by_x),
    ):
        share = (moved_um @ field) ** 2 / (field @ field) / (moved_um @ moved_um)
        if share > _MOSTLY:
            return f"{name}{kept}"
    return f"a change of figure of {np.sqrt(np.mean(figure_um**2)):.2g} µm RMS"


# What sets that are still to be taken will determine: the covariance at the stated bench, linear
# and without noise.
#
# Rays are followed from a bowl at each depth to the screen, and the problem is solved from there.
# Its solution is the bowl itself, and its covariance is within a tenth of that claimed by sets of a
# mounted film (docs/how-to/calibration.md). The bowl has the figure of a film that is clamped by
# hand: a smooth one
# would claim a fifth more.

_MOUNTED_MM = np.zeros(PARAMETERS)
_MOUNTED_MM[[3, 5, 7]] = (
    0.3,
    0.1,
    0.05,
)  # astigmatism, coma, trefoil; and 10 µm RMS over the terms above
_HIGHER = np.arange(9, PARAMETERS - 1)  # Noll 11 and all terms above
_MOUNTED_MM[_HIGHER] = 0.01 / np.sqrt(_HIGHER.size) * (-1.0) ** np.arange(_HIGHER.size)
# rays along the picture's longer side; twice as many change a claim by less than a fiftieth
_ACROSS = 48


def foresee(
    optics: OpticsConfig,
    sigmas: FloatArray,
    sags_mm: Sequence[float],
    swing_adu: float,
    laser_sigma_um: float,
) -> Propagated:
    """Standard deviations of a figure that is measured with the geometry of sets at these sags.

    `sigmas` (len(NAMES),) are those of the hand's measurements, `swing_adu` is the amplitude of the
    fringes and `laser_sigma_um` that of a set's mean reading. Raises ValueError if no ray of such a
    set ends on the pattern.
    """
    geometry, middle_mm = Geometry.from_config(optics), sags_mm[len(sags_mm) // 2]
    sets = [_set(geometry, optics, sag_mm, sag_mm - middle_mm, swing_adu) for sag_mm in sags_mm]
    references = normal_equations.References(0.0, laser_sigma_um)
    problem = Problem(geometry, tuple(sets), sigmas, references, optics.mirror.radius_mm)
    return propagate(solve(problem), len(sets) // 2, optics.mirror.analysis_radius_mm)


def _set(
    geometry: Geometry, optics: OpticsConfig, sag_mm: float, moved_mm: float, swing_adu: float
) -> forward_model.SetPhases:
    """The rays of a coarse grid, each with the noise of the pixels that it stands for."""
    camera, mirror, pattern = optics.camera, optics.mirror, optics.pattern
    every_px = max(camera.width_px, camera.height_px) / _ACROSS
    phase_rad = phase_steps.phase_sigma_rad(
        phase_steps.equal_shifts(pattern.steps),
        bin_grid.pixel_sigma_adu(camera.noise_adu),
        swing_adu,
    )
    sigma_mm = phase_rad * phase_steps.mm_per_rad(pattern) / every_px
    column, row = _towards_mirror(geometry, optics, every_px, sag_mm)
    blind = f"at a sag of {sag_mm:.1f} mm the camera as stated sees no fringes in the mirror"
    if column.size == 0:
        raise ValueError(blind)
    dark = forward_model.SetPhases(
        f"{sag_mm:.2f} mm",
        column,
        row,
        np.zeros((2, column.size)),
        np.full(column.size, sigma_mm),
        1e3 * moved_mm,
    )
    bowl = Surface.hencky_bowl(sag_mm, mirror.radius_mm).parameters
    bench, surface = (
        bench_parameters.BenchGeometry(geometry),
        Surface.from_parameters(bowl + _MOUNTED_MM, mirror.radius_mm),
    )
    points = forward_model.place_rays(bench, dark, surface, -moved_mm)
    x_mm, y_mm, _z = geometry.pinhole_mm[:, None] + points.t_mm * points.rays
    screen_mm = -forward_model.residual_mm(bench, dark, surface, -moved_mm)
    inside = np.hypot(x_mm, y_mm) < mirror.analysis_radius_mm
    seen = inside & (np.abs(screen_mm) < pattern.periods * pattern.period_mm / 2).all(axis=0)
    if np.count_nonzero(seen) < PARAMETERS:
        raise ValueError(blind)
    return replace(dark, screen_mm=screen_mm).subset(seen)


def _towards_mirror(
    geometry: Geometry, optics: OpticsConfig, every_px: float, sag_mm: float
) -> tuple[FloatArray, FloatArray]:
    """Columns and rows whose rays meet the plane half way up the bowl inside its ring; others may
    miss the film.
    """
    camera = optics.camera
    grid = np.meshgrid(
        np.arange(0, camera.width_px, every_px), np.arange(0, camera.height_px, every_px)
    )
    column, row = (axis.ravel() for axis in grid)
    rays = geometry.rays(column, row)
    x_mm, y_mm, _z = (
        geometry.pinhole_mm[:, None] + (sag_mm / 2 - geometry.pinhole_mm[2]) / rays[2] * rays
    )
    near = np.hypot(x_mm, y_mm) < optics.mirror.radius_mm
    return column[near], row[near]
