"""From rays and screen points to the surface: ray-traced slopes, least squares, iterated (the
paper's section 2.4).

Slope and height need each other: the slope at a pixel is the bisector at the point where its ray
meets the film, and where that is depends on the height. The iteration starts from any shape and
contracts by about 300 a step.

Each step solves (D^T W D) delta = D^T W (g - D a) and adds delta to a. Where delta vanishes, a is
the least-squares solution on its own surface, whatever matrix is on the left: a matrix of an
earlier step, or cycle, may be kept without changing the solution.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from membrane_ctrl.metrology.film import film_law
from membrane_ctrl.metrology.numerics import compiled, zernike
from membrane_ctrl.metrology.rays import kernels
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.surface import PARAMETERS, Surface, height_probe
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_DEGREE

# Normal equations of the slope fit, made from moments (the paper's eqs. for D, G and A).
#
# With D the derivatives of the basis at the points and g the measured slopes, A = (D^T D)^-1 D^T g.
# All derivatives of the Zernike terms are polynomials of one degree less in x and y, so D^T g and
# D^T D follow exactly from sums of monomials over the points; no matrix of 2N rows is ever built.
# As printed, D^T D is singular: piston has no slope. Here the Hencky excess replaces piston's
# column, scaled to
# unit RMS like the
# others.

_M = kernels.SLOPE_MONOMIALS
_POWERS = [
    (p, q) for p in range(ZERNIKE_DEGREE) for q in range(ZERNIKE_DEGREE - p)
]  # in the kernels' order
_PRODUCT_POWERS = [
    (p, q) for p in range(kernels.PRODUCT_DEGREE + 1) for q in range(kernels.PRODUCT_DEGREE + 1 - p)
]


@cache
def slope_tables() -> tuple[FloatArray, FloatArray]:
    """dZ_j/dx and dZ_j/dy for j = 2, 3, ... as monomial coefficients, (terms - 1, SLOPE_MONOMIALS)
    each, on the unit disc."""
    rows, columns = np.array(_POWERS).T
    tables = [
        zernike.differentiate(zernike.monomial_table(), axis)[1:, rows, columns] for axis in (1, 2)
    ]
    return tables[0], tables[1]


@cache
def _product_index() -> IntArray:
    """Index of the product of monomials k and l among the product moments, a square matrix."""
    place = {power: k for k, power in enumerate(_PRODUCT_POWERS)}
    return np.array([[place[a[0] + b[0], a[1] + b[1]] for b in _POWERS] for a in _POWERS])


@dataclass(frozen=True)
class NormalMatrix:
    """D^T W D, apart for x and y slopes, and its inverse."""

    # (parameters, parameters): shares of the x and of the y slopes, in 1/mm^2 times weight
    x: FloatArray
    y: FloatArray  # (parameters, parameters)
    # (parameters, parameters), of their sum; the condition number is below 1000, and the next step
    # corrects what rounding leaves
    inverse: FloatArray

    @classmethod
    def from_products(cls, products: FloatArray, radius_mm: float) -> "NormalMatrix":
        """From the moments of `kernels.product_sums`. Raises ValueError if the points do not
        determine a surface.
        """
        x, y = _assemble(products, radius_mm)
        inverse = x + y
        if not kernels.invert(inverse):
            raise ValueError(
                f"the measured points do not determine the {PARAMETERS} parameters of the surface"
            )
        return cls(x, y, inverse)

    def solve(self, right: FloatArray) -> FloatArray:
        """(D^T W D)^-1 times `right`."""
        return np.asarray(self.inverse @ right)


def _assemble(products: FloatArray, radius_mm: float) -> tuple[FloatArray, FloatArray]:
    count = kernels.PRODUCT_MONOMIALS
    hankel = products[:count][_product_index()]
    crosses = products[count : count + _M], products[count + _M : count + 2 * _M]
    out = []
    # the excess' slopes are 2 x e'(v) / R and 2 y e'(v) / R
    for table, cross, square in zip(slope_tables(), crosses, products[-2:], strict=True):
        matrix = np.empty((PARAMETERS, PARAMETERS))
        matrix[:-1, :-1] = table @ hankel @ table.T
        matrix[-1, :-1] = matrix[:-1, -1] = 2 * (table @ cross)
        matrix[-1, -1] = 4 * square
        out.append(matrix / radius_mm**2)
    return out[0], out[1]


def right_side(sums: FloatArray, radius_mm: float) -> FloatArray:
    """D^T W r of the x and of the y slopes, (2, parameters), from the moments of
    `kernels.residual_sums`.
    """
    out = np.empty((2, PARAMETERS))
    for axis, table in enumerate(slope_tables()):
        out[axis, :-1] = table @ sums[axis * _M : (axis + 1) * _M]
        out[axis, -1] = 2 * sums[2 * _M + axis]
    return out / radius_mm


def residual_rms(
    sums: FloatArray, right: FloatArray, normal: NormalMatrix, delta: FloatArray
) -> tuple[float, float]:
    """RMS of the x and of the y slopes' residual after the step `delta`, without another pass over
    the points.

    |r - D delta|^2 = |r|^2 - 2 delta D^T r + delta D^T D delta, each sum weighted.
    """
    weight = sums[-1]
    if not weight > 0:
        return float("nan"), float("nan")
    squares = [
        sums[2 * _M + 2 + axis] - 2 * delta @ right[axis] + delta @ matrix @ delta
        for axis, matrix in enumerate((normal.x, normal.y))
    ]
    x, y = (float(np.sqrt(max(square, 0.0) / weight)) for square in squares)
    return x, y


HeightFunction = Callable[[FloatArray, FloatArray], FloatArray]  # x_mm, y_mm -> h_mm

TOLERANCE_MM = 1e-6  # the paper's threshold on the largest change of height
CONTRACTION = 1 / 100  # of one step; observed: 1/300, the rest is margin
MAX_ITERATIONS = 20
_EXCESS = film_law.excess() / film_law.excess_rms()


@dataclass
class Points:
    """What was measured, on any set of points: binned or every pixel."""

    rays: FloatArray  # (3, n): unit vectors in world, from the pinhole
    screen_mm: FloatArray  # (2, n): s_x, s_y seen there, from O'
    weights: FloatArray  # (n,): of both slopes of a point; 0 leaves it out
    # (n,): length of each ray to the surface; kept between solutions as the start of the next
    t_mm: FloatArray

    @classmethod
    def of(
        cls, rays: FloatArray, screen_mm: FloatArray, weights: FloatArray | None = None
    ) -> "Points":
        """Points with unit weights unless given."""
        count = rays.shape[1]
        weights = np.ones(count) if weights is None else weights
        return cls(
            np.ascontiguousarray(rays), np.ascontiguousarray(screen_mm), weights, np.zeros(count)
        )

    def subset(self, keep: BoolArray | IntArray) -> "Points":
        """Those points where `keep` is set, or those at these places."""
        return Points(
            np.ascontiguousarray(self.rays[:, keep]),
            np.ascontiguousarray(self.screen_mm[:, keep]),
            self.weights[keep],
            self.t_mm[keep],
        )


@dataclass(frozen=True)
class Fit:
    """Solution and how it was reached."""

    surface: Surface
    normal: NormalMatrix
    changes_mm: tuple[float, ...]  # largest change of height of each step over the disc
    converged: bool
    residual_x: float  # weighted RMS of measured minus fitted slope (a slope, without unit)
    residual_y: float
    weight_sum: float  # sum of the weights


class Tracer:
    """A geometry with the vertex at a height, over a disc: runs the kernels on points."""

    def __init__(self, geometry: Geometry, radius_mm: float, vertex_z_mm: float = 0.0) -> None:
        self.geometry = geometry
        self.radius_mm = radius_mm
        self.vertex_z_mm = vertex_z_mm
        self._pinhole = geometry.pinhole_mm
        self._plane = np.vstack([geometry.screen_origin_mm, geometry.screen_axes])
        self._face = geometry.face

    def start(self, points: Points, height: HeightFunction) -> None:
        """Put the points on a starting shape, by t <- (vertex_z + h - F_z) / d_z.

        Contracts by slope times inclination of the ray (below 0.1), so that kinks of a cone do no
        harm.
        """
        f, d = self._pinhole, points.rays
        points.t_mm[:] = (self.vertex_z_mm - f[2]) / d[2]
        for _ in range(12):
            h = height(f[0] + points.t_mm * d[0], f[1] + points.t_mm * d[1])
            points.t_mm[:] = (self.vertex_z_mm + h - f[2]) / d[2]

    def intersect(self, points: Points, surface: Surface, newton: int = 1) -> None:
        """Put the points on a surface, from where they are, by Newton steps."""
        shape = surface.polynomial, surface.excess, 1.0, self.radius_mm

        def run(start: int, stop: int) -> None:
            kernels.intersect(
                points.rays,
                points.t_mm,
                self._pinhole,
                *shape,
                self.vertex_z_mm,
                newton,
                start,
                stop,
            )

        compiled.split(run, points.t_mm.size, compiled.FEW)

    def residual_sums(self, points: Points, surface: Surface, newton: int = 0) -> FloatArray:
        """Moments of the slope residual (see `kernels.residual_sums`), after Newton steps towards
        the surface.
        """
        shape = self._shape(surface)

        def run(start: int, stop: int) -> FloatArray:
            rays, t = points.rays, points.t_mm
            kernels.intersect(rays, t, self._pinhole, *shape, self.vertex_z_mm, newton, start, stop)
            fixed = (
                rays,
                t,
                points.screen_mm,
                points.weights,
                self._pinhole,
                self._plane,
                self._face,
            )
            return np.asarray(kernels.residual_sums(*fixed, *shape, start, stop))

        return np.asarray(np.sum(compiled.split(run, points.t_mm.size, compiled.FEW), axis=0))

    def normal_matrix(self, points: Points) -> NormalMatrix:
        """D^T W D at the points' present places."""

        def run(start: int, stop: int) -> FloatArray:
            fixed = (
                points.rays,
                points.t_mm,
                points.weights,
                self._pinhole,
                _EXCESS,
                self.radius_mm,
            )
            return np.asarray(kernels.product_sums(*fixed, start, stop))

        return NormalMatrix.from_products(
            np.sum(compiled.split(run, points.t_mm.size, compiled.FEW), axis=0), self.radius_mm
        )

    def slope_field(self, points: Points, surface: Surface) -> FloatArray:
        """(6, n): x, y in mm, measured dh/dx, dh/dy, fitted dh/dx, dh/dy at the points."""
        shape = self._shape(surface)
        out = np.empty((6, points.t_mm.size))

        def run(start: int, stop: int) -> None:
            fixed = (
                points.rays,
                points.t_mm,
                points.screen_mm,
                self._pinhole,
                self._plane,
                self._face,
            )
            kernels.slope_field(*fixed, *shape, out, start, stop)

        compiled.split(run, points.t_mm.size, compiled.FEW)
        return out

    def predict_screen(self, points: Points, surface: Surface) -> FloatArray:
        """Screen points (2, n) in mm that the surface would send the rays to; the points must be on
        it.
        """
        shape = self._shape(surface)
        out = np.empty((2, points.t_mm.size))

        def run(start: int, stop: int) -> None:
            fixed = (points.rays, points.t_mm, self._pinhole, self._plane, self._face)
            kernels.predict_screen(*fixed, *shape, out, start, stop)

        compiled.split(run, points.t_mm.size, compiled.FEW)
        return out

    def position_mm(self, points: Points) -> FloatArray:
        """x and y (2, n) of the points."""
        return np.asarray(self._pinhole[:2, None] + points.t_mm * points.rays[:2])

    def _shape(self, surface: Surface) -> tuple[FloatArray, FloatArray, float, float]:
        return (
            surface.polynomial,
            _EXCESS,
            surface.hencky_mm * film_law.excess_rms(),
            self.radius_mm,
        )


def parabola(sag_mm: float, radius_mm: float) -> HeightFunction:
    """The paper's starting shape."""
    return lambda x, y: sag_mm * (x * x + y * y) / radius_mm**2


def solve(
    tracer: Tracer,
    points: Points,
    start: HeightFunction | Surface,
    *,
    normal: NormalMatrix | None = None,
    tolerance_mm: float = TOLERANCE_MM,
    max_iterations: int = MAX_ITERATIONS,
) -> Fit:
    """Fit the surface to the points.

    Parameters
    ----------
    start : height function or Surface
        A height function places the points once. A Surface is the last solution: the points must
        then be on it, and one or two steps are enough.
    normal : NormalMatrix, optional
        A matrix to keep instead of recomputing it each step (the solution is the same).
    tolerance_mm : float
        Stop when the largest change of height, after the contraction still to come, is below this.

    Returns
    -------
    Fit
        `converged` is False if `max_iterations` was not enough, or if a number was not finite.
    """
    placed = not isinstance(start, Surface)
    if isinstance(start, Surface):
        surface = start
    else:
        tracer.start(points, start)
        surface = Surface.from_parameters(np.zeros(PARAMETERS), tracer.radius_mm)
    changes: list[float] = []
    step = None
    while len(changes) < max_iterations:
        step = _step(tracer, points, surface, normal, newton=0 if placed else 1)
        placed = False
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
    sums: FloatArray
    right: FloatArray
    normal: NormalMatrix
    delta: FloatArray


def _step(
    tracer: Tracer, points: Points, surface: Surface, normal: NormalMatrix | None, newton: int
) -> _Step:
    """One Gauss-Newton step, after moving the points onto the surface by Newton steps (0: they
    stay).
    """
    sums = tracer.residual_sums(points, surface, newton)
    matrix = normal or tracer.normal_matrix(points)
    right = right_side(sums, tracer.radius_mm)
    return _Step(sums, right, matrix, matrix.solve(right.sum(axis=0)))
