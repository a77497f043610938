"""The two films: sag and volume under pressure, and their creep.

Under a gauge pressure p a Hencky film's sag and volume both go with (J p)^(1/3), J the compliance of the material
(1/E). So with root = p^(1/3) each is one coefficient times root, and creep is a slow change of that coefficient.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.integrate import solve_ivp

from membrane_ctrl.model.arrays import FloatArray

# Hencky's clamped round membrane under uniform pressure, solved from its differential equation.
#
# The twin's own solution: the reconstruction has another one, so that the two can disagree.


POISSON_PET = 0.3
_START = 1e-4  # the equation is 0/0 at the centre; a series of second order is exact to 1e-16 here


@dataclass(frozen=True, slots=True)
class Hencky:
    """Two numbers that carry everything the gas sees of a film."""

    sag: float  # w0 / (a q^(1/3)) with q = p a / (E t); 0.65344 for nu = 0.3
    volume: float  # volume under the film / (pi a^2 w0); 0.5214 for nu = 0.3


@lru_cache(maxsize=8)
def solve(poisson: float = POISSON_PET) -> Hencky:
    """Solve Hencky's equation for a Poisson ratio in [0, 0.5].

    With N = q^(2/3) n(rho): n'' + 3 n'/rho + 1/(8 n^2) = 0, n'(0) = 0, n'(1) + (1 - nu) n(1) = 0, and the film
    falls by dW/drho = q^(1/3) rho / (2 n).

    The equation keeps its form under n(rho) = lam m(kappa rho) if lam^3 kappa^2 = 1. So one initial value problem
    m(0) = 1 holds the solution for every nu: the rim stands at that r = kappa where r m' + (1 - nu) m = 0. Sag and
    volume are integrated with it; by parts, the volume over pi a^2 is the integral of rho^2 dW. Raises ValueError if
    the Poisson ratio is outside [0, 0.5].
    """
    if not 0 <= poisson <= 0.5:
        raise ValueError(f"poisson = {poisson:g} is outside 0 .. 0.5")

    def slope(r: float, y: FloatArray) -> list[float]:
        m, dm = y[0], y[1]
        return [dm, -3 * dm / r - 1 / (8 * m * m), r / (2 * m), r**3 / (2 * m)]

    def rim(r: float, y: FloatArray) -> float:
        return float(r * y[1] + (1 - poisson) * y[0])

    rim.terminal = True  # type: ignore[attr-defined]  # scipy reads the flag from the function
    start = [1 - _START**2 / 64, -_START / 32, _START**2 / 4, _START**4 / 8]
    solution = solve_ivp(slope, (_START, 8.0), start, method="DOP853", events=rim, rtol=1e-12, atol=1e-14)
    assert solution.t_events is not None  # None only without events
    assert solution.y_events is not None
    kappa = float(solution.t_events[0][0])
    _, _, fall, moment = (float(v) for v in solution.y_events[0][0])
    lam = kappa ** (-2 / 3)
    return Hencky(sag=fall / (kappa**2 * lam), volume=moment / (kappa**2 * fall))


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
    # Young's modulus of the film `SETTLED_S` after loading: tabulated figures hold for the settled film
    modulus_pa: float = MODULUS_PA

    def sag_mm_per_root_pa(self, age_s: float | FloatArray) -> FloatArray:
        """Sag over the cube root of the pressure: w = c a (p a / (E t))^(1/3); age is time under load."""
        settled = solve().sag * RADIUS_MM * (RADIUS_MM / (self.modulus_pa * self.thickness_um * 1e-3)) ** (1 / 3)
        return np.asarray(settled * np.cbrt(self._creep(age_s) / self._creep(SETTLED_S)))

    def volume_m3_per_root_pa(self, age_s: float | FloatArray) -> FloatArray:
        """Volume under the film over the cube root of the pressure: V = 0.5214 pi a^2 w."""
        return solve().volume * math.pi * RADIUS_MM**2 * 1e-9 * self.sag_mm_per_root_pa(age_s)

    def _creep(self, age_s: float | FloatArray) -> FloatArray:
        return np.asarray(1 + self.creep_per_decade * np.log10(1 + np.asarray(age_s) / CREEP_START_S))


MIRROR_FILM = Film(thickness_um=50.0, creep_per_decade=0.005)
BACK_FILM = Film(thickness_um=10.0, creep_per_decade=0.02)
NOMINAL_SAG_MM = float(MIRROR_FILM.sag_mm_per_root_pa(SETTLED_S)) * NOMINAL_PRESSURE_PA ** (1 / 3)


# The nitrogen between the films: how much there is, how warm it is, and the pressure that follows.
#
# Amounts and flows are in mL at reference conditions (nominal absolute pressure, 23 deg C), as a mass-flow meter
# counts them: one mL is always the same number of molecules.

STANDARD_AMBIENT_PA = 101_325.0
REFERENCE_K = 296.15  # 23 deg C, the standard laboratory atmosphere (ISO 291); 123 um/K holds there
JOULE_PER_ML = (STANDARD_AMBIENT_PA + NOMINAL_PRESSURE_PA) * 1e-6  # P V of a reference mL at 23 deg C
GAS_FOLLOWS_AIR_S = 12.0  # through 10 um of PET (PHYSICS: film and gas, estimate)


@dataclass(slots=True)
class Gas:
    """State of the gas."""

    amount_ml: float  # gas between the films; flat films hold none
    temperature_k: float
    root_pa: float  # cube root of the gauge pressure

    @property
    def gauge_pressure_pa(self) -> float:
        """Pressure above ambient."""
        return self.root_pa**3

    def step(self, added_ml: float, follow: float, ambient_pa: float, air_k: float, volume: float) -> None:
        """One time step: gas added (or lost), warmed towards the air, and back in balance with the films.

        Ideal gas in films of volume V = c p^(1/3): with u = p^(1/3), (ambient + u^3) c u = P V of the gas.
        The left side is convex and almost linear in u (u^3 is 0.6 % of ambient), so that one Newton step from
        the last u is exact to 1e-11 in the twin's small steps; what a sudden jump leaves is gone with the next.

        Parameters
        ----------
        added_ml : float
            Reference mL in minus out.
        follow : float
            Share of the difference to the air temperature that is made up in this step.
        ambient_pa, air_k : float
            Surroundings.
        volume : float
            c, both films' m^3 per Pa^(1/3).
        """
        amount_ml = self.amount_ml + added_ml
        self.amount_ml = amount_ml if amount_ml > 0.0 else 0.0  # a third of the time of max(), in every step
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
    """The gas that stands at a gauge pressure between films of `volume` m^3 per Pa^(1/3)."""
    root_pa = gauge_pressure_pa ** (1 / 3)
    pv = (ambient_pa + gauge_pressure_pa) * volume * root_pa
    return Gas(pv / (JOULE_PER_ML * temperature_k / REFERENCE_K), temperature_k, root_pa)
