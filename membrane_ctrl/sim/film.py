"""The two films: sag and volume under pressure, and their creep.

Under a gauge pressure p a Hencky film's sag and volume both go with (J p)^(1/3), J the compliance
of the material (1/E). So with root = p^(1/3) each is one coefficient times root, and creep is a
slow change of that coefficient.
"""

import math
import warnings
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial, chebyshev, legendre
from scipy.optimize import brentq, fsolve

from membrane_ctrl.model.arrays import FloatArray

# Hencky's clamped round membrane under uniform pressure, as power series in u = rho^2: quick and
# exact.
#
# The twin's own solution: the reconstruction has another one, so that the two can disagree. In the
# scaled form N = q^(2/3) n(rho) with q = p a / (E t):
#
#     n'' + 3 n'/rho + 1/(8 n^2) = 0,   n'(0) = 0,   n'(1) + (1 - nu) n(1) = 0,   dW/drho = q^(1/3) rho / (2 n).  # noqa: E501
#
# With n = sum_k b_k u^k and g = 1/n the equation becomes 4 k (k + 1) b_k = -(g^2)_(k-1) / 8, so all
# b_k follow from b_0, which the rim's condition fixes. The terms fall by about 0.3 each: 40 of them
# reach the last
# bit.

_TERMS = 40
POISSON_PET = 0.3


@dataclass(frozen=True, slots=True)
class Hencky:
    """A film's solution, as used by gas and optics.

    Everything but the profile is a number: w0 / (a q^(1/3)) and the volume under the film / (pi a^2
    w0), 0.65344 and
    0.5214 for nu = 0.3. `profile[k]` multiplies u^k: height above the vertex for a sag of 1.
    """

    sag: float
    volume: float
    profile: FloatArray


def _reciprocal(series: FloatArray) -> FloatArray:
    """Power series of 1 / series, to the same length."""
    inverse = np.zeros_like(series)
    inverse[0] = 1.0 / series[0]
    for k in range(1, len(series)):
        inverse[k] = -np.dot(series[1 : k + 1], inverse[k - 1 :: -1]) / series[0]
    return inverse


def _force_series(b0: float) -> FloatArray:
    """b_k of the radial force n, given its value at the centre."""
    b = np.zeros(_TERMS)
    b[0] = b0
    for k in range(1, _TERMS):
        g = _reciprocal(b[:k])
        b[k] = -np.dot(g, g[::-1]) / (8.0 * 4.0 * k * (k + 1))
    return b


@cache
def solve(poisson: float = POISSON_PET) -> Hencky:
    """Solve Hencky's equation for a Poisson ratio in [0, 0.5].
    Raises ValueError if it is outside.
    """
    if not 0 <= poisson <= 0.5:
        raise ValueError(f"poisson = {poisson:g} is outside 0 .. 0.5")
    k = np.arange(_TERMS)

    def rim_condition(b0: float) -> float:
        return float(np.dot(2.0 * k + 1.0 - poisson, _force_series(b0)))

    slope = _reciprocal(
        _force_series(brentq(rim_condition, 0.40, 0.60, xtol=1e-15))
    )  # 4 dW/du, without q^(1/3)
    fall = slope / (k + 1)
    profile = np.concatenate(([0.0], fall)) / fall.sum()
    return Hencky(float(fall.sum()) / 4, float(np.dot(k + 1, profile[1:] / (k + 2))), profile)


# A film that was stretched before it was clamped, or is of another material, for pictures: the
# least of its energy.
#
# No slope is called small: Green's strains in Hooke's law, and the work of a pressure that stays
# normal to the film, the load q = p a / (E t) times the volume. With u outward and w down at the
# radius r of the flat film, all in radii:
#
#     e_r = prestrain + u' + (u'^2 + w'^2) / 2,   e_t = prestrain + u / r + (u / r)^2 / 2,
# energy = integral of (e_r^2 + e_t^2 + 2 nu e_r e_t) / (2 (1 - nu^2)) r dr - q integral of w (r +
# u) (1 + u') dr.

_SHAPES = 13  # Legendre terms of u and of w: the slopes are exact to 1e-12
_PROFILE_DEGREE = 18  # exact to the last bit; powers of rho^2 lose digits beyond


@cache
def stretched(depth: float, prestrain: float, poisson: float) -> tuple[float, FloatArray]:
    """Load q and profile of a film: element k of the profile multiplies rho^(2k), height for a
    depth of 1.

    rho is where the film is under its load. Raises ValueError if the film would be slack at its
    ring.
    """
    depth = depth or 1e-9  # a flat film bends as the shallowest does
    x, weight = legendre.leggauss(6 * _SHAPES)
    v = (x + 1) / 2
    r, area = np.sqrt(v), weight / 4
    (wide, wide_r), (deep, deep_r) = _shapes(v)
    vertex = _shapes(np.zeros(1))[1][0][:, 0]

    def forces(u: FloatArray, u_r: FloatArray, w_r: FloatArray) -> tuple[FloatArray, FloatArray]:
        along, around = (
            prestrain + u_r + (u_r**2 + w_r**2) / 2,
            prestrain + u / r + (u / r) ** 2 / 2,
        )
        return (along + poisson * around) / (1 - poisson**2), (around + poisson * along) / (
            1 - poisson**2
        )

    # a film's strain is its pre-strain and the square of its depth: with these units any film is of
    # order 1
    strain = depth**2 + max(prestrain, 0.0)
    units = np.concatenate([np.full(_SHAPES, depth**2), np.full(_SHAPES, depth), [strain * depth]])

    def gradient(scaled: FloatArray) -> FloatArray:
        u, w, push = np.split(scaled * units, [_SHAPES, 2 * _SHAPES])
        push = push * area / r
        out, out_r, down, down_r = u @ wide, u @ wide_r, w @ deep, w @ deep_r
        pull, hoop = (area * force for force in forces(out, out_r, down_r))
        of_u = wide_r @ (pull * (1 + out_r) - push * down * (r + out)) + wide / r @ (
            hoop * (1 + out / r)
        )
        of_u -= wide @ (push * down * (1 + out_r))
        of_w = deep_r @ (pull * down_r) - deep @ (push * (r + out) * (1 + out_r))
        return np.concatenate([of_u / strain, of_w / (strain * depth), [w @ vertex / depth - 1]])

    start = np.zeros(2 * _SHAPES + 1)
    start[_SHAPES], start[-1] = 1.0, 4.0
    with warnings.catch_warnings(
        action="ignore", category=RuntimeWarning
    ):  # of slow progress at the last bits
        found = np.asarray(fsolve(gradient, start, xtol=1e-15, maxfev=20_000))
    u, w, load = np.split(found * units, [_SHAPES, 2 * _SHAPES])
    pull, _ = forces(u @ wide, u @ wide_r, w @ deep_r)
    if np.abs(gradient(found)).max() > 1e-11 or pull.min() < 0.2 * pull[0]:
        raise ValueError(f"prestrain = {prestrain:g}: the film would be slack at its ring")
    at = (chebyshev.chebpts2(8 * _PROFILE_DEGREE) + 1) / 2
    (out, _), (down, _) = (tables for tables in _shapes(at))
    rho2 = (np.sqrt(at) + u @ out) ** 2
    profile = Chebyshev.fit(rho2, 1 - w @ down / depth, _PROFILE_DEGREE, domain=[0, 1])
    powers = profile.convert(domain=[-1, 1], kind=Polynomial, window=[-1, 1]).coef
    return float(load[0]), np.concatenate([[0.0], powers[1:]])


def _shapes(v: FloatArray) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    """Displacements outward, r (1 - v) P(v), and down, (1 - v) P(v), with v = r^2, and their
    derivatives along r.
    """
    r, eye = np.sqrt(v), np.eye(_SHAPES)
    value, slope = (
        legendre.legval(2 * v - 1, eye),
        2 * legendre.legval(2 * v - 1, legendre.legder(eye)),
    )
    down, down_r = (1 - v) * value, 2 * r * ((1 - v) * slope - value)
    return (r * down, down + r * down_r), (down, down_r)


RADIUS_MM = 500.0
NOMINAL_PRESSURE_PA = 600.0
MODULUS_PA = 4.1e9  # PET, one day after loading
SETTLED_S = 86_400.0
CREEP_START_S = 60.0  # t0 of the creep law (assumed): the time a fill takes to become a load


@dataclass(frozen=True, slots=True)
class Film:
    """One round film."""

    thickness_um: float
    creep_per_decade: float  # m of the creep law J = J0 (1 + m log10(1 + t/t0))
    # Young's modulus of the film `SETTLED_S` after loading: tabulated figures hold for the settled
    # film
    modulus_pa: float = MODULUS_PA

    def sag_mm_per_root_pa(self, age_s: float | FloatArray) -> FloatArray:
        """Sag over the cube root of the pressure: w = c a (p a / (E t))^(1/3); age is time under
        load.
        """
        settled = (
            solve().sag
            * RADIUS_MM
            * (RADIUS_MM / (self.modulus_pa * self.thickness_um * 1e-3)) ** (1 / 3)
        )
        return np.asarray(settled * np.cbrt(self._creep(age_s) / self._creep(SETTLED_S)))

    def volume_m3_per_root_pa(self, age_s: float | FloatArray) -> FloatArray:
        """Volume under the film over the cube root of the pressure: V = 0.5214 pi a^2 w."""
        return solve().volume * math.pi * RADIUS_MM**2 * 1e-9 * self.sag_mm_per_root_pa(age_s)

    def _creep(self, age_s: float | FloatArray) -> FloatArray:
        return np.asarray(
            1 + self.creep_per_decade * np.log10(1 + np.asarray(age_s) / CREEP_START_S)
        )


MIRROR_FILM = Film(thickness_um=50.0, creep_per_decade=0.005)
BACK_FILM = Film(thickness_um=10.0, creep_per_decade=0.02)
NOMINAL_SAG_MM = float(MIRROR_FILM.sag_mm_per_root_pa(SETTLED_S)) * NOMINAL_PRESSURE_PA ** (1 / 3)


# The nitrogen between the films: its amount, its temperature, and the resulting pressure.
#
# Amounts and flows are in mL at reference conditions (nominal absolute pressure, 23 deg C), as a
# mass-flow meter counts them: one mL is always the same number of molecules.

STANDARD_AMBIENT_PA = 101_325.0
REFERENCE_K = 296.15  # 23 deg C, the standard laboratory atmosphere (ISO 291); 123 µm/K holds there
JOULE_PER_ML = (
    STANDARD_AMBIENT_PA + NOMINAL_PRESSURE_PA
) * 1e-6  # P V of a reference mL at 23 deg C
GAS_FOLLOWS_AIR_S = 12.0  # through 10 µm of PET (docs/explanation/physics.md, estimate)


@dataclass(slots=True)
class Gas:
    """State of the gas."""

    amount_ml: float  # gas between the films; flat films contain none
    temperature_k: float
    root_pa: float  # cube root of the gauge pressure

    @property
    def gauge_pressure_pa(self) -> float:
        """Pressure above ambient."""
        return self.root_pa**3

    def step(
        self, added_ml: float, follow: float, ambient_pa: float, air_k: float, volume: float
    ) -> None:
        """One time step: gas added (or lost), warmed towards the air, and back in balance with the
        films.

        Ideal gas in films of volume V = c p^(1/3): with u = p^(1/3), (ambient + u^3) c u = P V of
        the gas. The left side is convex and almost linear in u (u^3 is 0.6 % of ambient), so that
        one Newton step from the last u is exact to 1e-11 in the twin's small steps; the next step
        removes the error of a sudden jump.

        `added_ml` is reference mL in minus out, `follow` the share of the difference to the air
        temperature that this step closes, `volume` the c of both films in m^3 per Pa^(1/3).
        """
        amount_ml = self.amount_ml + added_ml
        self.amount_ml = amount_ml if amount_ml > 0.0 else 0.0  # a third of the time of max()
        self.temperature_k += (air_k - self.temperature_k) * follow
        pv = self.amount_ml * JOULE_PER_ML * self.temperature_k / REFERENCE_K
        u = self.root_pa
        u3 = u * u * u
        u -= (u * (ambient_pa + u3) - pv / volume) / (ambient_pa + 4 * u3)
        self.root_pa = u if u > 0.0 else 0.0

    def root_pa_per_ml(self, ambient_pa: float, volume: float) -> float:
        """du/d(amount) at constant temperature and ambient pressure."""
        joule_per_ml = JOULE_PER_ML * self.temperature_k / REFERENCE_K
        return joule_per_ml / (volume * (ambient_pa + 4 * self.gauge_pressure_pa))


def filled(gauge_pressure_pa: float, temperature_k: float, ambient_pa: float, volume: float) -> Gas:
    """Gas at a gauge pressure between films of `volume` m^3 per Pa^(1/3)."""
    root_pa = gauge_pressure_pa ** (1 / 3)
    pv = (ambient_pa + gauge_pressure_pa) * volume * root_pa
    return Gas(pv / (JOULE_PER_ML * temperature_k / REFERENCE_K), temperature_k, root_pa)
