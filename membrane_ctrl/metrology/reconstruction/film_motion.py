"""Correction of the phase for the film's known motion between the frames.

A point's phase at displacement d is phi + q (d - d0), with q = d phi / d d known from the model (a
Hencky bowl whose sag grows by one micrometre while the ring stays). Frame k then shows A + Re(z
exp(i d_k) exp(i q e_k)) with e_k = d(t_k) - d0, where z = B exp(i phi) and d_k is the phase step.
With the complex weights w_k = cosine_k + i sine_k of the phase steps (sum w = 0, sum w cos d_k =
1, sum w sin d_k = -i) the estimate is

    z' = T z + M conj z,   T = 1 + i q turn - q^2 turn_2 / 2,   M = -i q mirror - q^2 mirror_2 / 2,
    turn_n = 1/2 sum w_k e_k^n exp(i d_k),   mirror_n = 1/2 sum w_k e_k^n exp(-i d_k),

to second order, so z = (conj T z' - M conj z') / (|T|^2 - |M|^2). A constant e gives turn = e and
mirror = 0: a plain shift of phase. Counting e from one d0 for both axes therefore also brings x
and y, taken at different times, to one moment.
"""

import numpy as np

from membrane_ctrl.metrology.phase import phase_change
from membrane_ctrl.metrology.rays import ray_tracing
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.model.arrays import FloatArray

_ROUNDING = 1e-12  # of the largest weight


def combine_steps(
    weights: FloatArray, shifts_rad: FloatArray, bin_px: int, motion_um: FloatArray | None = None
) -> phase_change.StepCombination:
    """How the frames of one axis combine, for bin sums.

    Parameters
    ----------
    weights : (3, N) array
        `phase_steps.step_weights(shifts_rad)`.
    shifts_rad : (N,) array
        Phase steps.
    bin_px : int
        Side of the bins over which the frames are summed.
    motion_um : (N,) array, optional
        Displacement e of each frame relative to one d0 for both axes.

    Returns
    -------
    StepCombination
    """
    # A weight that is 0 but for rounding is 0, and costs no time.
    is_rounding = np.abs(weights) < _ROUNDING * np.abs(weights).max()
    _, cosine, sine = np.where(is_rounding, 0.0, weights) / bin_px**2
    if motion_um is None:
        return phase_change.StepCombination(cosine, sine)
    # turn_n and mirror_n for n = 1 and 2. The phasors are per pixel: the bin's area cancels.
    powers = motion_um ** np.array([[1], [2]])
    moments = (weights[1] + 1j * weights[2]) / 2 * powers
    turn = moments @ np.exp(1j * shifts_rad)
    mirror = moments @ np.exp(-1j * shifts_rad)
    return phase_change.StepCombination(cosine, sine, turn, mirror)


def is_worth_correcting(displacement_um: FloatArray, noise_um: float) -> bool:
    """Whether the readings show motion beyond the laser's noise.

    A swing of 1 µm standard deviation left in the frames costs 0.3 µm RMS of figure; correcting
    with 1 µm of pure noise costs 0.12 µm (both measured on the twin). Above 1.5 times the noise
    nearly all of it is motion.

    Parameters
    ----------
    displacement_um : (frames,) array
        Readings; NaN where there is none.
    noise_um : float
        Standard deviation of a reading.
    """
    return bool(np.all(np.isfinite(displacement_um)) and np.std(displacement_um) > 1.5 * noise_um)


def sensitivity_mm_per_um(
    tracer: ray_tracing.Tracer, points: ray_tracing.Points, surface: Surface, step_um: float = 10.0
) -> FloatArray:
    """Change of the screen points per µm of displacement, by a central difference.

    The bowl's sag grows by the displacement and its vertex moves towards -z, so that the ring stays
    where it is.

    Parameters
    ----------
    tracer : Tracer
        The bench.
    points : Points
        Rays, on the surface.
    surface : Surface
        The present surface.
    step_um : float
        Displacement to either side.

    Returns
    -------
    (2, n) array
        In mm per µm.
    """
    traced = []
    for sign in (1.0, -1.0):
        # The same rays on a bowl that is deeper, or less deep, with the ring where it is.
        deeper_mm = sign * step_um * 1e-3
        bowl = Surface.hencky_bowl(deeper_mm, surface.radius_mm)
        moved = Surface.from_parameters(surface.parameters + bowl.parameters, surface.radius_mm)
        bench = ray_tracing.Tracer(
            tracer.geometry, tracer.radius_mm, tracer.vertex_z_mm - deeper_mm
        )
        there = ray_tracing.Points(
            points.rays, points.screen_mm, points.weights, points.t_mm.copy()
        )
        bench.intersect(there, moved, newton=3)
        traced.append(bench.predict_screen(there, moved))
    return (traced[0] - traced[1]) / (2 * step_um)
