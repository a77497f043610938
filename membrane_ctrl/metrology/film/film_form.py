"""The film's figure in the frame of the mirror: the terms that turn with the mirror.

Round terms do not show a turn, and tilt belongs to the seat. All other terms of the fit are smooth
functions of the sag: those of a ring that is not flat stay, those of an orthotropic film grow with
the sag, those of an uneven pre-strain fall.
"""

from functools import cache

import numpy as np

from membrane_ctrl.metrology.numerics.zernike import noll_orders
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import NOLL_INDICES

# Places of the turning terms among a surface's parameters, which begin with Noll's 2
_ORDERS = {j - 2: noll_orders(j) for j in NOLL_INDICES if j >= 2}
TURNING = tuple(place for place, (n, m) in _ORDERS.items() if n > 1 and m != 0)
TURNING_ORDERS = tuple(abs(_ORDERS[place][1]) for place in TURNING)
POWERS = 3  # constant, linear and quadratic in the sag
FORM = POWERS * len(TURNING)  # numbers of a form
_DEPTH_MM = 4.0  # unit of the sag's change
# What any film is known to have: nothing is assumed of the constant, 50 and 5 µm by 4 mm of sag
POWER_SIGMAS_MM = (10.0, 0.05, 0.005)


def depth_powers(deeper_mm: float) -> FloatArray:
    """Factors (POWERS,) of a form's coefficients at a change of the sag."""
    return np.asarray((deeper_mm / _DEPTH_MM) ** np.arange(POWERS))


def turn_matrix(angle_rad: float) -> FloatArray:
    """Matrix (terms, terms) from the turning terms to those of the mirror turned by an angle.

    Counter-clockwise as the camera sees the mirror: f(theta) becomes f(theta - angle).
    """
    orders, same, other = _turn_parts()
    cosine, sine = np.cos(orders * angle_rad), np.sin(orders * angle_rad)
    return np.asarray(same * cosine[:, None] + other * sine[:, None])


def turn_derivative(angle_rad: float) -> FloatArray:
    """Derivative of `turn_matrix` by the angle."""
    orders, same, other = _turn_parts()
    cosine, sine = orders * np.cos(orders * angle_rad), orders * np.sin(orders * angle_rad)
    return np.asarray(other * cosine[:, None] - same * sine[:, None])


@cache
def _turn_parts() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Azimuthal orders (terms,), and which terms a turn keeps and exchanges, (terms, terms)."""
    count = len(TURNING)
    same, other = np.eye(count), np.zeros((count, count))
    for row, place in enumerate(TURNING):
        n, m = _ORDERS[place]
        partner = next(k for k, p in enumerate(TURNING) if _ORDERS[p] == (n, -m))
        # cosine: c cos - s sin; sine: s cos + c sin
        other[row, partner] = -1.0 if m > 0 else 1.0
    return np.array(TURNING_ORDERS, float), same, other
