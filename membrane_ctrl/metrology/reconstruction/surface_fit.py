"""From rays and screen points to the surface: ray-traced slopes, least squares, iterated (the
paper's section 2.4).

Slope and height need each other: the slope at a pixel is the bisector at the point where its ray
meets the film, and where that is depends on the height. The iteration starts from any shape and
contracts by about 300 a step.

Each step solves (D^T W D) delta = D^T W (g - D a) and adds delta to a. Where delta vanishes, a is
the least-squares solution on its own surface, whatever matrix is on the left: a matrix of an
earlier step, or cycle, may be kept without changing the solution.
"""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.rays.ray_tracing import HeightFunction, Points, Tracer
from membrane_ctrl.metrology.rays.surface import PARAMETERS, Surface, height_probe
from membrane_ctrl.metrology.reconstruction.normal_matrix import (
    NormalMatrix,
    residual_rms,
    right_side,
)
from membrane_ctrl.model.arrays import FloatArray

TOLERANCE_MM = 1e-6  # the paper's threshold on the largest change of height
CONTRACTION = 1 / 100  # of one step; observed: 1/300, the rest is margin
MAX_ITERATIONS = 20


@dataclass(frozen=True)
class Fit:
    """Solution and how it was reached.

    Attributes
    ----------
    surface : Surface
    normal : NormalMatrix
        Of the last step.
    changes_mm : tuple of float
        Largest change of height of each step over the disc (paper, eq. 22).
    converged : bool
    residual_x, residual_y : float
        Weighted RMS of measured minus fitted slope, without unit.
    weight_sum : float
        Sum of the points' weights.
    """

    surface: Surface
    normal: NormalMatrix
    changes_mm: tuple[float, ...]
    converged: bool
    residual_x: float
    residual_y: float
    weight_sum: float


def fit_surface(
    tracer: Tracer,
    points: Points,
    start: HeightFunction | Surface,
    *,
    normal: NormalMatrix | None = None,
    tolerance_mm: float = TOLERANCE_MM,
    max_iterations: int = MAX_ITERATIONS,
) -> Fit:
    """Fit the surface to the points (the iteration of the paper, section 2.4).

    Parameters
    ----------
    tracer : Tracer
        The bench.
    points : Points
        Rays, and the screen points that they show; their lengths are moved to the surface.
    start : height function or Surface
        A height function places the points once. A Surface is the last solution: the points must
        then be on it, one or two steps are enough, and the matrix of the first one is kept.
    normal : NormalMatrix, optional
        A matrix to keep instead of recomputing it each step (the solution is the same).
    tolerance_mm : float
        Stop when the largest change of height, after the contraction still to come, is below this.
    max_iterations : int
        Steps after which the fit ends anyway.

    Returns
    -------
    Fit
        `converged` is False if `max_iterations` was not enough, or if a number was not finite.
    """
    placed = not isinstance(start, Surface)
    if isinstance(start, Surface):
        surface = start
    else:
        tracer.place_on_shape(points, start)
        surface = Surface.from_parameters(np.zeros(PARAMETERS), tracer.radius_mm)

    # Gauss-Newton steps, each with the points moved onto the present surface, until the largest
    # change of height is small enough.
    changes: list[float] = []
    step = None
    while len(changes) < max_iterations:
        step = _gauss_newton_step(tracer, points, surface, normal, newton=0 if placed else 1)
        placed = False
        if isinstance(start, Surface):
            normal = step.normal
        surface = Surface.from_parameters(surface.parameters + step.delta, tracer.radius_mm)
        changes.append(float(np.max(np.abs(height_probe() @ step.delta))))
        if not changes[-1] * CONTRACTION > tolerance_mm:  # also ends on NaN
            break
    if step is None:
        raise ValueError("max_iterations must be at least 1")
    residual_x, residual_y = residual_rms(step.sums, step.right, step.normal, step.delta)
    converged = changes[-1] * CONTRACTION <= tolerance_mm
    return Fit(
        surface,
        step.normal,
        tuple(changes),
        converged,
        residual_x,
        residual_y,
        float(step.sums[-1]),
    )


@dataclass(frozen=True)
class _Step:
    """A Gauss-Newton step: moments of the residual, right-hand side of x and y slopes, matrix, and
    change of the parameters.
    """

    sums: FloatArray
    right: FloatArray
    normal: NormalMatrix
    delta: FloatArray


def _gauss_newton_step(
    tracer: Tracer, points: Points, surface: Surface, normal: NormalMatrix | None, newton: int
) -> _Step:
    """One Gauss-Newton step, (D^T W D) delta = D^T W r (paper, eq. 19, with the residual r = g - D
    a instead of g, and the points' weights W).

    Before it, Newton steps move the points onto the surface (0: they stay).
    """
    sums = tracer.residual_sums(points, surface, newton)
    matrix = normal or NormalMatrix.from_points(tracer, points)
    right = right_side(sums, tracer.radius_mm)
    return _Step(sums, right, matrix, matrix.solve(right.sum(axis=0)))
