"""The number of Zernike terms that describe the mirror's figure.

`ZERNIKE_TERMS` is the only place that states it: fits, messages, tables, plots and texts follow from it. Files and
messages carry the number with which they were written, and those of another number are refused.
"""

import math

# The published method's number: every term of radial order 7 or less, in Noll's order, orthonormal over the whole
# mirror. They cover what clamping by hand does to a film; shorter errors (ripple, wrinkles) are in the zonal map. The
# time of a fit grows with the square of the number, that of its solution with the cube.
ZERNIKE_TERMS = 36

ZERNIKE_DEGREE = (math.isqrt(8 * ZERNIKE_TERMS + 1) - 3) // 2  # highest radial order
_SUPPORTED_DEGREES = range(5, 11)  # 21 to 66 terms; tests/campaign/price_of_change covers both ends
_SUPPORTED_TERMS = [(degree + 1) * (degree + 2) // 2 for degree in _SUPPORTED_DEGREES]
if ZERNIKE_TERMS not in _SUPPORTED_TERMS:  # fits evaluate complete polynomials of `ZERNIKE_DEGREE`
    raise ValueError(f"ZERNIKE_TERMS is {ZERNIKE_TERMS}, but only complete orders are supported: {_SUPPORTED_TERMS}")

NOLL_INDICES = range(1, ZERNIKE_TERMS + 1)
FIRST_FIGURE_INDEX = 4  # Noll 1 to 3 are piston and tilts
COVARIANCE_UPPER_SIZE = ZERNIKE_TERMS * (ZERNIKE_TERMS + 1) // 2  # numbers in the upper half of a covariance


def zernike_labels(first: int = 1) -> list[str]:
    """Return the labels of the terms from Noll index `first` on: `Z1`, `Z2`, ..."""
    return [f"Z{j}" for j in NOLL_INDICES if j >= first]


def zernike_columns() -> list[str]:
    """Return the names of a table's columns with one term each, in um: `z1_um`, `z2_um`, ..."""
    return [f"z{j}_um" for j in NOLL_INDICES]
