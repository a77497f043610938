"""Hencky's clamped round membrane under uniform pressure, solved from its differential equation.

The twin's own solution: the reconstruction has another one, so that the two can disagree.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

POISSON_PET = 0.3
_START = 1e-4  # the equation is 0/0 at the centre; a series of second order is exact to 1e-16 here


@dataclass(frozen=True, slots=True)
class Hencky:
    """Two numbers that carry everything the gas sees of a film.

    Attributes
    ----------
    sag : float
        w0 / (a q^(1/3)) with q = p a / (E t); 0.65344 for nu = 0.3.
    volume : float
        Volume under the film / (pi a^2 w0); 0.5214 for nu = 0.3.
    """

    sag: float
    volume: float


@lru_cache(maxsize=8)
def solve(poisson: float = POISSON_PET) -> Hencky:
    """Solve Hencky's equation for a Poisson ratio in [0, 0.5].

    With N = q^(2/3) n(rho): n'' + 3 n'/rho + 1/(8 n^2) = 0, n'(0) = 0, n'(1) + (1 - nu) n(1) = 0, and the film
    falls by dW/drho = q^(1/3) rho / (2 n).

    The equation keeps its form under n(rho) = lam m(kappa rho) if lam^3 kappa^2 = 1. So one initial value problem
    m(0) = 1 holds the solution for every nu: the rim stands at that r = kappa where r m' + (1 - nu) m = 0.
    Sag and volume are integrated with it; by parts, the volume over pi a^2 is the integral of rho^2 dW.

    Raises
    ------
    ValueError
        If the Poisson ratio is outside [0, 0.5].
    """
    if not 0 <= poisson <= 0.5:
        raise ValueError(f"poisson = {poisson:g} is outside 0 .. 0.5")

    def slope(r: float, y: NDArray[np.float64]) -> list[float]:
        m, dm = y[0], y[1]
        return [dm, -3 * dm / r - 1 / (8 * m * m), r / (2 * m), r**3 / (2 * m)]

    def rim(r: float, y: NDArray[np.float64]) -> float:
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
