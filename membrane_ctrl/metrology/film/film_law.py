"""The law of the film: a flat film, stretched by a pre-strain and clamped in a ring, under uniform
pressure.

Foeppl's membrane with N = E t q^(2/3) n, q = p a / (E t), v = (r / a)^2 obeys 4 v n_vv + 8 n_v + 1
/ (8 n^2) = 0, and its height rises by dh/dv = a q^(1/3) / (4 n). The equation scales: n(v) = n(0)
F(s v), s = n(0)^-3, with *one* series F(x) = 1 - x / 64 - ... for all films, pressures and
materials. The ring holds the hoop's strain at the pre-strain e:

    n(0) ((1 - nu) F(s) + 2 s F'(s)) = e / q^(2/3)

so that a film is one number s, the slackness: 0 is a drum (N constant, a paraboloid), 12.5
Hencky's film without pre-strain (nu = 0.3). It follows from the pressure, or, without stiffness
and pressure, from the sag. F's nearest singularity, a film without stress at its ring, is at s =
30.6.

What varies with azimuth (pre-strain, a ring that is not flat or not round, a film that is stiffer
in one direction) is a small disturbance cos(m theta) of that film. Of all displacements that meet
the ring's, the true one has the least energy (Ritz, `Bowl.harmonic`).

An orthotropic film, in polar coordinates about its stiff direction, has the stiffnesses (Tsai and
Pagano) Q_rr = U1 + U2 cos 2t + U3 cos 4t, Q_tt = U1 - U2 cos 2t + U3 cos 4t, Q_rt = U4 - U3 cos 4t,
Q_rs = -U2 / 2 sin 2t - U3 sin 4t and Q_ts = -U2 / 2 sin 2t + U3 sin 4t. U2 pulls with two waves and
U3 with four on the strains of the isotropic film, to first order.

All that is Foeppl's: small slopes, pressure along z. It misses 1 % of the slopes at 37 mm of sag,
which would be taken for a Poisson ratio that is lower by 0.05; `finite_rise_mm` does not.

Sources: H. Hencky, Z. Math. Phys. 63, 311 (1915); J. D. Campbell, Quart. J. Mech. Appl. Math. 9,
84 (1956).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from numpy.polynomial import Legendre, legendre
from numpy.polynomial import polynomial as series

from membrane_ctrl.model.arrays import AnyArray, FloatArray

SLACKEST = 21.0  # the series' last term is then below 1e-12; a slacker film wrinkles at its ring
_USUAL = 3.0  # slackness of a film that is stretched by half a per cent under 600 Pa
_SERIES_TERMS = 80
_WAVE_TERMS = 14  # of a disturbance: it converges tenfold a term
_NODES = 48
COMPLEX_STEP = 1e-30  # small enough that its square is nothing beside 1
HarmonicCause = Literal["prestrain", "flat", "round", "modulus", "shear"]


@cache
def _universal_series() -> tuple[FloatArray, FloatArray, FloatArray]:
    """F, F' and G = integral of dx / F from 0, as power series in x."""
    force, square = (
        np.zeros(_SERIES_TERMS),
        np.zeros(_SERIES_TERMS),
    )  # F and F^-2, by the recurrence for powers
    inverse = np.zeros(_SERIES_TERMS)
    force[0] = square[0] = inverse[0] = 1.0
    for k in range(_SERIES_TERMS - 1):
        force[k + 1] = -square[k] / (32 * (k + 1) * (k + 2))
        m = np.arange(1, k + 2)
        square[k + 1] = np.sum((-m - k - 1) * force[m] * square[k + 1 - m]) / (k + 1)
        inverse[k + 1] = -force[m] @ inverse[k + 1 - m]
    return force, np.asarray(series.polyder(force)), np.asarray(series.polyint(inverse))


def _ring_strain(slackness: AnyArray, poisson: FloatArray | float) -> AnyArray:
    """Strain e / q^(2/3) of the hoop at the ring; falls, ever more slowly, as the film gets
    slacker.
    """
    force, slope, _ = _universal_series()
    at_ring = (1 - poisson) * series.polyval(slackness, force) + 2 * slackness * series.polyval(
        slackness, slope
    )
    return np.asarray(slackness ** (-1 / 3) * at_ring)


def _normalised_sag(slackness: AnyArray) -> AnyArray:
    """Sag / (a q^(1/3))."""
    return np.asarray(slackness ** (-2 / 3) * series.polyval(slackness, _universal_series()[2]) / 4)


def _invert_for_slackness(falls: Callable[[AnyArray], AnyArray], wanted: FloatArray) -> FloatArray:
    """Where a convex falling function has the wanted values: Newton from the left, which never
    overshoots.

    Raises ValueError if a film would be slack at its ring.
    """
    usual = np.all(falls(np.asarray(_USUAL)) > wanted)
    s = np.full(np.shape(wanted), _USUAL if usual else 1e-15)
    for _ in range(80):
        value = falls(s + 1j * COMPLEX_STEP)
        step = (wanted - value.real) / (value.imag / COMPLEX_STEP)
        s = np.minimum(s + step, SLACKEST)
        if np.all(np.abs(step) <= 1e-15 * s):
            break
    if np.any(s >= SLACKEST):
        raise ValueError(
            "the film would be slack at its ring: the pre-strain is too far below 0 for this load"
        )
    return s


@dataclass(frozen=True)
class FilmLaw:
    """A film in its ring; any number may be an array. Raises
    ValueError for one that no film has.
    """

    prestrain: FloatArray | float  # of the flat film, equal in all directions; below 0: slack
    poisson: FloatArray | float
    stiffness_n_per_m: FloatArray | float  # E t
    radius_mm: float  # of the ring

    def __post_init__(self) -> None:
        if not np.all((np.asarray(self.poisson) >= 0) & (np.asarray(self.poisson) <= 0.5)):
            raise ValueError(f"poisson = {self.poisson} is outside 0 .. 0.5")
        if not (np.all(np.asarray(self.stiffness_n_per_m) > 0) and self.radius_mm > 0):
            raise ValueError("stiffness_n_per_m and radius_mm must be above 0")

    def under(self, pressure_pa: FloatArray | float) -> "Bowl":
        """The film under a gauge pressure above 0. Raises ValueError if it would be slack at its
        ring.
        """
        return self.loaded(np.asarray(pressure_pa) * self.radius_mm * 1e-3 / self.stiffness_n_per_m)

    def loaded(self, load: FloatArray) -> "Bowl":
        """The film under a load q. Raises ValueError as `under`."""
        wanted = np.asarray(self.prestrain / load ** (2 / 3))
        return Bowl(
            _invert_for_slackness(lambda s: _ring_strain(s, self.poisson), wanted),
            load,
            self.poisson,
            self.radius_mm,
        )

    def with_sag(self, sag_mm: FloatArray | float) -> "Bowl":
        """The film at a sag above 0; no stiffness is needed. Raises ValueError if it would be slack
        at its ring.
        """
        depth = np.asarray(sag_mm) / self.radius_mm
        s = _invert_for_slackness(
            lambda s: _ring_strain(s, self.poisson) / _normalised_sag(s) ** 2,
            self.prestrain / depth**2,
        )
        return Bowl(s, (depth / _normalised_sag(s)) ** 3, self.poisson, self.radius_mm)

    def pressure_pa(self, bowl: "Bowl") -> FloatArray:
        """The pressure under a bowl of this film."""
        return np.asarray(bowl.load * self.stiffness_n_per_m / (self.radius_mm * 1e-3))


@dataclass(frozen=True)
class Bowl:
    """A film under its load, or several: arrays (n, 1) give results (n, points)."""

    slackness: FloatArray
    load: FloatArray  # q
    poisson: FloatArray | float
    radius_mm: float

    @property
    def sag_mm(self) -> FloatArray:
        """Depth of the vertex below the ring."""
        return np.asarray(self.radius_mm * np.cbrt(self.load) * _normalised_sag(self.slackness))

    def height_mm(self, rho: FloatArray) -> FloatArray:
        """Height above the vertex at rho = r / a."""
        return np.asarray(
            self._scale_mm * series.polyval(self.slackness * rho**2, _universal_series()[2])
        )

    def rise_mm(self, rho: FloatArray) -> FloatArray:
        """dh / drho."""
        force = series.polyval(self.slackness * rho**2, _universal_series()[0])
        return np.asarray(2 * rho * self.slackness * self._scale_mm / force)

    def stresses(self, rho: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Radial and hoop force per length, in E t."""
        force, slope, _ = _universal_series()
        x, scale = self.slackness * rho**2, self.load ** (2 / 3) * np.cbrt(1 / self.slackness)
        radial = scale * series.polyval(x, force)
        return radial, radial + 2 * scale * x * series.polyval(x, slope)

    @property
    def _scale_mm(self) -> FloatArray:
        return np.asarray(self.radius_mm * np.cbrt(self.load) * self.slackness ** (-2 / 3) / 4)

    def harmonic(self, order: int, cause: HarmonicCause) -> Legendre:
        """Response of the height, h cos(m theta), to a disturbance of the ring of the same form.

        Parameters
        ----------
        order : int
            m, from 1.
        cause : "prestrain", "flat", "round", "modulus" or "shear"
            The ring's hoop of film is stretched by 1, raised by 1 mm, or 1 mm wider, each times
            cos(m theta). Or the film's modulus along theta = 0 is larger than across by 1, of
            their mean (m = 2 only), or its shear modulus is larger by 1, of that of an isotropic
            film (m = 4 only).

        Returns
        -------
        Legendre
            f(v) on [0, 1] with h = (r / a)^m f(v), in mm.
        """
        one, a = np.ones(()), self.radius_mm
        rise = float(self.rise_mm(one)) / a
        radial, hoop = (float(force) for force in self.stresses(one))
        nu = float(self.poisson)
        stretch = hoop - nu * radial - (radial - nu * hoop - rise**2 / 2)  # u / a - du/dr
        ring = {"prestrain": (1.0, 0.0), "flat": (0.0, 1 / a), "round": (stretch / a, -rise / a)}
        outward, upward = ring.get(cause, (0.0, 0.0))
        of_film = {
            "modulus": (0.5 / (1 - nu**2), 0.0),
            "shear": (0.0, -0.25 / (1 + nu)),
        }
        return Legendre(
            a * self._ritz(order, outward, upward, *of_film.get(cause, (0.0, 0.0))), domain=[0, 1]
        )

    def _ritz(
        self, order: int, outward: float, upward: float, two_waves: float, four_waves: float
    ) -> FloatArray:
        """Coefficients (_WAVE_TERMS,) of the height / a with the least energy, given the ring's
        displacements / a and the film's stiffnesses U2 and U3 / (E t).
        """
        nodes, weights = legendre.leggauss(_NODES)
        rho = (nodes + 1) / 2
        rise, stresses = self.rise_mm(rho) / self.radius_mm, self.stresses(rho)
        height, climb = _radial_powers(rho, order)
        zero = np.zeros_like(height)
        # in the plane, (u, v) = rho^(m-1) P (1, -1) and rho^(m+1) P (1, 1) are smooth at the vertex
        (less, less_r), (more, more_r) = (
            _radial_powers(rho, order - 1),
            _radial_powers(rho, order + 1),
        )
        u, u_r = np.vstack([zero, less, more]), np.vstack([zero, less_r, more_r])
        v, v_r = np.vstack([zero, -less, more]), np.vstack([zero, -less_r, more_r])
        w, w_r = np.vstack([height, zero, zero]), np.vstack([climb, zero, zero])
        radial = u_r + rise * w_r
        hoop = (u + order * v) / rho
        shear = v_r - (order * u + v) / rho - order * rise * w / rho
        nu, area = float(self.poisson), weights * rho
        energy = (
            (radial * area) @ (radial + nu * hoop).T + (hoop * area) @ (hoop + nu * radial).T
        ) / (1 - nu**2)
        energy += (shear * area) @ shear.T / (2 * (1 + nu))
        energy += (w_r * area * stresses[0]) @ w_r.T + order**2 * (
            w * area * stresses[1] / rho**2
        ) @ w.T
        ones, none = np.ones(_WAVE_TERMS), np.zeros(_WAVE_TERMS)
        ring = np.stack(
            [
                np.concatenate([none, ones, ones]),
                np.concatenate([none, -ones, ones]),
                np.append(ones, [none, none]),
            ]
        )
        system = np.block([[energy, ring.T], [ring, np.zeros((3, 3))]])
        # the forces of the uneven stiffness on the strains of the even film
        along = stresses[0] - nu * stresses[1]
        around = stresses[1] - nu * stresses[0]
        pull = radial @ (two_waves * along * area) - hoop @ (two_waves * around * area)
        pull -= shear @ (two_waves * (along + around) / 2 * area)
        pull += (radial - hoop - shear) @ (four_waves * (along - around) * area)
        right = np.append(-pull, [outward, 0.0, upward])
        return np.asarray(np.linalg.solve(system, right)[:_WAVE_TERMS])


def _radial_powers(rho: FloatArray, power: int) -> tuple[FloatArray, FloatArray]:
    """rho^power P_k(2 rho^2 - 1) and its derivative, (_WAVE_TERMS, n)."""
    x, table = 2 * rho**2 - 1, np.eye(_WAVE_TERMS)
    value, slope = legendre.legval(x, table), legendre.legval(x, legendre.legder(table))
    return value * rho**power, power * rho ** (power - 1) * value + 4 * rho ** (power + 1) * slope
