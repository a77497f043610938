"""Height and slopes of the film at a point: the compiled kernel that the ray tracer calls."""

from functools import cache
from math import comb, cos, exp, factorial, sin, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.sim import film


class FilmTerms(NamedTuple):
    """A film as plain numbers; heights in mm above the vertex, which `offset_mm` puts at 0.

    `bowl[k]` multiplies (r/radius)^(2k) and the sag; `poly_mm[i, k]` multiplies (x/radius)^i (y/radius)^k.
    Rows of `ripples`: amplitude_mm, k_x and k_y in rad/mm, phase_rad; of `wrinkles`: amplitude_mm, lobes, phase_rad;
    of `bumps`: amplitude_mm, x_mm, y_mm, sigma_mm.
    """

    radius_mm: float
    offset_mm: float
    bowl: FloatArray
    poly_mm: FloatArray
    ripples: FloatArray
    wrinkles: FloatArray
    bumps: FloatArray


@njit(cache=True)
def height_and_slopes(terms: FilmTerms, sag_mm: float, x_mm: float, y_mm: float) -> tuple[float, float, float]:
    """Height above the vertex (mm) and its derivatives along x and y."""
    X, Y = x_mm / terms.radius_mm, y_mm / terms.radius_mm
    u = X * X + Y * Y
    bowl, bowl_u = 0.0, 0.0  # value and derivative to u, Horner
    for k in range(len(terms.bowl) - 1, -1, -1):
        bowl_u = bowl_u * u + bowl
        bowl = bowl * u + terms.bowl[k]
    h = sag_mm * bowl - terms.offset_mm
    hx, hy = 2.0 * X * sag_mm * bowl_u, 2.0 * Y * sag_mm * bowl_u

    degree = terms.poly_mm.shape[0] - 1
    value, value_x, value_y = 0.0, 0.0, 0.0
    for i in range(degree, -1, -1):
        row, row_y = 0.0, 0.0
        for k in range(degree - i, -1, -1):
            row_y = row_y * Y + row
            row = row * Y + terms.poly_mm[i, k]
        value_x = value_x * X + value
        value_y = value_y * X + row_y
        value = value * X + row
    h, hx, hy = h + value, hx + value_x, hy + value_y

    for n in range(terms.wrinkles.shape[0]):
        # amplitude Re((X + iY)^m e^(i phase)): m lobes that live at the rim
        amplitude, phase = terms.wrinkles[n, 0], terms.wrinkles[n, 2]
        below, order = complex(cos(phase), sin(phase)), int(terms.wrinkles[n, 1])
        for _ in range(order - 1):
            below *= complex(X, Y)
        h += amplitude * (below * complex(X, Y)).real
        hx += amplitude * order * below.real
        hy -= amplitude * order * below.imag
    hx, hy = hx / terms.radius_mm, hy / terms.radius_mm

    for n in range(terms.ripples.shape[0]):
        amplitude, kx, ky, phase = terms.ripples[n]
        angle = kx * x_mm + ky * y_mm + phase
        h += amplitude * cos(angle)
        hx -= amplitude * kx * sin(angle)
        hy -= amplitude * ky * sin(angle)
    for n in range(terms.bumps.shape[0]):
        amplitude, x0, y0, sigma = terms.bumps[n]
        dx, dy = x_mm - x0, y_mm - y0
        bump = amplitude * exp(-(dx * dx + dy * dy) / (2.0 * sigma * sigma))
        h += bump
        hx -= bump * dx / (sigma * sigma)
        hy -= bump * dy / (sigma * sigma)
    return h, hx, hy


@njit(cache=True)
def heights(terms: FilmTerms, sag_mm: float, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    """Heights in mm above the vertex at the points (x, y), all (n,)."""
    h_mm = np.empty(x_mm.size)
    for n in range(x_mm.size):
        h_mm[n] = height_and_slopes(terms, sag_mm, x_mm[n], y_mm[n])[0]
    return h_mm


def hencky_series() -> FloatArray:
    """Height of a Hencky bowl of unit sag above its vertex: element k multiplies rho^(2k); nu = 0.3."""
    return film.solve().profile


def paraboloid_series() -> FloatArray:
    """Height of a paraboloid of unit sag: rho^2."""
    return np.array([0.0, 1.0])


# Zernike terms in Noll's order as polynomials in x and y, orthonormal (unit RMS) over the unit disc.
#
# The twin's own implementation: it shares nothing with the reconstruction it is used to check.
# Source: R. J. Noll, "Zernike polynomials and atmospheric turbulence", JOSA 66, 207 (1976).


def noll_orders(j: int) -> tuple[int, int]:
    """Radial order n and azimuthal order m of Noll's index j (from 1); m < 0 stands for the sine term.

    Raises ValueError if j < 1.
    """
    if j < 1:
        raise ValueError(f"Noll's index starts at 1, not {j}")
    n, place = 0, j - 1  # place of the term within its radial order
    while place > n:
        n += 1
        place -= n
    m = n % 2 + 2 * ((place + (n + 1) % 2) // 2)
    return n, m if j % 2 == 0 else -m


@cache
def _monomials(j: int) -> dict[tuple[int, int], float]:
    """Z_j as {(i, k): coefficient of x^i y^k}.

    R_n^m(rho) = sum_s (-1)^s (n-s)! / (s! ((n+m)/2-s)! ((n-m)/2-s)!) rho^(n-2s); with
    rho^m cos(m theta) + i rho^m sin(m theta) = (x + i y)^m and rho^2 = x^2 + y^2 every term is a polynomial.
    """
    n, signed_m = noll_orders(j)
    m = abs(signed_m)
    norm = sqrt(n + 1) if m == 0 else sqrt(2 * (n + 1))
    # (x + i y)^m: y^k carries i^k, real (cosine) for even k, imaginary (sine) for odd k
    first = 1 if signed_m < 0 else 0
    angular = {(m - k, k): comb(m, k) * (-1) ** (k // 2) for k in range(first, m + 1, 2)} if m else {(0, 0): 1}
    terms: dict[tuple[int, int], float] = {}
    for s in range((n - m) // 2 + 1):
        radial = (-1) ** s * factorial(n - s)
        radial //= factorial(s) * factorial((n + m) // 2 - s) * factorial((n - m) // 2 - s)
        power = (n - m) // 2 - s  # of x^2 + y^2
        for (i, k), factor in angular.items():
            for p in range(power + 1):
                key = (i + 2 * (power - p), k + 2 * p)
                terms[key] = terms.get(key, 0.0) + norm * radial * factor * comb(power, p)
    return terms


def polynomial(coeffs: FloatArray) -> FloatArray:
    """Sum of Zernike terms, coefficients (J,) of Noll's j = 1..J, as a polynomial of the unit disc's x and y.

    Element (i, k) of the (D + 1, D + 1) array multiplies x^i y^k, in the same unit; D is the highest degree that is
    used.
    """
    used = [j for j, value in enumerate(coeffs, start=1) if value != 0.0]
    degree = max((noll_orders(j)[0] for j in used), default=0)
    matrix = np.zeros((degree + 1, degree + 1))
    for j in used:
        for (i, k), factor in _monomials(j).items():
            matrix[i, k] += coeffs[j - 1] * factor
    return matrix
