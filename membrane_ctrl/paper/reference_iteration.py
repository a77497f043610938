"""The paper's iteration (its section 2.4): slopes on the last surface, then a new surface.

Its 36 Zernike terms span all polynomials of x and y up to degree 7. The fit here uses the
monomials, which span the same surfaces and share no code with the terms of `measure`.

A point keeps its ray from the pinhole: where the ray meets the last surface is x_0, y_0 and h. The
paper does not say so; with `fixed_mm` a point keeps x_0 and y_0 instead.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.paper.reference_pmd import (
    PaperGeometry,
    Reflection,
    YReading,
    compute_slopes,
)

DEGREE = 7  # of the paper's 36 terms
# Towards the last surface; each contracts by slope times inclination, below 0.05.
_RAY_STEPS = 8
# Powers of x and of y of all terms but the constant: h = 0 at the vertex.
POWERS = tuple((i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i) if i + j > 0)

HeightFunction = Callable[[FloatArray, FloatArray], FloatArray]
SlopeFunction = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
SlopeChange = Callable[[FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True, slots=True)
class PolynomialSurface:
    """Height sum of c_k (x / R)^i (y / R)^j, with the powers of `POWERS`.

    Attributes
    ----------
    coeffs_mm : (terms,) array
    radius_mm : float
        R.
    """

    coeffs_mm: FloatArray
    radius_mm: float

    def height_mm(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Return the height at points.

        Parameters
        ----------
        x_mm, y_mm : (n,) array
            The points.

        Returns
        -------
        (n,) array
            In mm.
        """
        return np.asarray(make_height_matrix(x_mm, y_mm, self.radius_mm) @ self.coeffs_mm)

    def slopes(self, x_mm: FloatArray, y_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the slopes at points.

        Parameters
        ----------
        x_mm, y_mm : (n,) array
            The points.

        Returns
        -------
        along_x, along_y : (n,) array
            dh/dx and dh/dy.
        """
        along_x, along_y = make_slope_matrices(x_mm, y_mm, self.radius_mm)
        return np.asarray(along_x @ self.coeffs_mm), np.asarray(along_y @ self.coeffs_mm)


@dataclass(frozen=True, slots=True)
class StartShape:
    """A starting shape: its height and its slopes, functions of x and y in mm."""

    height_mm: HeightFunction
    slopes: SlopeFunction


@dataclass(frozen=True, slots=True)
class SeenPoints:
    """What the camera measured.

    Attributes
    ----------
    rays : (3, n) array
        Directions from the pinhole, in world.
    screen_mm : (2, n) array
        Point of the screen that is seen, from O'.
    """

    rays: FloatArray
    screen_mm: FloatArray


@dataclass(slots=True)
class ReferenceSolution:
    """A solution and how it was reached.

    Attributes
    ----------
    surface : PolynomialSurface
    changes_mm : list of float
        Largest change of the height in each iteration, over the analysed disc.
    """

    surface: PolynomialSurface
    changes_mm: list[float] = field(default_factory=list)


def make_height_matrix(x_mm: FloatArray, y_mm: FloatArray, radius_mm: float) -> FloatArray:
    """Return the matrix from coefficients of the polynomials to heights.

    Parameters
    ----------
    x_mm, y_mm : (n,) array
        Points.
    radius_mm : float
        By which they are divided.

    Returns
    -------
    (n, terms) array
        In the order of `POWERS`.
    """
    x = x_mm / radius_mm
    y = y_mm / radius_mm
    return np.stack([x**i * y**j for i, j in POWERS], axis=1)


def make_slope_matrices(
    x_mm: FloatArray, y_mm: FloatArray, radius_mm: float
) -> tuple[FloatArray, FloatArray]:
    """Return the matrices from coefficients of the polynomials to slopes.

    Parameters
    ----------
    x_mm, y_mm : (n,) array
        Points.
    radius_mm : float
        By which they are divided.

    Returns
    -------
    along_x, along_y : (n, terms) array
        Per mm, in the order of `POWERS`.
    """
    # The slopes of a term are i x^(i-1) y^j / R and j x^i y^(j-1) / R.
    x = x_mm / radius_mm
    y = y_mm / radius_mm
    along_x = np.stack([i * x ** max(i - 1, 0) * y**j for i, j in POWERS], axis=1)
    along_y = np.stack([j * x**i * y ** max(j - 1, 0) for i, j in POWERS], axis=1)
    return along_x / radius_mm, along_y / radius_mm


def make_parabola(depth_mm: float, radius_mm: float) -> StartShape:
    """Make the paper's starting shape (equation 20): a paraboloid with its vertex at the origin.

    Parameters
    ----------
    depth_mm : float
        Height at the radius.
    radius_mm : float
        Radius of the mirror.
    """
    bend = depth_mm / radius_mm**2
    return StartShape(
        lambda x, y: bend * (x**2 + y**2), lambda x, y: (2.0 * bend * x, 2.0 * bend * y)
    )


def make_cone(depth_mm: float, radius_mm: float) -> StartShape:
    """Make a cone with its tip at the vertex; the slope at the tip is 0.

    Parameters
    ----------
    depth_mm : float
        Height at the radius.
    radius_mm : float
        Radius of the mirror.
    """
    slope = depth_mm / radius_mm

    def slopes(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        distance = np.maximum(np.hypot(x, y), 1e-12)
        return slope * x / distance, slope * y / distance

    return StartShape(lambda x, y: slope * np.hypot(x, y), slopes)


def make_v_fold(depth_mm: float, radius_mm: float) -> StartShape:
    """Make two planes that meet in the y axis.

    Parameters
    ----------
    depth_mm : float
        Height at the radius, on the x axis.
    radius_mm : float
        Radius of the mirror.
    """
    slope = depth_mm / radius_mm
    return StartShape(lambda x, _: slope * np.abs(x), lambda x, y: (slope * np.sign(x), 0.0 * y))


def reconstruct(
    geometry: PaperGeometry,
    seen: SeenPoints,
    start: StartShape | PolynomialSurface,
    radius_mm: float,
    analysis_radius_mm: float,
    iterations: int,
    *,
    reading: YReading = YReading.HEIGHT_OF_POINT,
    fixed_mm: FloatArray | None = None,
    y_geometry: PaperGeometry | None = None,
    y_change: SlopeChange | None = None,
) -> ReferenceSolution:
    """Reconstruct the surface by the paper's equations.

    Parameters
    ----------
    geometry : PaperGeometry
        a, b and alpha.
    seen : SeenPoints
        The measurement.
    start : StartShape
        h^(0).
    radius_mm, analysis_radius_mm : float
        Of the mirror, and of the disc whose change of height is stated.
    iterations : int
    reading : YReading
        What the y equations mean.
    fixed_mm : (2, n) array, optional
        x_0 and y_0 that the points keep; without, each keeps its ray.
    y_geometry : PaperGeometry, optional
        That of the y equations, if it is not that of x.
    y_change : callable, optional
        Changes the y slopes (n,) of points (3, n): an error of the y equations.

    Returns
    -------
    ReferenceSolution
    """
    if iterations < 1:
        raise ValueError("iterations must be at least 1")
    # The change of height is compared at points of the analysed disc.
    probe = _probe_matrix(radius_mm, analysis_radius_mm)
    probe_x_mm, probe_y_mm = _probe_points(analysis_radius_mm)
    last_mm = start.height_mm(probe_x_mm, probe_y_mm)
    shape: StartShape | PolynomialSurface = start
    changes_mm: list[float] = []
    for _ in range(iterations):
        # Step 1: points on the last shape, and their slopes (equations 3 to 14).
        points_mm = _place_points(geometry, seen, shape, fixed_mm)
        rays = _reflect(geometry, points_mm, shape)
        slopes = compute_slopes(geometry, points_mm, seen.screen_mm, rays, reading, y_geometry)
        if y_change is not None:
            slopes[1] += y_change(points_mm, slopes[1])

        # Steps 2 and 3: the shape with these slopes (equations 19 and 21), and the largest change
        # of height (equation 22).
        shape = _fit_slopes(points_mm, slopes, radius_mm)
        height_mm = probe @ shape.coeffs_mm
        changes_mm.append(float(np.max(np.abs(height_mm - last_mm))))
        last_mm = height_mm
    assert isinstance(shape, PolynomialSurface)
    return ReferenceSolution(shape, changes_mm)


def predict_seen(
    geometry: PaperGeometry, rays: FloatArray, surface: PolynomialSurface
) -> SeenPoints:
    """What a camera sees of a surface, by reflection of vectors, without the paper's equations.

    Parameters
    ----------
    geometry : PaperGeometry
        The paper's a, b and alpha.
    rays : (3, n) array
        Rays of the pixels, from the pinhole.
    surface : PolynomialSurface
        The mirror.

    Returns
    -------
    SeenPoints
        The points of the screen that each ray reaches.
    """
    # From the points of the surface, the reflected rays.
    points_mm = _place_points(geometry, SeenPoints(rays, np.zeros((2, 0))), surface, None)
    reflected = _reflect(geometry, points_mm, surface).reflected

    # The screen's plane through O' = b (-cos alpha, 0, sin alpha), across O O'.
    cosine = math.cos(geometry.alpha_rad)
    sine = math.sin(geometry.alpha_rad)
    face = np.array([-cosine, 0.0, sine])
    centre_mm = np.asarray(geometry.b_mm)[..., None] * face

    # Where they meet it, from O', along the screen's own x and y.
    reach_mm = ((centre_mm - points_mm.T) @ face) / (reflected @ face)
    on_screen_mm = points_mm.T + reach_mm[:, None] * reflected - centre_mm
    along_x = np.array([-sine, 0.0, -cosine])
    return SeenPoints(rays, np.stack([on_screen_mm @ along_x, on_screen_mm[:, 1]]))


def _place_points(
    geometry: PaperGeometry,
    seen: SeenPoints,
    shape: StartShape | PolynomialSurface,
    fixed_mm: FloatArray | None,
) -> FloatArray:
    """Points (3, n) on the last surface."""
    # Fixed x_0 and y_0: only the height follows the surface.
    if fixed_mm is not None:
        return np.stack([*fixed_mm, shape.height_mm(*fixed_mm)])

    # Along the ray to the level of the last height, then the height there, and so on.
    pinhole_mm = geometry.pinhole_mm[:, None]
    height_mm: FloatArray | float = 0.0
    points_mm = pinhole_mm
    for _ in range(_RAY_STEPS):
        reach = (height_mm - pinhole_mm[2]) / seen.rays[2]
        points_mm = pinhole_mm + reach * seen.rays
        height_mm = shape.height_mm(points_mm[0], points_mm[1])
    return np.stack([points_mm[0], points_mm[1], np.asarray(height_mm)])


def _reflect(
    geometry: PaperGeometry, points_mm: FloatArray, shape: StartShape | PolynomialSurface
) -> Reflection:
    """Normal, incident and reflected ray at points (3, n) of the last surface."""
    # n ~ (-dh/dx, -dh/dy, 1), u from F to P, v = u - 2 (u n) n.
    slope_x, slope_y = shape.slopes(points_mm[0], points_mm[1])
    normal = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    incident = points_mm.T - geometry.pinhole_mm
    incident /= np.linalg.norm(incident, axis=1, keepdims=True)
    towards = np.sum(incident * normal, axis=1, keepdims=True)
    return Reflection(normal, incident, incident - 2.0 * towards * normal)


def _fit_slopes(points_mm: FloatArray, slopes: FloatArray, radius_mm: float) -> PolynomialSurface:
    """The paper's equation 19: least squares of both slopes, without the singular piston."""
    along_x, along_y = make_slope_matrices(points_mm[0], points_mm[1], radius_mm)
    design = np.concatenate([along_x, along_y])
    coeffs_mm, *_ = np.linalg.lstsq(design, np.concatenate(slopes), rcond=None)
    return PolynomialSurface(coeffs_mm, radius_mm)


def _probe_points(analysis_radius_mm: float) -> tuple[FloatArray, FloatArray]:
    """Points over the analysed disc at which changes of the height are compared."""
    axis_mm = np.linspace(-analysis_radius_mm, analysis_radius_mm, 41)
    x_mm, y_mm = np.meshgrid(axis_mm, axis_mm)
    inside = np.hypot(x_mm, y_mm) <= analysis_radius_mm
    return x_mm[inside], y_mm[inside]


def _probe_matrix(radius_mm: float, analysis_radius_mm: float) -> FloatArray:
    return make_height_matrix(*_probe_points(analysis_radius_mm), radius_mm)
