"""Zernike terms in Noll's order as polynomials in x and y, of unit RMS over the unit disc.

The twin's own implementation: it shares nothing with the reconstruction that it checks. Source:
R. J. Noll, "Zernike polynomials and atmospheric turbulence", JOSA 66, 207 (1976).
"""

from functools import cache
from math import comb, factorial, sqrt

import numpy as np

from membrane_ctrl.model.arrays import FloatArray


def noll_orders(j: int) -> tuple[int, int]:
    """Radial order n and azimuthal order m of Noll's index j (from 1); m < 0 stands for the sine
    term.

    Raises ValueError if j < 1.
    """
    if j < 1:
        raise ValueError(f"Noll's index starts at 1, not {j}")
    # The radial order, and the place of the term within it: order n has n + 1 terms.
    n = 0
    place = j - 1
    while place > n:
        n += 1
        place -= n

    # Azimuthal orders have the parity of n and rise in pairs; an odd j is a sine.
    m = n % 2 + 2 * ((place + (n + 1) % 2) // 2)
    if j % 2 == 1:
        m = -m
    return n, m


@cache
def _zernike_monomials(j: int) -> dict[tuple[int, int], float]:
    """Z_j as {(i, k): coefficient of x^i y^k}.

    R_n^m(rho) = sum_s (-1)^s (n-s)! / (s! ((n+m)/2-s)! ((n-m)/2-s)!) rho^(n-2s); with
    rho^m cos(m theta) + i rho^m sin(m theta) = (x + i y)^m and rho^2 = x^2 + y^2 every term is a
    polynomial.
    """
    n, signed_m = noll_orders(j)
    m = abs(signed_m)
    norm = sqrt(n + 1)
    if m != 0:
        norm = sqrt(2 * (n + 1))

    # (x + i y)^m: y^k carries i^k, which is real (cosine) for even k, imaginary (sine) for odd k.
    first = 0
    if signed_m < 0:
        first = 1
    angular = {(m - k, k): comb(m, k) * (-1) ** (k // 2) for k in range(first, m + 1, 2)}

    # Times each radial coefficient and (x^2 + y^2)^power.
    terms: dict[tuple[int, int], float] = {}
    for s in range((n - m) // 2 + 1):
        radial = (-1) ** s * factorial(n - s)
        radial //= factorial(s) * factorial((n + m) // 2 - s) * factorial((n - m) // 2 - s)
        power = (n - m) // 2 - s
        for (i, k), factor in angular.items():
            for p in range(power + 1):
                key = (i + 2 * (power - p), k + 2 * p)
                terms[key] = terms.get(key, 0.0) + norm * radial * factor * comb(power, p)
    return terms


def zernike_polynomial(coeffs: FloatArray) -> FloatArray:
    """Sum of Zernike terms, coefficients (J,) of Noll's j = 1..J, as a polynomial of the unit
    disc's x and y.

    Element (i, k) of the (D + 1, D + 1) array multiplies x^i y^k, in the same unit; D is the
    highest degree used.
    """
    used = [j for j, value in enumerate(coeffs, start=1) if value != 0.0]
    degree = max((noll_orders(j)[0] for j in used), default=0)
    matrix = np.zeros((degree + 1, degree + 1))
    for j in used:
        for (i, k), factor in _zernike_monomials(j).items():
            matrix[i, k] += coeffs[j - 1] * factor
    return matrix
