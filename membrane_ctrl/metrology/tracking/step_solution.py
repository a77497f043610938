"""Level, swings and phases of each bin from five steps of the pattern.

This needs no fringe orders, and assumes nothing about smoothness. With the phases phi that the fits
of the single frames give, and the maps l and b of level and swing that they found, the light of a
bin in step k,

    I_k = A l_k + Re[z_x b_xk exp(i (phi_xk + d_xk))] + Re[z_y b_yk exp(i (phi_yk + d_yk))],

is linear in its five unknowns A, z_x and z_y. The angles of z are shape that the surface lacks: the
part that the terms can represent moves the surface, the rest stays with the bin.
"""

from dataclasses import replace

import numpy as np

from membrane_ctrl.metrology.rays.surface import PARAMETERS
from membrane_ctrl.metrology.tracking.crossed_scene import CrossedScene
from membrane_ctrl.metrology.tracking.frame_fit import FrameFit, FrameFitter
from membrane_ctrl.model.arrays import FloatArray, Singles

ENOUGH_STEPS = 5  # they separate level, two swings and two phases
_LARGEST_CONDITION = 10  # of the design of steps that separate the axes
_STRAY_SIGMAS = 8.0  # robust ones; phases beyond it are those of dust, and move no surface
_SIGMA_OVER_MAD = 1.4826  # of normal numbers
_SPLIT_ROUNDS = 3  # of the fit without stray phases
# Mean weight of a bin in a step: it fits above the first, and fails below the second. A bin that
# fits in some of the five steps only has changed between them, and has no weight until five steps
# agree: its former light would move the frames of each step by up to 30 nm of sag.
_FITS = 0.95
_FAILS = 0.05
_LEAST_SWING = 0.2  # over the median swing


def are_steps_separable(shifts_rad: FloatArray) -> bool:
    """Whether steps (N, 2) of x and y separate the two axes."""
    design = _make_design(np.zeros((2, len(shifts_rad))), np.asarray(shifts_rad).T)
    if len(design) < ENOUGH_STEPS:
        return False
    return bool(np.linalg.cond(design) < _LARGEST_CONDITION)


def _make_design(phase_rad: FloatArray, shifts_rad: FloatArray) -> FloatArray:
    """Rows (..., 5) of level, cosine and sine of x, of y; phases and shifts are (2, ...)."""
    x, y = phase_rad + shifts_rad
    columns = [np.ones_like(x), np.cos(x), -np.sin(x), np.cos(y), -np.sin(y)]
    return np.stack(columns, axis=-1)


def solve_steps(
    fitter: FrameFitter, fits: list[FrameFit], seen_adu: Singles, shifts_rad: FloatArray
) -> tuple[CrossedScene, FloatArray, FloatArray]:
    """Solve light and phases of each bin.

    Parameters
    ----------
    fitter : FrameFitter
        Fitter of the present scene.
    fits : list of FrameFit
        Solutions of the N steps.
    seen_adu : (N, n) array
        Light of the bins in each.
    shifts_rad : (N, 2) array
        Phase steps of x and y.

    Returns
    -------
    scene : CrossedScene
        The scene with the light and phases that the steps show.
    moved_mm : (parameters,) array
        Change of the surface's parameters that these phases imply.
    variance_mm2 : (parameters,) array
        Its variance.
    """
    scene = fitter.scene

    # Least squares of each bin, for level, cosine and sine of x, and of y.
    design = np.empty((scene.index.size, len(fits), 5))
    rest = np.empty((scene.index.size, len(fits)))
    for k, (fit, shifts) in enumerate(zip(fits, shifts_rad, strict=True)):
        # Maps of level and swings multiply the columns of A, of z_x and of z_y.
        phases = scene.phase_rad(fit.surface)
        maps = 1 + fit.light @ scene.basis
        map_of_columns = maps[[0, 1, 1, 2, 2]].T
        design[:, k] = _make_design(phases, shifts[:, None]) * map_of_columns
        harmonics_adu = scene.harmonics_adu(phases + shifts[:, None])
        rest[:, k] = seen_adu[k] - harmonics_adu
    turned = np.swapaxes(design, 1, 2)
    solved = np.linalg.solve(turned @ design, turned @ rest[..., None])[..., 0]
    cosine = solved[:, 1::2]
    sine = solved[:, 2::2]
    swing = np.hypot(cosine, sine).T
    off_rad = np.arctan2(sine, cosine).T

    # Bins that have not changed between the steps, and whose fringes have contrast in both axes.
    weights = np.stack([fit.weights for fit in fits])
    good = (weights > _FITS).all(axis=0) | (weights < _FAILS).all(axis=0)
    least_swing = _LEAST_SWING * np.median(swing, axis=1)[:, None]
    good &= (swing > least_swing).all(axis=0)

    # The phases: one part moves the surface, the rest stays with the bins.
    weight = swing * good * np.sqrt(scene.taper)
    moved_mm, variance_mm2, left_rad = _split_phases(fitter, off_rad, weight)
    light_adu = np.stack([solved[:, 0], *swing])
    solved_scene = replace(
        scene,
        light_adu=np.where(good, light_adu, scene.light_adu),
        beyond_mm=scene.beyond_mm + good * left_rad / scene.rad_per_mm,
        edge=scene.taper * good,
    )
    return solved_scene, moved_mm, variance_mm2


def _split_phases(
    fitter: FrameFitter, off_rad: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Split phases into a change of the surface's parameters and the rest.

    Parameters
    ----------
    fitter : FrameFitter
        Fitter of the present scene.
    off_rad : (2, n) array
        Phases of the bins beyond those of the surface.
    weight : (2, n) array
        Square roots of their weights.

    Returns
    -------
    moved_mm : (parameters,) array
        Change of the parameters.
    variance_mm2 : (parameters,) array
        Its variance, from what light that changed between the steps contributes.
    left_rad : (2, n) array
        Phases that are left.
    """
    weights = weight**2
    slow = fitter.jacobian
    cells = fitter.scene.cells

    # Normal matrix from the means over the cells. It need not be exact: what it leaves is solved
    # again.
    means = slow[:, :, 0]
    weighted = means * cells.sum_cells(weights)[:, None]
    matrix: FloatArray = np.sum(weighted @ means.transpose(0, 2, 1), axis=0, dtype=float)

    # Rounds of least squares, without stray phases.
    moved_mm = np.zeros(PARAMETERS)
    left_rad = off_rad
    used = weights
    for _ in range(_SPLIT_ROUNDS):
        right = np.einsum("apiq,aiq->p", slow, cells.sum_moments(used * left_rad), dtype=float)
        moved_mm += np.linalg.solve(matrix, right)
        left_rad = off_rad - cells.evaluate_planes(np.tensordot(moved_mm, slow, (0, 1)))
        median_rad = np.median(np.abs(left_rad[weights > 0]))
        reach_rad = _STRAY_SIGMAS * _SIGMA_OVER_MAD * median_rad
        used = weights * (np.abs(left_rad) <= reach_rad).all(axis=0)

    pull = fitter.average_in_squares(slow.swapaxes(0, 1), used * left_rad)
    errors_mm = np.linalg.solve(matrix, pull)
    return moved_mm, np.asarray(np.sum(errors_mm**2, axis=1)), left_rad
