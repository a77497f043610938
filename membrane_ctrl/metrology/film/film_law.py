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

# Largest slackness: the series' last term is then below 1e-12; a slacker film wrinkles at its ring.
SLACKEST = 21.0
_USUAL = 3.0  # slackness of a film that is stretched by 0.5 % under 600 Pa
_TAUTEST = 1e-15  # slackness at which the search begins for a tauter film
_SERIES_TERMS = 80
_NEWTON_STEPS = 80
_WAVE_TERMS = 14  # of a disturbance: its error falls tenfold a term
_NODES = 48  # of the quadrature of the energy
COMPLEX_STEP = 1e-30  # small enough that its square is nothing beside 1
HarmonicCause = Literal["prestrain", "flat", "round", "modulus", "shear"]


@cache
def _universal_series() -> tuple[FloatArray, FloatArray, FloatArray]:
    """F, F' and G = integral of dx / F from 0, as power series in x.

    The equation of the film gives F_(k+1) from F^-2; the recurrences for powers of a series give
    F^-2 and 1 / F from F.
    """
    force = np.zeros(_SERIES_TERMS)  # F
    square = np.zeros(_SERIES_TERMS)  # F^-2
    inverse = np.zeros(_SERIES_TERMS)  # 1 / F
    force[0] = 1.0
    square[0] = 1.0
    inverse[0] = 1.0
    for k in range(_SERIES_TERMS - 1):
        # 4 x F'' + 8 F' + 1 / (8 F^2) = 0, for the coefficient of x^k.
        force[k + 1] = -square[k] / (32 * (k + 1) * (k + 2))

        # Powers of a series with F_0 = 1: for S = F^p, (k + 1) S_(k+1) is the sum over m of
        # (p m - (k + 1) + m) F_m S_(k+1-m). Here p = -2, and p = -1.
        m = np.arange(1, k + 2)
        terms = (-m - k - 1) * force[m] * square[k + 1 - m]
        square[k + 1] = np.sum(terms) / (k + 1)
        inverse[k + 1] = -force[m] @ inverse[k + 1 - m]
    slope = series.polyder(force)
    integral = series.polyint(inverse)
    return force, np.asarray(slope), np.asarray(integral)


def _ring_strain(slackness: AnyArray, poisson: FloatArray | float) -> AnyArray:
    """Strain e / q^(2/3) of the hoop at the ring; a convex function that falls with slackness."""
    force, slope, _ = _universal_series()
    force_at_ring = series.polyval(slackness, force)
    slope_at_ring = series.polyval(slackness, slope)
    at_ring = (1 - poisson) * force_at_ring + 2 * slackness * slope_at_ring
    return np.asarray(slackness ** (-1 / 3) * at_ring)


def _normalised_sag(slackness: AnyArray) -> AnyArray:
    """Sag / (a q^(1/3)): the integral of dh/dv from the vertex to the ring, v = 1."""
    _, _, integral = _universal_series()
    return np.asarray(slackness ** (-2 / 3) * series.polyval(slackness, integral) / 4)


def _invert_for_slackness(falls: Callable[[AnyArray], AnyArray], wanted: FloatArray) -> FloatArray:
    """Slackness at which a convex falling function has the wanted values.

    Newton's method from the left, which never overshoots; the derivative is that of a complex step.

    Parameters
    ----------
    falls : callable
        The function of the slackness, for complex numbers too.
    wanted : (...) array
        Its values.

    Returns
    -------
    (...) array

    Raises
    ------
    ValueError
        A film would be slack at its ring.
    """
    # From a usual film if all are slacker than that: fewer steps.
    start = _TAUTEST
    if np.all(falls(np.asarray(_USUAL)) > wanted):
        start = _USUAL

    # f(s + i e) = f(s) + i e f'(s): value and derivative in one evaluation, exact to rounding.
    s = np.full(np.shape(wanted), start)
    for _ in range(_NEWTON_STEPS):
        value = falls(s + 1j * COMPLEX_STEP)
        derivative = value.imag / COMPLEX_STEP
        step = (wanted - value.real) / derivative
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
    """A film in its ring; any number may be an array.

    Raises ValueError for a number that no film has.

    Attributes
    ----------
    prestrain : float or array
        Strain of the flat film, equal in all directions; below 0: slack.
    poisson : float or array
        Poisson ratio, 0 to 0.5.
    stiffness_n_per_m : float or array
        E t.
    radius_mm : float
        Radius of the ring.
    """

    prestrain: FloatArray | float
    poisson: FloatArray | float
    stiffness_n_per_m: FloatArray | float
    radius_mm: float

    def __post_init__(self) -> None:
        poisson = np.asarray(self.poisson)
        if not np.all((poisson >= 0) & (poisson <= 0.5)):
            raise ValueError(f"poisson = {self.poisson} is outside 0 .. 0.5")
        if not (np.all(np.asarray(self.stiffness_n_per_m) > 0) and self.radius_mm > 0):
            raise ValueError("stiffness_n_per_m and radius_mm must be above 0")

    def under_pressure(self, pressure_pa: FloatArray | float) -> "Bowl":
        """The film under a gauge pressure.

        Parameters
        ----------
        pressure_pa : float or array
            Above 0.

        Returns
        -------
        Bowl

        Raises
        ------
        ValueError
            The film would be slack at its ring.
        """
        load = np.asarray(pressure_pa) * self.radius_mm * 1e-3 / self.stiffness_n_per_m
        return self.under_load(load)

    def under_load(self, load: FloatArray) -> "Bowl":
        """The film under a load q = p a / (E t). Raises ValueError as `under_pressure`."""
        wanted = np.asarray(self.prestrain / load ** (2 / 3))
        slackness = _invert_for_slackness(lambda s: _ring_strain(s, self.poisson), wanted)
        return Bowl(slackness, load, self.poisson, self.radius_mm)

    def with_sag(self, sag_mm: FloatArray | float) -> "Bowl":
        """The film at a sag; no stiffness is needed.

        Parameters
        ----------
        sag_mm : float or array
            Above 0.

        Returns
        -------
        Bowl

        Raises
        ------
        ValueError
            The film would be slack at its ring.
        """
        # With depth = sag / a, the load q^(1/3) = depth / (normalised sag) is eliminated.
        depth = np.asarray(sag_mm) / self.radius_mm
        slackness = _invert_for_slackness(
            lambda s: _ring_strain(s, self.poisson) / _normalised_sag(s) ** 2,
            self.prestrain / depth**2,
        )
        load = (depth / _normalised_sag(slackness)) ** 3
        return Bowl(slackness, load, self.poisson, self.radius_mm)

    def pressure_pa(self, bowl: "Bowl") -> FloatArray:
        """The pressure under a bowl of this film."""
        return np.asarray(bowl.load * self.stiffness_n_per_m / (self.radius_mm * 1e-3))


@dataclass(frozen=True)
class Bowl:
    """A film under its load, or several: arrays (n, 1) give results (n, points).

    Attributes
    ----------
    slackness : () or (n, 1) array
        s.
    load : () or (n, 1) array
        q.
    poisson : float or array
        Poisson ratio.
    radius_mm : float
        Radius of the ring.
    """

    slackness: FloatArray
    load: FloatArray
    poisson: FloatArray | float
    radius_mm: float

    @property
    def sag_mm(self) -> FloatArray:
        """Depth of the vertex below the ring."""
        return np.asarray(self.radius_mm * np.cbrt(self.load) * _normalised_sag(self.slackness))

    def height_mm(self, rho: FloatArray) -> FloatArray:
        """Height above the vertex at rho = r / a, an array whose shape fits that of the films'."""
        _, _, integral = _universal_series()
        return np.asarray(self._scale_mm * series.polyval(self.slackness * rho**2, integral))

    def rise_mm(self, rho: FloatArray) -> FloatArray:
        """dh / drho, mm, at rho = r / a; shapes as those of `height_mm`."""
        force, _, _ = _universal_series()
        force_there = series.polyval(self.slackness * rho**2, force)
        return np.asarray(2 * rho * self.slackness * self._scale_mm / force_there)

    def stresses(self, rho: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Radial and hoop force per length, in E t, at rho = r / a; shapes as those of
        `height_mm`.
        """
        # N_r = E t q^(2/3) n, and N_theta = d(r N_r) / dr = N_r + 2 v dN_r/dv.
        force, slope, _ = _universal_series()
        x = self.slackness * rho**2
        scale = self.load ** (2 / 3) * np.cbrt(1 / self.slackness)
        radial = scale * series.polyval(x, force)
        hoop = radial + 2 * scale * x * series.polyval(x, slope)
        return radial, hoop

    @property
    def _scale_mm(self) -> FloatArray:
        """Factor of G in the height."""
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
        a = self.radius_mm
        rim = np.ones(())
        rise = float(self.rise_mm(rim)) / a
        radial, hoop = (float(force) for force in self.stresses(rim))
        nu = float(self.poisson)

        # Displacements / a of the film at the ring, outward and upward, by one unit of the cause.
        outward = 0.0
        upward = 0.0
        if cause == "prestrain":
            outward = 1.0
        elif cause == "flat":
            upward = 1 / a
        elif cause == "round":
            # A wider ring takes the film's edge along: u / a - du/dr outward, -dh/dr upward.
            stretch = hoop - nu * radial - (radial - nu * hoop - rise**2 / 2)
            outward = stretch / a
            upward = -rise / a

        # The film's stiffnesses U2 and U3 / (E t) by one unit of the cause.
        two_waves = 0.0
        four_waves = 0.0
        if cause == "modulus":
            two_waves = 0.5 / (1 - nu**2)
        elif cause == "shear":
            four_waves = -0.25 / (1 + nu)
        height = self._minimise_energy(order, outward, upward, two_waves, four_waves)
        return Legendre(a * height, domain=[0, 1])

    def _minimise_energy(
        self, order: int, outward: float, upward: float, two_waves: float, four_waves: float
    ) -> FloatArray:
        """Coefficients (_WAVE_TERMS,) of the height / a with the least energy (Ritz).

        Unknowns are the coefficients of the displacements / a: w upward, and two functions for u
        outward and v around. The constraints are those of the ring.

        Parameters
        ----------
        order : int
            m.
        outward, upward : float
            The ring's displacements / a.
        two_waves, four_waves : float
            The film's stiffnesses U2 and U3 / (E t).
        """
        nodes, weights = legendre.leggauss(_NODES)
        rho = (nodes + 1) / 2
        area = weights * rho
        rise = self.rise_mm(rho) / self.radius_mm
        radial_stress, hoop_stress = self.stresses(rho)
        nu = float(self.poisson)

        # Displacements and their derivatives along the radius, (3 _WAVE_TERMS, nodes): upward, and
        # in the plane (u, v) = rho^(m-1) P (1, -1) and rho^(m+1) P (1, 1), which are smooth at the
        # vertex.
        height, height_r = _radial_powers(rho, order)
        lower, lower_r = _radial_powers(rho, order - 1)
        higher, higher_r = _radial_powers(rho, order + 1)
        zero = np.zeros_like(height)
        u = np.vstack([zero, lower, higher])
        u_r = np.vstack([zero, lower_r, higher_r])
        v = np.vstack([zero, -lower, higher])
        v_r = np.vstack([zero, -lower_r, higher_r])
        w = np.vstack([height, zero, zero])
        w_r = np.vstack([height_r, zero, zero])

        # Their strains.
        radial = u_r + rise * w_r
        hoop = (u + order * v) / rho
        shear = v_r - (order * u + v) / rho - order * rise * w / rho

        # Energy of stretching, of shear, and of the present forces on the slopes.
        stretching = (radial * area) @ (radial + nu * hoop).T
        stretching += (hoop * area) @ (hoop + nu * radial).T
        energy = stretching / (1 - nu**2)
        energy += (shear * area) @ shear.T / (2 * (1 + nu))
        along_radius = (w_r * area * radial_stress) @ w_r.T
        around = order**2 * (w * area * hoop_stress / rho**2) @ w.T
        energy += along_radius + around

        # Displacements at the ring, where all P_k are 1: u, v and w.
        ones = np.ones(_WAVE_TERMS)
        none = np.zeros(_WAVE_TERMS)
        ring = np.stack(
            [
                np.concatenate([none, ones, ones]),
                np.concatenate([none, -ones, ones]),
                np.concatenate([ones, none, none]),
            ]
        )

        # Forces of the uneven stiffness on the strains of the even film.
        radial_strain = radial_stress - nu * hoop_stress
        hoop_strain = hoop_stress - nu * radial_stress
        pull = radial @ (two_waves * radial_strain * area)
        pull -= hoop @ (two_waves * hoop_strain * area)
        pull -= shear @ (two_waves * (radial_strain + hoop_strain) / 2 * area)
        pull += (radial - hoop - shear) @ (four_waves * (radial_strain - hoop_strain) * area)

        # Least energy with Lagrange multipliers for the ring.
        system = np.block([[energy, ring.T], [ring, np.zeros((3, 3))]])
        right = np.append(-pull, [outward, 0.0, upward])
        return np.asarray(np.linalg.solve(system, right)[:_WAVE_TERMS])


def _radial_powers(rho: FloatArray, power: int) -> tuple[FloatArray, FloatArray]:
    """rho^power P_k(2 rho^2 - 1) and its derivative, (_WAVE_TERMS, n)."""
    x = 2 * rho**2 - 1
    table = np.eye(_WAVE_TERMS)
    value = legendre.legval(x, table)
    slope = legendre.legval(x, legendre.legder(table))

    # The product's two derivatives, with dx/drho = 4 rho.
    of_power = power * rho ** (power - 1) * value
    of_polynomial = 4 * rho ** (power + 1) * slope
    return value * rho**power, of_power + of_polynomial
