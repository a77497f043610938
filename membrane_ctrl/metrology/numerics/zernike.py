"""The first `ZERNIKE_TERMS` Zernike terms in Noll's order, orthonormal over the unit disc, as
polynomials in x and y.

They are all terms up to radial order `ZERNIKE_DEGREE`, that is exactly all polynomials of this
degree in x and y: a sum of them is evaluated as one such polynomial, which costs a multiplication
a term instead of a radial function.

Source: R. J. Noll, J. Opt. Soc. Am. 66, 207 (1976): even j takes the cosine, odd j the sine.
"""

import math
from functools import cache

import numpy as np

from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import NOLL_INDICES, ZERNIKE_DEGREE, ZERNIKE_TERMS

FRINGE_TERMS = 37  # by definition of the set, whatever the fit's own number


def noll_orders(j: int) -> tuple[int, int]:
    """Radial order n and azimuthal order m (negative: sine) of Noll's index j >= 1."""
    if j < 1:
        raise ValueError(f"Noll's index starts at 1, got {j}")
    # Order n has n + 1 terms, places 1 .. n + 1; azimuthal orders have the parity of n.
    n = (math.isqrt(8 * j - 7) - 1) // 2
    place = j - n * (n + 1) // 2
    if n % 2 == 0:
        m = 2 * (place // 2)
    else:
        m = 2 * ((place - 1) // 2) + 1

    # Odd j are sines.
    if j % 2 == 1:
        m = -m
    return n, m


def osa_from_noll(per_term: FloatArray) -> FloatArray:
    """Values (terms, ...) in the order of OSA/ANSI's index from 0, of the same terms in Noll's
    order.
    """
    # OSA's index grows with the radial order, then with the azimuthal one (sines before cosines).
    orders = [noll_orders(j) for j in NOLL_INDICES]
    noll_places = sorted(range(ZERNIKE_TERMS), key=orders.__getitem__)
    return np.asarray(per_term)[noll_places]


def fringe_set_orders(j: int) -> tuple[int, int]:
    """Radial and azimuthal order (negative: sine) of the Fringe set's index 1..37; the last is n =
    12, m = 0.
    """
    if not 1 <= j <= FRINGE_TERMS:
        raise ValueError(f"the Fringe set has the terms 1 to {FRINGE_TERMS}, got {j}")
    if j == FRINGE_TERMS:
        return 12, 0

    # Shells of one half = (n + |m|) / 2, places 0 .. 2 half: m falls, cosine before sine.
    half = math.isqrt(j - 1)
    place = j - half**2 - 1
    m = half - place // 2
    n = 2 * half - m
    if place % 2 == 1:
        m = -m
    return n, m


@cache
def monomial_table() -> FloatArray:
    """Coefficients (terms, degree + 1, degree + 1): Z_j = sum over p, q of table[j - 1, p, q] x^p
    y^q.
    """
    table = np.stack([_term_polynomial(j) for j in NOLL_INDICES])
    table.setflags(write=False)
    return table


def _term_polynomial(j: int) -> FloatArray:
    """One of the terms, with unit RMS over the disc."""
    n, m = noll_orders(j)
    square = n + 1
    if m != 0:
        square = 2 * (n + 1)
    return math.sqrt(square) * radial_polynomial(n, m, ZERNIKE_DEGREE)


def radial_polynomial(n: int, m: int, degree: int) -> FloatArray:
    """Polynomial in x and y of a term without normalisation, with R(1) = 1.

    R_n^m(r) is a sum over k of radial coefficients times r^(n - 2k) = r^|m| u^p, with u = x^2 +
    y^2 and p = (n - |m|) / 2 - k. Both factors are expanded by the binomial theorem: u^p, and
    (x + iy)^|m| = r^|m| (cos + i sin)(|m| theta).

    Parameters
    ----------
    n, m : int
        Radial and azimuthal order; sine for m < 0.
    degree : int
        Of the polynomial, at least n.

    Returns
    -------
    (degree + 1, degree + 1) array
        Coefficient of x^p y^q at [p, q].
    """
    order = abs(m)
    half = (n - order) // 2
    out = np.zeros((degree + 1, degree + 1))
    for k in range(half + 1):
        # (n - k)! / (k! ((n + m) / 2 - k)! ((n - m) / 2 - k)!), as two binomials.
        radial = (-1) ** k * math.comb(n - k, k) * math.comb(n - 2 * k, half - k)
        p = half - k
        for s in range(p + 1):  # u^p: binomial times x^2s y^2(p - s)
            for t in range(order + 1):  # (x + iy)^|m|: binomial times x^(|m| - t) (iy)^t
                angular = (1j**t).real
                if m < 0:
                    angular = (1j**t).imag
                weight = radial * math.comb(p, s) * math.comb(order, t) * angular
                power_x = 2 * s + order - t
                power_y = 2 * (p - s) + t
                out[power_x, power_y] += weight
    return out


def sum_polynomial(coeffs: FloatArray) -> FloatArray:
    """The sum of the terms as one polynomial (degree + 1, degree + 1) in x and y."""
    return np.asarray(np.tensordot(coeffs, monomial_table(), axes=1))


def evaluate_terms(x: FloatArray, y: FloatArray, table: FloatArray | None = None) -> FloatArray:
    """Values of all terms at points of the unit disc.

    Parameters
    ----------
    x, y : (...) arrays
        Places, over the radius.
    table : (k, degree + 1, degree + 1) array, optional
        Other polynomials than the terms, as `monomial_table`.

    Returns
    -------
    (k, ...) array
    """
    if table is None:
        table = monomial_table()

    # The monomials x^p y^q with p + q <= degree; the others' coefficients are 0.
    orders = range(ZERNIKE_DEGREE + 1)
    exponents = [(p, q) for p in orders for q in range(ZERNIKE_DEGREE + 1 - p)]
    p, q = np.array(exponents).T
    powers_x = np.stack([x**k for k in orders])
    powers_y = np.stack([y**k for k in orders])
    monomials = powers_x[p] * powers_y[q]
    return np.asarray(np.tensordot(table[:, p, q], monomials, axes=1))


def evaluate_gradients(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Slopes of all terms at points of the unit disc.

    Parameters
    ----------
    x, y : (...) arrays
        Places, over the radius.

    Returns
    -------
    by_x, by_y : (terms, ...) arrays
        d/dx and d/dy, per radius.
    """
    by_x = evaluate_terms(x, y, differentiate_table(monomial_table(), 1))
    by_y = evaluate_terms(x, y, differentiate_table(monomial_table(), 2))
    return by_x, by_y


def differentiate_table(table: FloatArray, axis: int) -> FloatArray:
    """Derivatives of polynomials.

    Parameters
    ----------
    table : (k, degree + 1, degree + 1) array
        As `monomial_table`.
    axis : int
        1: by x, 2: by y.

    Returns
    -------
    array
        In the same shape.
    """
    # Each coefficient times its power, one place lower; the constant, times 0, comes last.
    along_axis = [1, 1, 1]
    along_axis[axis] = -1
    powers = np.arange(table.shape[axis]).reshape(along_axis)
    return np.asarray(np.roll(table * powers, -1, axis=axis))


def at_vertex() -> FloatArray:
    """All terms (terms,) at the centre of the disc."""
    return monomial_table()[:, 0, 0].copy()


def at_rim() -> FloatArray:
    """Mean over azimuth (terms,) of all terms on the rim: only m = 0 is left, with R(1) = 1."""
    orders = [noll_orders(j) for j in NOLL_INDICES]
    return np.array([math.sqrt(n + 1) if m == 0 else 0.0 for n, m in orders])
