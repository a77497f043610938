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
# 1 sigma of what any film has: nothing is assumed of the constant; 50 and 5 µm by 4 mm of sag.
POWER_SIGMAS_MM = (10.0, 0.05, 0.005)


def depth_powers(deeper_mm: float) -> FloatArray:
    """Factors of a form's coefficients.

    Parameters
    ----------
    deeper_mm : float
        Sag, less that at which the form is stated.

    Returns
    -------
    (POWERS,) array
        Powers 0, 1, 2 of the change, in units of 4 mm.
    """
    return np.asarray((deeper_mm / _DEPTH_MM) ** np.arange(POWERS))


def turn_matrix(angle_rad: float) -> FloatArray:
    """Matrix from the turning terms to those of the mirror turned by an angle.

    Parameters
    ----------
    angle_rad : float
        Counter-clockwise as the camera sees the mirror: f(theta) becomes f(theta - angle).

    Returns
    -------
    (terms, terms) array
        In the order of `TURNING`.
    """
    orders, same, other = _turn_parts()
    cosine = np.cos(orders * angle_rad)
    sine = np.sin(orders * angle_rad)
    return np.asarray(same * cosine[:, None] + other * sine[:, None])


def turn_derivative(angle_rad: float) -> FloatArray:
    """Derivative (terms, terms) of `turn_matrix` by the angle, per rad."""
    orders, same, other = _turn_parts()
    cosine = orders * np.cos(orders * angle_rad)
    sine = orders * np.sin(orders * angle_rad)
    return np.asarray(other * cosine[:, None] - same * sine[:, None])


@cache
def _turn_parts() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Azimuthal orders (terms,), and which terms a turn keeps and exchanges, (terms, terms)."""
    count = len(TURNING)
    same = np.eye(count)
    other = np.zeros((count, count))
    places = {_ORDERS[place]: number for number, place in enumerate(TURNING)}
    for row, place in enumerate(TURNING):
        # A cosine becomes c cos - s sin of its pair, a sine s cos + c sin.
        n, m = _ORDERS[place]
        sign = 1.0
        if m > 0:
            sign = -1.0
        other[row, places[n, -m]] = sign
    return np.array(TURNING_ORDERS, float), same, other
