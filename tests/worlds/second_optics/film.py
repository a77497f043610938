"""A clamped membrane under pressure: least energy with finite strains and an orthotropic law.

The film occupies the unit disc. A material point (X, Y) moves to (X + u, Y + v, w). Its strain is
Green's, E = (S F^T F S - 1) / 2, with the stretch S that the film had before it was clamped; its
energy is that of an orthotropic sheet, E^T C E / 2 per area. The pressure acts normal to the
deformed film: its work is pressure times enclosed volume. The displacements are polynomials of the
disc, (1 - r^2) r^m P_k(r^2) cos(m t) and sin(m t), added to the prescribed height of the ring.
Newton's method finds the least energy at a prescribed depth of the centre; the load is one of the
unknowns.

Lengths are radii of the ring; loads are p R / (E1 t).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray
from scipy.linalg import lu_factor, lu_solve
from scipy.special import eval_jacobi

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

DEGREE = 14  # of the polynomials that multiply (1 - r^2)
RING_ORDERS = 8  # waves of the ring's height and of its radius
CONTINUED_AT = 1.45  # radius beyond which the film is continued with its slope
SETTLED = 1e-11  # last change of a displacement, in radii
MAX_STEPS = 40


@dataclass(frozen=True)
class Material:
    """Elastic constants of the film, and its stretch before it was clamped.

    Attributes
    ----------
    ratio : float
        E2 / E1.
    poisson : float
        nu12: contraction along 2 over extension along 1.
    shear : float or None
        G12 / E1; None: that of an isotropic film with the mean modulus.
    direction_rad : float
        Angle from x to the stiff direction 1.
    prestrain : (float, float, float)
        Strains xx, yy and xy (not doubled) before clamping.
    thickness_slope : (float, float)
        Relative change of the thickness from the centre to the ring, along x and y.
    """

    ratio: float = 1.0
    poisson: float = 0.3
    shear: float | None = None
    direction_rad: float = 0.0
    prestrain: tuple[float, float, float] = (0.0, 0.0, 0.0)
    thickness_slope: tuple[float, float] = (0.0, 0.0)

    def stiffness(self) -> FloatArray:
        """Matrix C (3, 3) over E1: from strains (xx, yy, 2 xy) to stresses (xx, yy, xy)."""
        nu21 = self.poisson * self.ratio
        shear = self.shear
        if shear is None:
            shear = (1 + self.ratio) / 2 / (2 * (1 + self.poisson))
        along = np.array(
            [
                [1.0, nu21, 0.0],
                [nu21, self.ratio, 0.0],
                [0.0, 0.0, shear * (1 - self.poisson * nu21)],
            ]
        ) / (1 - self.poisson * nu21)
        c, s = np.cos(self.direction_rad), np.sin(self.direction_rad)
        # strains in the material's axes from those in x and y, engineering shear
        turn = np.array(
            [[c * c, s * s, c * s], [s * s, c * c, -c * s], [-2 * c * s, 2 * c * s, c * c - s * s]]
        )
        return np.asarray(turn.T @ along @ turn)


@dataclass(frozen=True)
class WarmPatch:
    """A part of the film that has become longer, with a Gaussian profile; lengths in radii."""

    strain: float
    x: float = 0.0
    y: float = 0.0
    sigma: float = 0.18

    def strain_at(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Strain of the relaxed film at its material points."""
        square = (x - self.x) ** 2 + (y - self.y) ** 2
        return np.asarray(self.strain * np.exp(-square / (2 * self.sigma**2)))


@dataclass(frozen=True)
class Ring:
    """Deviation of the ring from a plane circle: Fourier waves over the radius.

    `height` and `wider` map the number of waves to (cosine, sine) amplitudes.
    """

    height: Mapping[int, tuple[float, float]] = field(default_factory=dict)
    wider: Mapping[int, tuple[float, float]] = field(default_factory=dict)


def _powers(base: NDArray[Any], count: int) -> NDArray[Any]:
    """Powers 0 to count - 1 of values (...), (count, ...)."""
    out = np.ones((count, *base.shape), base.dtype)
    for power in range(1, count):
        out[power] = out[power - 1] * base
    return out


@dataclass(frozen=True)
class Field:
    """A displacement of the disc: Re sum over m of (X + iY)^m p_m(r^2)."""

    coefficients: ComplexArray  # (orders, powers of r^2)

    def values(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Value, derivative along X and along Y at points of the disc.

        Beyond `CONTINUED_AT` the field is continued linearly along the radius.
        """
        radius = np.hypot(x, y)
        inward = np.minimum(1.0, CONTINUED_AT / np.maximum(radius, 1e-12))
        inner_x, inner_y = x * inward, y * inward
        value, by_x, by_y = self._polynomial(inner_x, inner_y)
        value = value + by_x * (x - inner_x) + by_y * (y - inner_y)
        return value, by_x, by_y

    def _polynomial(
        self, x: FloatArray, y: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        orders, powers = self.coefficients.shape
        place_powers = _powers(x + 1j * y, orders)
        square_powers = _powers(x * x + y * y, powers)

        # p_m(r^2) and its derivative, (orders, points).
        slope_rows = self.coefficients[:, 1:] * np.arange(1, powers)
        forms = np.tensordot(self.coefficients, square_powers, axes=1)
        slopes = np.tensordot(slope_rows, square_powers[:-1], axes=1)

        value = np.sum(place_powers * forms, axis=0)
        radial = np.sum(place_powers * slopes, axis=0)
        along = np.zeros_like(value)
        for order in range(1, orders):
            along += order * place_powers[order - 1] * forms[order]
        by_x = along.real + 2 * x * radial.real
        by_y = -along.imag + 2 * y * radial.real
        return value.real, by_x, by_y


@dataclass(frozen=True)
class Shape:
    """Displacements of one equilibrium, in radii."""

    u: Field
    v: Field
    w: Field
    load: float


class FilmSolver:
    """Equilibria of one film at prescribed depths of its centre."""

    def __init__(
        self,
        material: Material,
        ring: Ring | None = None,
        degree: int = DEGREE,
        warm: WarmPatch | None = None,
    ) -> None:
        self._ring = ring or Ring()
        self._degree = degree
        self._basis = _basis(degree)
        value, by_x, by_y = self._basis.value, self._basis.by_x, self._basis.by_y
        self._value, self._by_x, self._by_y = value, by_x, by_y
        x, y = self._basis.x, self._basis.y
        slope_x, slope_y = material.thickness_slope
        self._area = self._basis.area
        self._thickness = 1 + slope_x * x + slope_y * y
        self._metric_to_strain, self._unstrained = _strain_of_metric(material.prestrain)
        self._stiffness = self._metric_to_strain.T @ material.stiffness() @ self._metric_to_strain
        self._stress_free = (
            self._metric_to_strain.T @ material.stiffness() @ self._unstrained
        )  # subtracted from stiffness times metric
        # A warm film is relaxed at a longer metric: by 1 + 2 strain, the same along all directions
        warmed = np.zeros_like(x) if warm is None else warm.strain_at(x, y)
        longer = self._metric_to_strain.T @ material.stiffness() @ np.array([1.0, 1.0, 0.0])
        self._relaxed = self._stress_free[:, None] + np.outer(longer, warmed)
        self._root = np.linalg.cholesky(self._stiffness).T
        self._given = [_ring_field(waves, degree) for waves in _ring_waves(self._ring)]
        self._given_at = [given.values(x, y) for given in self._given]

    def solve(self, depth: float, start: FloatArray | None = None) -> tuple[Shape, FloatArray]:
        """Equilibrium with the centre at w = -depth, and the unknowns as a start for the next.

        Raises
        ------
        ArithmeticError
            If Newton's method does not settle.
        """
        unknowns = self._first_guess(depth) if start is None else start.copy()
        size = self._value.shape[1]
        centre = self._basis.centre
        given_centre = self._given[2].coefficients[0, 0].real
        for _ in range(MAX_STEPS):
            gradient, matrix, volume = self._derivatives(unknowns)
            constraint = np.concatenate([np.zeros(2 * size), centre])
            off = constraint @ unknowns[:-1] + given_centre + depth
            bordered = np.zeros((3 * size + 1, 3 * size + 1))
            bordered[:-1, :-1] = matrix
            bordered[:-1, -1] = volume
            bordered[-1, :-1] = constraint
            step = lu_solve(lu_factor(bordered), -np.append(gradient, off))
            unknowns = unknowns + step
            moved = max(np.abs(self._value @ part).max() for part in np.split(step[:-1], 3))
            if moved < SETTLED:
                return self._shape(unknowns), unknowns
        raise ArithmeticError(f"the film does not settle at a depth of {depth:g} radii")

    def _first_guess(self, depth: float) -> FloatArray:
        """A paraboloid and the load of a thin film."""
        size = self._value.shape[1]
        unknowns = np.zeros(3 * size + 1)
        wanted = -depth * (1 - self._basis.x**2 - self._basis.y**2)
        unknowns[2 * size : 3 * size] = np.linalg.lstsq(self._value, wanted, rcond=None)[0]
        unknowns[-1] = (depth / 0.65) ** 3
        return unknowns

    def _derivatives(self, unknowns: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Gradient and Hessian of the energy, and the volume's gradient."""
        value, by_x, by_y = self._value, self._by_x, self._by_y
        size = value.shape[1]
        load = unknowns[-1]
        parts = np.split(unknowns[:-1], 3)
        gradients = []
        for k, part in enumerate(parts):
            along_x = by_x @ part + self._given_at[k][1] + (k == 0)
            along_y = by_y @ part + self._given_at[k][2] + (k == 1)
            gradients.append((along_x, along_y))
        depth = value @ parts[2] + self._given_at[2][0]
        metric = np.stack(
            [
                sum(gx * gx for gx, _ in gradients),
                sum(gy * gy for _, gy in gradients),
                sum(gx * gy for gx, gy in gradients),
            ]
        )
        weight = self._area * self._thickness
        stress = self._stiffness @ metric - self._relaxed

        # change of the metric with each unknown, (3, points, 3 * size)
        change = np.empty((3, value.shape[0], 3 * size))
        for k, (along_x, along_y) in enumerate(gradients):
            columns = slice(k * size, (k + 1) * size)
            change[0][:, columns] = 2 * along_x[:, None] * by_x
            change[1][:, columns] = 2 * along_y[:, None] * by_y
            change[2][:, columns] = along_x[:, None] * by_y + along_y[:, None] * by_x
        gradient = sum(change[k].T @ (weight * stress[k]) for k in range(3))

        change *= np.sqrt(weight)[:, None]
        scaled = (self._root @ change.reshape(3, -1)).reshape(-1, 3 * size)
        matrix = scaled.T @ scaled
        tension = (
            by_x.T @ ((2 * weight * stress[0])[:, None] * by_x)
            + by_y.T @ ((2 * weight * stress[1])[:, None] * by_y)
            + by_x.T @ ((weight * stress[2])[:, None] * by_y)
            + by_y.T @ ((weight * stress[2])[:, None] * by_x)
        )
        for k in range(3):
            columns = slice(k * size, (k + 1) * size)
            matrix[columns, columns] += tension

        # volume under the deformed film: integral of w (x_X y_Y - x_Y y_X)
        (x_x, x_y), (y_x, y_y), _ = gradients
        area = self._area
        shrunk = x_x * y_y - x_y * y_x
        d_x = y_y[:, None] * by_x - y_x[:, None] * by_y
        d_y = x_x[:, None] * by_y - x_y[:, None] * by_x
        volume = np.concatenate(
            [d_x.T @ (area * depth), d_y.T @ (area * depth), value.T @ (area * shrunk)]
        )
        u, v, w = (slice(k * size, (k + 1) * size) for k in range(3))
        weighted = (load * area)[:, None] * value
        matrix[w, u] += weighted.T @ d_x
        matrix[u, w] += d_x.T @ weighted
        matrix[w, v] += weighted.T @ d_y
        matrix[v, w] += d_y.T @ weighted
        twist = by_x.T @ ((load * area * depth)[:, None] * by_y)
        matrix[u, v] += twist - twist.T
        matrix[v, u] += (twist - twist.T).T
        return gradient + load * volume, matrix, volume

    def _shape(self, unknowns: FloatArray) -> Shape:
        fields = []
        for given, part in zip(self._given, np.split(unknowns[:-1], 3), strict=True):
            coefficients = np.tensordot(part, self._basis.polynomials, axes=(0, 0))
            fields.append(Field(coefficients + given.coefficients))
        return Shape(fields[0], fields[1], fields[2], float(unknowns[-1]))


@dataclass(frozen=True)
class _Basis:
    """Functions that vanish at the ring, at the points of a quadrature of the disc."""

    x: FloatArray
    y: FloatArray
    area: FloatArray  # weights of the points
    value: FloatArray  # (points, functions)
    by_x: FloatArray
    by_y: FloatArray
    centre: FloatArray  # (functions,): values at the disc's centre
    polynomials: ComplexArray  # (functions, orders, powers of r^2): as `Field` has them


@lru_cache(maxsize=4)
def _basis(degree: int) -> _Basis:
    orders = max(degree, RING_ORDERS) + 1
    powers = degree // 2 + 2
    rows = []
    for order in range(degree + 1):
        for k in range((degree - order) // 2 + 1):
            # orthogonal over the disc with the weight (1 - r^2)^2
            nodes = np.cos(np.pi * (np.arange(k + 1) + 0.5) / (k + 1))  # of 2 r^2 - 1
            form = polynomial.polyfit((nodes + 1) / 2, eval_jacobi(k, 2, order, nodes), k)
            ascending = polynomial.polymul([1.0, -1.0], form)
            scale = np.sqrt(2 * k + order + 3.0)
            for phase in (1.0, -1j) if order else (1.0,):
                row = np.zeros((orders, powers), complex)
                row[order, : ascending.size] = scale * phase * ascending
                rows.append(row)
    polynomials = np.array(rows)
    abscissas, weights = np.polynomial.legendre.leggauss(degree + 8)
    square, angle = np.meshgrid(
        (abscissas + 1) / 2, 2 * np.pi * np.arange(2 * degree + 16) / (2 * degree + 16)
    )
    area = np.broadcast_to(weights / 4, square.shape) * 2 * np.pi / square.shape[0]
    x = (np.sqrt(square) * np.cos(angle)).ravel()
    y = (np.sqrt(square) * np.sin(angle)).ravel()
    columns = [Field(row).values(x, y) for row in polynomials]
    value, by_x, by_y = (np.stack([column[k] for column in columns], axis=1) for k in range(3))
    return _Basis(x, y, area.ravel(), value, by_x, by_y, polynomials[:, 0, 0].real, polynomials)


def _strain_of_metric(prestrain: tuple[float, float, float]) -> tuple[FloatArray, FloatArray]:
    """Matrix from the metric (xx, yy, xy) of the clamped film to strains, and what to subtract."""
    a, b, c = 1 + prestrain[0], 1 + prestrain[1], prestrain[2]
    rows = [
        [a * a / 2, c * c / 2, a * c],
        [c * c / 2, b * b / 2, b * c],
        [a * c, b * c, a * b + c * c],
    ]
    return np.array(rows), np.array([0.5, 0.5, 0.0])


def _ring_waves(ring: Ring) -> tuple[dict[int, complex], dict[int, complex], dict[int, complex]]:
    """Waves of u, v and w at the ring, as complex amplitudes of (X + iY)^m."""
    height = {order: complex(c, -s) for order, (c, s) in ring.height.items()}
    along_x: dict[int, complex] = {}
    along_y: dict[int, complex] = {}
    for order, (c, s) in ring.wider.items():
        # (c cos mt + s sin mt) times (cos t, sin t), as waves m - 1 and m + 1
        for shifted, sign in ((order + 1, 1.0), (abs(order - 1), -1.0)):
            mirrored = order == 0 and sign < 0
            sine = -s if mirrored else s
            along_x[shifted] = along_x.get(shifted, 0j) + complex(c, -sine) / 2
            quarter = complex(-s * sign, -c * sign) / 2
            if mirrored:
                quarter = complex(quarter.real, -quarter.imag)
            along_y[shifted] = along_y.get(shifted, 0j) + quarter
    return along_x, along_y, height


def _ring_field(waves: Mapping[int, complex], degree: int) -> Field:
    orders = max(degree, RING_ORDERS) + 1
    coefficients = np.zeros((orders, degree // 2 + 2), complex)
    for order, amplitude in waves.items():
        coefficients[order, 0] = amplitude
    return Field(coefficients)
