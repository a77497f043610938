"""The number of Zernike terms that describe the mirror's figure.

`ZERNIKE_TERMS` is the only place that states it: fits, messages, tables, plots and texts follow
from it. Files and messages carry the number with which they were written, and those of another
number are refused.
"""

# The published method's number: every term of radial order 7 or less, in Noll's order, orthonormal
# over the whole mirror. They cover what clamping by hand does to a film; shorter errors (ripple,
# wrinkles) are in the zonal map. The time of a fit grows with the square of the number, that of its
# solution with
# the cube.
ZERNIKE_TERMS = 36

_SUPPORTED_DEGREES = range(5, 11)  # 21 to 66 terms; a campaign test sets both ends
NOLL_INDICES = range(1, ZERNIKE_TERMS + 1)
FIRST_FIGURE_INDEX = 4  # Noll 1 to 3 are piston and tilts
# numbers in the upper half of a covariance
COVARIANCE_UPPER_SIZE = ZERNIKE_TERMS * (ZERNIKE_TERMS + 1) // 2


def degree_of(terms: int) -> int:
    """Return the radial order up to which a number of terms is complete.

    The fits evaluate complete polynomials of this degree. Raises ValueError for any other number.
    """
    complete = {(degree + 1) * (degree + 2) // 2: degree for degree in _SUPPORTED_DEGREES}
    if terms not in complete:
        numbers = ", ".join(str(number) for number in complete)
        raise ValueError(
            f"{terms} Zernike terms end within a radial order or are not supported; "
            f"possible: {numbers}"
        )
    return complete[terms]


ZERNIKE_DEGREE = degree_of(ZERNIKE_TERMS)


def zernike_labels(first: int = 1) -> list[str]:
    """Return the labels of the terms from Noll index `first` on: `Z1`, `Z2`, ..."""
    return [f"Z{j}" for j in NOLL_INDICES if j >= first]


def zernike_columns() -> list[str]:
    """Return the names of a table's columns with one term each, in µm: `z1_um`, `z2_um`, ..."""
    return [f"z{j}_um" for j in NOLL_INDICES]
