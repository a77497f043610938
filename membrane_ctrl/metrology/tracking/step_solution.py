"""Level, swings and phases of each bin from five steps of the pattern.

Steps of the pattern give them without fringe orders and without any smoothness. With the phases
that the fits of the single frames give, I_k = A l_k + Re[z_x b_k exp(i (phi_xk + d_xk))] + the
same of y is linear in A, z_x, z_y of a bin; l and b are the maps that the fits found. The angles
of z are shape that the surface lacks: what the terms can represent moves the surface, the rest
stays with the bin.
"""

from dataclasses import replace

import numpy as np

from membrane_ctrl.metrology.rays.surface import PARAMETERS
from membrane_ctrl.metrology.tracking.crossed_scene import CrossedScene
from membrane_ctrl.metrology.tracking.frame_fit import FrameFit, FrameFitter
from membrane_ctrl.model.arrays import FloatArray, Singles

ENOUGH_STEPS = 5  # they separate level, two swings and two phases
_STRAY_SIGMAS = 8.0  # robust ones; phases beyond it are those of dust, and move no surface
# Mean weights of a bin in a step: one that fits now and fails then has changed, and has no weight
# until five steps agree. With its former light it moved the frames of each step by up to 30 nm of
# sag.
_FITS, _FAILS = 0.95, 0.05


def are_steps_separable(shifts_rad: FloatArray) -> bool:
    """Whether steps (N, 2) of x and y separate the two axes."""
    design = _make_design(np.zeros((2, len(shifts_rad))), np.asarray(shifts_rad).T)
    return len(design) >= ENOUGH_STEPS and bool(np.linalg.cond(design) < 10)


def _make_design(phase_rad: FloatArray, shifts_rad: FloatArray) -> FloatArray:
    """Rows (..., 5) of level, cosine and sine of x, of y; phases and shifts are (2, ...)."""
    x, y = phase_rad + shifts_rad
    return np.stack([np.ones_like(x), np.cos(x), -np.sin(x), np.cos(y), -np.sin(y)], axis=-1)


def solve_steps(
    fitter: FrameFitter, fits: list[FrameFit], seen_adu: Singles, shifts_rad: FloatArray
) -> tuple[CrossedScene, FloatArray, FloatArray]:
    """The scene as the steps saw it; by how much that moves the surface's parameters (parameters,),
    and their variance.

    `fits` are those of the N single frames, `seen_adu` (N, n) their bins, `shifts_rad` (N, 2) their
    steps.
    """
    scene = fitter.scene
    design = np.empty((scene.index.size, len(fits), 5))
    rest = np.empty((scene.index.size, len(fits)))
    for k, (fit, shifts) in enumerate(zip(fits, shifts_rad, strict=True)):
        phases = scene.phase_rad(fit.surface)
        maps = 1 + fit.light @ scene.basis
        design[:, k] = _make_design(phases, shifts[:, None]) * maps[[0, 1, 1, 2, 2]].T
        rest[:, k] = seen_adu[k] - scene.harmonics_adu(phases + shifts[:, None])
    turned = np.swapaxes(design, 1, 2)
    solved = np.linalg.solve(turned @ design, turned @ rest[..., None])[..., 0]
    swing = np.hypot(solved[:, 1::2], solved[:, 2::2]).T
    off_rad = np.arctan2(solved[:, 2::2], solved[:, 1::2]).T
    weights = np.stack([fit.weights for fit in fits])
    good = (weights > _FITS).all(axis=0) | (weights < _FAILS).all(axis=0)
    good &= (swing > 0.2 * np.median(swing, axis=1)[:, None]).all(axis=0)
    moved, variance, left_rad = _split_phases(fitter, off_rad, swing * good * np.sqrt(scene.taper))
    light = np.stack([solved[:, 0], *swing])
    light = np.where(good, light, scene.light_adu)
    beyond_mm = scene.beyond_mm + good * left_rad / scene.rad_per_mm
    return (
        replace(scene, light_adu=light, beyond_mm=beyond_mm, edge=scene.taper * good),
        moved,
        variance,
    )


def _split_phases(
    fitter: FrameFitter, off_rad: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Phases (2, n) as a change of the surface's parameters (parameters,), its variance, and what
    is left of them.
    """
    weight, slow, cells = weight**2, fitter.jacobian, fitter.scene.cells
    weighted = (
        slow[:, :, 0] * cells.sums(weight)[:, None]
    )  # it need not be exact: what is left is solved again
    matrix: FloatArray = np.sum(weighted @ slow[:, :, 0].transpose(0, 2, 1), axis=0, dtype=float)
    moved, left_rad, fits = np.zeros(PARAMETERS), off_rad, weight
    for _ in range(3):
        right = np.einsum("apiq,aiq->p", slow, cells.moments(fits * left_rad), dtype=float)
        moved += np.linalg.solve(matrix, right)
        left_rad = off_rad - cells.spread(np.tensordot(moved, slow, (0, 1)))
        reach_rad = _STRAY_SIGMAS * 1.4826 * np.median(np.abs(left_rad[weight > 0]))
        fits = weight * (np.abs(left_rad) <= reach_rad).all(axis=0)
    pull = fitter.in_squares(
        slow.swapaxes(0, 1), fits * left_rad
    )  # light that changed between the steps
    errors = np.linalg.solve(matrix, pull)
    return moved, np.asarray(np.sum(errors**2, axis=1)), left_rad
