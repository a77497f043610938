"""The fitted surface: Zernike terms plus the part of a Hencky bowl that they cannot represent.

The excess is orthogonal to the terms over the disc, so the coefficients are those of the whole
surface whatever its amplitude: a shape made of the terms has amplitude 0, a true Hencky bowl has
its own sag.
"""

import math
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.polynomial import polynomial as series

from membrane_ctrl.metrology.film import film_law
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

PARAMETERS = ZERNIKE_TERMS  # all but piston, which follows from h(0) = 0, and the excess


@dataclass(frozen=True)
class Surface:
    """Height above the vertex, h(0, 0) = 0, over a disc."""

    coeffs_mm: (
        FloatArray  # (terms,): in Noll's order, orthonormal; piston is whatever makes h(0, 0) = 0
    )
    hencky_mm: float  # amplitude of the excess, as the sag of the Hencky bowl it belongs to
    radius_mm: float  # radius of the Zernike disc
    beyond_mm: tuple[
        float, ...
    ] = ()  # of `film_law.BEYOND`: a calibration's; a measurement has none

    @classmethod
    def from_parameters(cls, parameters: FloatArray, radius_mm: float) -> "Surface":
        """The surface of parameters [a_2, a_3, ..., excess with unit RMS] in mm; piston makes h(0,
        0) = 0.
        """
        hencky_mm = float(parameters[-1]) / film_law.excess_rms()
        return cls(parameter_to_coeffs() @ parameters, hencky_mm, radius_mm)

    @classmethod
    def hencky_bowl(cls, sag_mm: float, radius_mm: float) -> "Surface":
        """A Hencky bowl of the given sag."""
        return cls(sag_mm * film_law.zernike_projection(), sag_mm, radius_mm)

    @property
    def parameters(self) -> FloatArray:
        """[a_2, a_3, ..., excess with unit RMS] in mm."""
        return np.append(self.coeffs_mm[1:], self.hencky_mm * film_law.excess_rms())

    @cached_property
    def polynomial(self) -> FloatArray:
        """The Zernike part as a polynomial (degree + 1, degree + 1) in x / R, y / R."""
        return zernike.polynomial(self.coeffs_mm)

    @cached_property
    def excess(self) -> FloatArray:
        """The excess as a power series in (r / R)^2, in mm."""
        own = self.hencky_mm * film_law.excess()
        return own + np.array(self.beyond_mm) @ film_law.beyond() if self.beyond_mm else own

    @property
    def sag_mm(self) -> float:
        """Height on the rim of the disc, mean over azimuth."""
        return float(sag_gradient() @ self.parameters)

    def height(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Height in mm at points (...) in mm."""
        x, y = np.asarray(x_mm) / self.radius_mm, np.asarray(y_mm) / self.radius_mm
        bowl = series.polyval2d(x, y, self.polynomial)
        return np.asarray(bowl + series.polyval(x * x + y * y, self.excess))

    def slopes(self, x_mm: FloatArray, y_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """dh/dx and dh/dy."""
        x, y = x_mm / self.radius_mm, y_mm / self.radius_mm
        grows = 2 * series.polyval(x * x + y * y, series.polyder(self.excess))
        of_x, of_y = (
            series.polyval2d(x, y, series.polyder(self.polynomial, axis=axis)) for axis in (0, 1)
        )
        return (of_x + grows * x) / self.radius_mm, (of_y + grows * y) / self.radius_mm

    def curvatures(
        self, x_mm: FloatArray, y_mm: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """h_xx, h_xy and h_yy in 1/mm."""
        x, y = x_mm / self.radius_mm, y_mm / self.radius_mm
        v = x * x + y * y
        first = 2 * series.polyval(v, series.polyder(self.excess))
        second = 4 * series.polyval(v, series.polyder(self.excess, 2))
        by_x, by_y = (series.polyder(self.polynomial, axis=axis) for axis in (0, 1))
        hxx = series.polyval2d(x, y, series.polyder(by_x, axis=0)) + first + second * x * x
        hxy = series.polyval2d(x, y, series.polyder(by_x, axis=1)) + second * x * y
        hyy = series.polyval2d(x, y, series.polyder(by_y, axis=1)) + first + second * y * y
        return hxx / self.radius_mm**2, hxy / self.radius_mm**2, hyy / self.radius_mm**2

    def on_grid(self, axis_mm: FloatArray) -> FloatArray:
        """Height in mm and its slopes along x and y, (3, n, n), on a square grid; rows along y."""
        axis, bowl = axis_mm / self.radius_mm, self.polynomial.T
        v = axis**2 + axis[:, None] ** 2
        steeper = 2 * series.polyval(v, series.polyder(self.excess))
        terms = [bowl, *(series.polyder(bowl, axis=k) for k in (1, 0))]
        out = np.stack([series.polygrid2d(axis, axis, term) for term in terms])
        out += np.stack([series.polyval(v, self.excess), steeper * axis, steeper * axis[:, None]])
        out[1:] /= self.radius_mm
        return np.asarray(out)


@cache
def parameter_to_coeffs() -> FloatArray:
    """Matrix (terms, parameters) from parameters to Noll coefficients.

    Row 1 is the piston that puts the vertex at 0: a_1 = -(sum over j >= 2 of a_j Z_j(0) +
    excess(0)).
    """
    out = np.zeros((ZERNIKE_TERMS, PARAMETERS))
    out[1:, :-1] = np.eye(ZERNIKE_TERMS - 1)
    out[0, :-1] = -zernike.at_vertex()[1:]
    out[0, -1] = -film_law.excess()[0] / film_law.excess_rms()
    return out


@cache
def sag_gradient() -> FloatArray:
    """d sag / d parameters (parameters,): mean over the rim minus the vertex, term by term."""
    excess = film_law.excess()
    rim_minus_vertex = (excess.sum() - excess[0]) / film_law.excess_rms()
    return np.append((zernike.at_rim() - zernike.at_vertex())[1:], rim_minus_vertex)


@cache
def height_probe() -> FloatArray:
    """Matrix from parameters to heights at 512 points spread evenly over the disc (a sunflower),
    vertex at 0.

    Enough to see the largest height of such a surface to a few per cent.
    """
    k = np.arange(512)
    rho, theta = np.sqrt((k + 0.5) / 511.5), k * np.pi * (3 - np.sqrt(5))
    x, y = rho * np.cos(theta), rho * np.sin(theta)
    excess = series.polyval(rho**2, film_law.excess()) / film_law.excess_rms()
    terms = np.vstack([zernike.values(x, y), excess])
    return np.asarray(
        terms[:-1].T @ parameter_to_coeffs() + np.outer(terms[-1], np.eye(PARAMETERS)[-1])
    )


@cache
def _from_heights() -> tuple[FloatArray, FloatArray, FloatArray]:
    """x and y (n,) over the unit disc, and least squares (parameters + 3, n) from heights there to
    the parameters and `BEYOND`."""
    k = np.arange(1024)
    rho, theta = np.sqrt((k + 0.5) / k.size), k * np.pi * (3 - np.sqrt(5))
    x, y = rho * np.cos(theta), rho * np.sin(theta)
    excess = series.polyval(rho**2, film_law.excess()) / film_law.excess_rms()
    own = zernike.values(x, y).T @ parameter_to_coeffs() + np.outer(excess, np.eye(PARAMETERS)[-1])
    beyond = series.polyval(rho**2, film_law.beyond().T).T
    return x, y, np.linalg.pinv(np.hstack([own, beyond]))


@cache
def _family() -> tuple[FloatArray, FloatArray]:
    """`EXCESS_DEGREE` (n,) and `BEYOND` (n, 3), unit RMS, of films of unit sag, from a drum to the
    slackest.
    """
    rows = []
    for slackness in np.linspace(1e-3, film_law.SLACKEST, 240):
        bowl = film_law.Bowl(np.asarray(slackness), np.ones(()), film_law.POISSON_RATIO, 1.0)
        coef = film_law.legendre_series(bowl, 40).coef.astype(np.float64) / bowl.sag_mm
        rows.append(
            [coef[k] / np.sqrt(2 * k + 1) for k in (film_law.EXCESS_DEGREE, *film_law.BEYOND)]
        )
    table = np.array(rows)
    return table[:, 0], table[:, 1:]


def beyond_of(excess_mm: float, sag_mm: float) -> FloatArray:
    """Terms of `BEYOND` (3,) in mm of the film of this law whose excess, of unit RMS, is this at
    this sag.

    At a given sag every film is one number, the slackness, and so is its round figure, whatever
    makes it slack.
    """
    own = (
        film_law.profile_legendre().coef[[film_law.EXCESS_DEGREE, *film_law.BEYOND]]
        / np.sqrt(2 * np.array([film_law.EXCESS_DEGREE, *film_law.BEYOND]) + 1)
        / film_law.excess_rms()
    )
    first, others = _family()
    there = [np.interp(excess_mm * own[0] / sag_mm, first, other) for other in others.T]
    return np.asarray(sag_mm * np.array(there) - excess_mm * own[1:])


@dataclass(frozen=True)
class Artefact:
    """A surface of known form that stands in the mirror's place: a flat, or a concave sphere."""

    curvature_per_mm: float  # 0: flat
    curvature_sigma_per_mm: float
    form_sigma_mm: float  # of each of its terms
    vertex_mm: float  # height of its vertex in world
    vertex_sigma_mm: float
    radius_mm: float  # of its disc

    @property
    def name(self) -> str:
        """For a person."""
        return "sphere" if self.curvature_per_mm else "flat"

    @property
    def doubt(self) -> str:
        """What is wrong if it disagrees with the other sets."""
        return (
            f"it is not the {self.name} that its file states, it stood elsewhere, or it was out "
            "of focus"
        )

    def terms_mm(self, tilt_x: float = 0.0, tilt_y: float = 0.0) -> FloatArray:
        """Parameters (parameters,) of the surface with these slopes at its vertex, and its terms
        `BEYOND`.
        """
        x, y, onto = _from_heights()
        return np.asarray(onto @ self._heights_mm(self.curvature_per_mm, x, y, tilt_x, tilt_y))

    def covariance_mm2(self) -> FloatArray:
        """Covariance of `terms_mm` by curvature and form."""
        x, y, onto = _from_heights()
        step = 1e-9  # per mm: the sag is linear in so little
        change = self._heights_mm(self.curvature_per_mm + step, x, y) - self._heights_mm(
            self.curvature_per_mm, x, y
        )
        by_curvature = onto @ change / step * self.curvature_sigma_per_mm
        return np.asarray(
            np.outer(by_curvature, by_curvature) + self.form_sigma_mm**2 * np.eye(len(onto))
        )

    def _heights_mm(
        self,
        curvature: float,
        x: FloatArray,
        y: FloatArray,
        tilt_x: float = 0.0,
        tilt_y: float = 0.0,
    ) -> FloatArray:
        """The sphere c |P|^2 = 2 n P through the origin with the normal n, at points (n,) of the
        unit disc.
        """
        x, y = x * self.radius_mm, y * self.radius_mm
        across = 1 / math.sqrt(1 + tilt_x**2 + tilt_y**2)
        q = curvature * (x * x + y * y) + 2 * across * (tilt_x * x + tilt_y * y)
        return np.asarray(q / (across + np.sqrt(across**2 - curvature * q)))


@dataclass(frozen=True)
class SeenScreen:
    """The screen itself, seen without the mirror, anywhere: it shows lens and bow."""

    origin_mm: FloatArray  # (3,): O' in the camera's frame, about
    axes: FloatArray  # (3, 3): rows s_x, s_y and normal there
    name = "screen"
    doubt = "it shows another lens, another screen, or it was out of focus"


# The radial profile against Hencky's bowl, and the pressure that belongs to it.


# The paper's mirror film (PET, 50 µm): its sag gives the pressure, p = E t / a (w0 / (0.653 a))^3
_YOUNG_PA = 4.1e9
_THICKNESS_MM = 0.05
_CENTRE = 0.65344  # w0 / (a q^(1/3)) for a Poisson ratio of 0.3
_RINGS = 48


@dataclass(frozen=True)
class RadialProfile:
    """Height over radius."""

    radius_mm: FloatArray  # (n,): middle of the rings
    mean_mm: FloatArray  # (n,): mean over azimuth
    low_mm: FloatArray  # (n,): ends of the band that holds 95 % of the ring
    high_mm: FloatArray  # (n,)
    hencky_mm: FloatArray  # (n,): Hencky's bowl of the sag that fits best
    sag_mm: float  # that sag, at the rim
    pressure_pa: float  # gauge pressure that bends the paper's film to that sag


def radial_profile(axis_mm: FloatArray, height_mm: FloatArray, rim_mm: float) -> RadialProfile:
    """Profile of a height map (n, n) on `axis_mm`, NaN where not measured, of a film with its rim
    at `rim_mm`.
    """
    x, y = np.meshgrid(axis_mm, axis_mm)
    seen = np.isfinite(height_mm)
    r, h = np.hypot(x[seen], y[seen]), height_mm[seen]
    shape = film_law.profile(r / rim_mm)
    shape_mean, h_mean = shape.mean(), h.mean()
    # least squares with a free offset: a dimple at the vertex must not shift the whole comparison
    sag = float(np.sum((shape - shape_mean) * (h - h_mean)) / np.sum((shape - shape_mean) ** 2))
    left = h - (sag * (shape - shape_mean) + h_mean)
    edges = np.linspace(0.0, float(r.max()), _RINGS + 1)
    ring = np.clip(np.digitize(r, edges) - 1, 0, _RINGS - 1)
    rows = []
    for k in range(_RINGS):
        inside = ring == k
        if np.any(inside):
            # of the difference to the bowl: across a ring the bowl itself climbs by millimetres
            rows.append(
                (r[inside].mean(), left[inside].mean(), *np.percentile(left[inside], [2.5, 97.5]))
            )
    radius, mean, low, high = np.array(rows).T
    bowl = sag * film_law.profile(radius / rim_mm) + h_mean - sag * shape_mean
    return RadialProfile(
        radius, bowl + mean, bowl + low, bowl + high, bowl, sag, pressure_pa(sag, rim_mm)
    )


def pressure_pa(sag_mm: float, rim_mm: float) -> float:
    """Gauge pressure under a film of the paper's kind with that sag:
    (w0 / (0.65344 a))^3 E t / a.
    """
    return (sag_mm / (_CENTRE * rim_mm)) ** 3 * _YOUNG_PA * _THICKNESS_MM / rim_mm


# The best sphere. It passes (0, 0, z0) with unit normal n and has the curvature c; with q = P - (0,
# 0, z0) its distance from a point is d = (1 - s) / c = (2 q n - c q^2) / (1 + s), s^2 = 1 - 2 c q n
# + c^2 q^2,
# also for a flat.

_SPHERE_POINTS = 20_000  # enough to come close; the last step takes all


@dataclass(frozen=True)
class Sphere:
    """Sphere through (0, 0, `vertex_mm`)."""

    vertex_mm: float
    tilt_x: float  # its slopes there
    tilt_y: float
    curvature_per_mm: float  # positive: concave, the centre on the side of +z

    @property
    def normal(self) -> FloatArray:
        """Unit normal (3,) at the vertex, towards +z."""
        normal = np.array([-self.tilt_x, -self.tilt_y, 1.0])
        return np.asarray(normal / np.linalg.norm(normal))

    def deviation(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Deviation (n,) in mm of points (3, n), and the unit normals (3,
        n) of the sphere there.
        """
        q = points_mm - np.array([[0.0], [0.0], [self.vertex_mm]])
        c, along, square = self.curvature_per_mm, self.normal @ q, np.einsum("in,in->n", q, q)
        s = np.sqrt(1 - 2 * c * along + c * c * square)
        return (2 * along - c * square) / (1 + s), (self.normal[:, None] - c * q) / s

    def sag_mm(self, radius_mm: float) -> float:
        """Depth over a disc around the vertex; NaN for a disc larger than the sphere."""
        c = self.curvature_per_mm
        left = 1 - (c * radius_mm) ** 2
        return c * radius_mm**2 / (1 + math.sqrt(left)) if left >= 0 else math.nan


def best_sphere(points_mm: FloatArray) -> Sphere:
    """Sphere with the least squares of the deviations along its normal, for points (3, n)."""
    some = points_mm[:, :: max(1, points_mm.shape[1] // _SPHERE_POINTS)]
    scale = float(np.sqrt(np.mean(some[0] ** 2 + some[1] ** 2)))
    x, y, z = some
    bowl = np.stack([np.ones_like(x), x, y, (x * x + y * y) / 2], axis=1)
    columns = np.array([1.0, 1 / scale, 1 / scale, 2 / scale**2])
    found = columns * np.linalg.lstsq(bowl * columns, z, rcond=None)[0]
    for cloud in (some, some, points_mm):
        found = found + _sphere_step(Sphere(*found), cloud, columns)
    return Sphere(*(float(value) for value in found))


def _sphere_step(sphere: Sphere, points_mm: FloatArray, columns: FloatArray) -> FloatArray:
    """Gauss-Newton step (4,); from (1 - c d)^2 = s^2, the derivatives
    of d need no division by c.
    """
    deviation, normals = sphere.deviation(points_mm)
    q = points_mm - np.array([[0.0], [0.0], [sphere.vertex_mm]])
    s, n = 1 - sphere.curvature_per_mm * deviation, sphere.normal
    length = 1 / n[2]
    turn_x = (np.array([-1.0, 0, 0]) + n * n[0]) / length  # d normal / d tilt_x
    turn_y = (np.array([0.0, -1, 0]) + n * n[1]) / length
    square = np.einsum("in,in->n", q, q)
    rows = np.stack(
        [-normals[2], turn_x @ q / s, turn_y @ q / s, (deviation**2 - square) / (2 * s)]
    )
    rows *= columns[:, None]
    return np.asarray(columns * np.linalg.lstsq(rows @ rows.T, -rows @ deviation, rcond=1e-13)[0])
