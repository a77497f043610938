"""A Zernike term beyond those of the fit that is not round."""

import math
from dataclasses import dataclass

from membrane_ctrl.model.zernike_terms import ZERNIKE_DEGREE


@dataclass(frozen=True)
class Wave:
    """A Zernike term beyond the fit's that is not round.

    Attributes
    ----------
    radial_order, azimuthal_order : int
        n and m; m below 0: a sine.
    sigma_mm : float
        Standard deviation of its amplitude over films that were not measured.
    """

    radial_order: int
    azimuthal_order: int
    sigma_mm: float

    @property
    def rms_factor(self) -> float:
        """Height at the rim of the term with unit RMS."""
        return math.sqrt(2 * (self.radial_order + 1))


def first_radial_order(azimuthal_order: int) -> int:
    """Lowest radial order beyond the fit's of terms with this azimuthal order, whose parity it
    has.
    """
    beyond = ZERNIKE_DEGREE + 1
    return max(azimuthal_order, beyond + (beyond - azimuthal_order) % 2)
