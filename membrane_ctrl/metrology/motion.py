"""The film's known motion between the frames, taken out of the phase.

A point's phase at displacement d is phi + q (d - d0), with q = d phi / d d known from the model (a Hencky bowl whose
sag grows by one micrometre while the ring stays). Frame k then shows A + Re(z exp(i d_k) (1 + i q e_k)) to first
order in e_k = d(t_k) - d0, where z = B exp(i phi) and d_k is the phase step. With the complex weights
w_k = cosine_k + i sine_k of the phase steps (sum w = 0, sum w cos d_k = 1, sum w sin d_k = -i) the estimate is

    z' = z + q sum_k w_k e_k Re(i z exp(i d_k)) = z + i q (turn z - mirror conj z),
    turn = 1/2 sum w_k e_k exp(i d_k),   mirror = 1/2 sum w_k e_k exp(-i d_k),

so z = z' - i q (turn z' - mirror conj z') to first order. A constant e gives turn = e and mirror = 0: a plain shift
of phase. Counting e from one d0 for both axes therefore also brings x and y, taken at different times, to one moment.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.metrology.phasor import StepCombination
from membrane_ctrl.metrology.reconstruct import Points, Tracer
from membrane_ctrl.metrology.surface import Surface

FloatArray = NDArray[np.float64]


def combine_steps(
    weights: FloatArray, shifts_rad: FloatArray, bin_px: int, motion_um: FloatArray | None = None
) -> StepCombination:
    """How the frames of one axis combine, for bin sums.

    Parameters
    ----------
    weights : (3, N) array
        `phase.step_weights(shifts_rad)`.
    motion_um : (N,) array, optional
        Displacement of each frame relative to one d0 for both axes.
    """
    _, cosine, sine = weights / bin_px**2
    if motion_um is None:
        return StepCombination(cosine, sine)
    # of a phasor per pixel: the bin's area cancels
    moved = (weights[1] + 1j * weights[2]) * motion_um / 2
    turn, mirror = (complex(moved @ np.exp(sign * 1j * shifts_rad)) for sign in (1, -1))
    return StepCombination(cosine, sine, turn, mirror)


def worth_correcting(displacement_um: FloatArray, noise_um: float) -> bool:
    """Whether the readings show motion beyond the laser's noise.

    A swing of 1 um standard deviation left in the frames costs 0.3 um RMS of figure; correcting with 1 um of pure
    noise costs 0.12 um (both measured on the twin). Above 1.5 times the noise nearly all of what is seen is motion.
    """
    return bool(np.all(np.isfinite(displacement_um)) and np.std(displacement_um) > 1.5 * noise_um)


def sensitivity_mm_per_um(tracer: Tracer, points: Points, surface: Surface, step_um: float = 10.0) -> FloatArray:
    """Change (2, n) of the screen points per um of displacement, by a central difference of the traced model.

    The bowl's sag grows by the displacement and its vertex moves towards -z, so that the ring stays where it is.
    """
    traced = []
    for sign in (1.0, -1.0):
        deeper_mm = sign * step_um * 1e-3
        bowl = Surface.hencky_bowl(deeper_mm, surface.radius_mm)
        moved = Surface.from_parameters(surface.parameters + bowl.parameters, surface.radius_mm)
        bench = Tracer(tracer.geometry, tracer.radius_mm, tracer.vertex_z_mm - deeper_mm)
        there = Points(points.rays, points.screen_mm, points.weights, points.t_mm.copy())
        bench.intersect(there, moved, newton=3)
        traced.append(bench.predict_screen(there, moved))
    return (traced[0] - traced[1]) / (2 * step_um)
