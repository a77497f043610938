"""The film as plain numbers, and the compiled functions that give its height and slopes."""

from math import cos, exp, sin
from typing import NamedTuple

import numpy as np

from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.kernel_cache import compile_loop


class FilmTerms(NamedTuple):
    """A film as plain numbers; heights in mm above the vertex, which `offset_mm` puts at 0.

    `bowl[k]` multiplies (r/radius)^(2k) and the sag; `poly_mm[i, k]` multiplies (x/radius)^i
    (y/radius)^k. Rows of `ripples`: amplitude_mm, k_x and k_y in rad/mm, phase_rad; of `wrinkles`:
    amplitude_mm, lobes, phase_rad; of `bumps`: amplitude_mm, x_mm, y_mm, sigma_mm.
    """

    radius_mm: float
    offset_mm: float
    bowl: FloatArray
    poly_mm: FloatArray
    ripples: FloatArray
    wrinkles: FloatArray
    bumps: FloatArray


@compile_loop()
def height_and_slopes(
    terms: FilmTerms, sag_mm: float, x_mm: float, y_mm: float
) -> tuple[float, float, float]:
    """Height of the film at a point and its slopes there.

    Parameters
    ----------
    terms : FilmTerms
        Shape of the film.
    sag_mm : float
        Its sag.
    x_mm, y_mm : float
        The point, from the vertex.

    Returns
    -------
    h, h_x, h_y : float
        Height above the vertex, mm, and its derivatives along x and y.
    """
    X = x_mm / terms.radius_mm
    Y = y_mm / terms.radius_mm

    # The bowl, a polynomial in u: value and derivative by Horner's rule.
    u = X * X + Y * Y
    bowl = 0.0
    bowl_u = 0.0
    for k in range(len(terms.bowl) - 1, -1, -1):
        bowl_u = bowl_u * u + bowl
        bowl = bowl * u + terms.bowl[k]
    h = sag_mm * bowl - terms.offset_mm
    hx = 2.0 * X * sag_mm * bowl_u
    hy = 2.0 * Y * sag_mm * bowl_u

    # The Zernike terms, a polynomial in x and y: each row is one in y, and the rows are the
    # coefficients of one in x. Value and both derivatives in one pass.
    degree = terms.poly_mm.shape[0] - 1
    value = 0.0
    value_x = 0.0
    value_y = 0.0
    for i in range(degree, -1, -1):
        row = 0.0
        row_y = 0.0
        for k in range(degree - i, -1, -1):
            row_y = row_y * Y + row
            row = row * Y + terms.poly_mm[i, k]
        value_x = value_x * X + value
        value_y = value_y * X + row_y
        value = value * X + row
    h = h + value
    hx = hx + value_x
    hy = hy + value_y

    # Wrinkles, amplitude Re((X + iY)^m e^(i phase)): m lobes at the rim.
    for n in range(terms.wrinkles.shape[0]):
        amplitude = terms.wrinkles[n, 0]
        order = int(terms.wrinkles[n, 1])
        phase = terms.wrinkles[n, 2]
        # d/dx of Re(z^m w) is Re(m z^(m-1) w), d/dy is -Im of that: `below` is z^(m-1) w.
        below = complex(cos(phase), sin(phase))
        for _ in range(order - 1):
            below *= complex(X, Y)
        h += amplitude * (below * complex(X, Y)).real
        hx += amplitude * order * below.real
        hy -= amplitude * order * below.imag

    # Slopes per mm; ripples and bumps have their places in mm, too.
    hx = hx / terms.radius_mm
    hy = hy / terms.radius_mm
    for n in range(terms.ripples.shape[0]):
        amplitude, kx, ky, phase = terms.ripples[n]
        angle = kx * x_mm + ky * y_mm + phase
        h += amplitude * cos(angle)
        hx -= amplitude * kx * sin(angle)
        hy -= amplitude * ky * sin(angle)
    for n in range(terms.bumps.shape[0]):
        amplitude, x0, y0, sigma = terms.bumps[n]
        dx = x_mm - x0
        dy = y_mm - y0
        bump = amplitude * exp(-(dx * dx + dy * dy) / (2.0 * sigma * sigma))
        h += bump
        hx -= bump * dx / (sigma * sigma)
        hy -= bump * dy / (sigma * sigma)
    return h, hx, hy


@compile_loop()
def film_heights(terms: FilmTerms, sag_mm: float, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    """Return the heights of the film above its vertex.

    Parameters
    ----------
    terms : FilmTerms
        The film as numbers.
    sag_mm : float
        Depth of its bowl.
    x_mm, y_mm : (n,) array
        Points of the mirror.

    Returns
    -------
    (n,) array
        In mm.
    """
    h_mm = np.empty(x_mm.size)
    for n in range(x_mm.size):
        h_mm[n] = height_and_slopes(terms, sag_mm, x_mm[n], y_mm[n])[0]
    return h_mm
