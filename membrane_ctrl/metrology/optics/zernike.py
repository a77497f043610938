"""Zernike terms j = 1..36 in Noll's order, orthonormal over the unit disc, as polynomials in x and y.

The 36 terms are all terms of radial order 7 or less, that is exactly all polynomials of degree 7 in x and y: a sum
of them is evaluated as one such polynomial, which costs 36 multiplications instead of 36 radial functions.

Source: R. J. Noll, J. Opt. Soc. Am. 66, 207 (1976): even j takes the cosine, odd j the sine.
"""

import math
from functools import cache

import numpy as np

from membrane_ctrl.model.arrays import FloatArray

TERMS = 36
DEGREE = 7


def noll(j: int) -> tuple[int, int]:
    """Radial order n and azimuthal order m (negative: sine) of Noll's index j >= 1."""
    if j < 1:
        raise ValueError(f"Noll's index starts at 1, got {j}")
    n = (math.isqrt(8 * j - 7) - 1) // 2
    place = j - n * (n + 1) // 2  # 1 .. n + 1 within the order
    m = 2 * (place // 2) if n % 2 == 0 else 2 * ((place - 1) // 2) + 1
    return n, (m if j % 2 == 0 else -m)


@cache
def monomial_table() -> FloatArray:
    """Coefficients (36, 8, 8): Z_j = sum over p, q of table[j - 1, p, q] x^p y^q, on the unit disc."""
    table = np.stack([_polynomial(j) for j in range(1, TERMS + 1)])
    table.setflags(write=False)
    return table


def _polynomial(j: int) -> FloatArray:
    """One term: N R(rho) / rho^m, a polynomial in u = x^2 + y^2, times Re or Im of (x + iy)^m."""
    n, signed_m = noll(j)
    m = abs(signed_m)
    norm = math.sqrt(n + 1) if m == 0 else math.sqrt(2 * (n + 1))
    out = np.zeros((DEGREE + 1, DEGREE + 1))
    for k in range((n - m) // 2 + 1):
        radial = (-1) ** k * math.comb(n - k, k) * math.comb(n - 2 * k, (n - m) // 2 - k)
        power_u = (n - m) // 2 - k
        for s in range(power_u + 1):  # u^power = sum of binomials x^2s y^2(power - s)
            for t in range(m + 1):  # (x + iy)^m = sum of binomials x^(m-t) (iy)^t
                angular = (1j**t).imag if signed_m < 0 else (1j**t).real
                weight = radial * math.comb(power_u, s) * math.comb(m, t) * angular
                out[2 * s + m - t, 2 * (power_u - s) + t] += norm * weight
    return out


def polynomial(coeffs: FloatArray) -> FloatArray:
    """The sum of the terms as one polynomial (8, 8) in x and y."""
    return np.asarray(np.tensordot(coeffs, monomial_table(), axes=1))


def values(x: FloatArray, y: FloatArray) -> FloatArray:
    """All terms, (36, ...), at points of the unit disc."""
    return _evaluate(monomial_table(), x, y)


def gradients(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """d/dx and d/dy of all terms, each (36, ...), at points of the unit disc."""
    return _evaluate(differentiate(monomial_table(), 1), x, y), _evaluate(differentiate(monomial_table(), 2), x, y)


def differentiate(table: FloatArray, axis: int) -> FloatArray:
    """Derivative of polynomials whose powers run along `axis` (1: x, 2: y), in the same shape."""
    powers = np.arange(DEGREE + 1).reshape([-1 if k == axis else 1 for k in range(3)])
    out = np.roll(table * powers, -1, axis=axis)
    return np.asarray(out)


def _evaluate(table: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    p, q = np.array([(p, q) for p in range(DEGREE + 1) for q in range(DEGREE + 1 - p)]).T
    powers_x = np.stack([x**k for k in range(DEGREE + 1)])
    powers_y = np.stack([y**k for k in range(DEGREE + 1)])
    return np.asarray(np.tensordot(table[:, p, q], powers_x[p] * powers_y[q], axes=1))


def at_vertex() -> FloatArray:
    """All terms (36,) at the centre of the disc."""
    return monomial_table()[:, 0, 0].copy()


def at_rim() -> FloatArray:
    """Mean over azimuth (36,) of all terms on the rim: only m = 0 is left, with R(1) = 1."""
    orders = [noll(j) for j in range(1, TERMS + 1)]
    return np.array([math.sqrt(n + 1) if m == 0 else 0.0 for n, m in orders])
