"""The mirror's bins with the phases that a fitted surface predicts for them."""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray

_ENOUGH_BINS = 6_000  # that stay in a thinned sample: noise is negligible then
# Of the polynomials of `SampledBins.smooth_columns`. Those of the fourth order leave a part of a
# contrast that falls off towards the edge of the mirror, which hides a second image of 0.02 %.
_COLUMNS_ORDER = 6
_TINY_PX = 1e-9  # instead of a division by zero


@dataclass(frozen=True)
class SampledBins:
    """What is known of n sampled bins.

    Attributes
    ----------
    index : (n,) int array
        Numbers of the bins.
    light : (n,) array
        Brightness, as in `bin_view.BinView`.
    phase_rad : (2, n) array
        Predicted absolute phases of x and y, with the film at its mean displacement.
    sensitivity_rad_per_um : (2, n) array
        Change of the phases per µm of displacement.
    places_px : (2, n) array
        Columns and rows of the bins' centres in the picture.
    """

    index: IntArray
    light: FloatArray
    phase_rad: FloatArray
    sensitivity_rad_per_um: FloatArray
    places_px: FloatArray

    def thin_to(self, enough: int = _ENOUGH_BINS) -> "SampledBins":
        """Return every k-th bin, so that at least `enough` of them stay."""
        return self.select_bins(self.thinning(enough))

    def thinning(self, enough: int) -> slice:
        """The bins that `thin_to` takes."""
        return slice(None, None, max(1, self.index.size // enough))

    def select_bins(self, which: slice | BoolArray) -> "SampledBins":
        """Return some of the bins: a range, or those where an array (n,) is True."""
        return SampledBins(
            self.index[which],
            self.light[which],
            self.phase_rad[:, which],
            self.sensitivity_rad_per_um[:, which],
            self.places_px[:, which],
        )

    def smooth_columns(self) -> FloatArray:
        """Polynomials (k, n) in the place in the picture, which is about proportional to that on
        the mirror; the constant first.

        Light and contrast of one frame may differ over the mirror by these. The phases are no
        measure of the place: at the rim of a deep bowl they hardly change with it.
        """
        spread_px = np.maximum(self.places_px.std(axis=1), _TINY_PX)
        centred_px = self.places_px - self.places_px.mean(axis=1)[:, None]
        u, v = centred_px / spread_px[:, None]
        orders = range(_COLUMNS_ORDER + 1)
        powers = [(p, q) for p in orders for q in range(_COLUMNS_ORDER + 1 - p)]
        return np.stack([u**p * v**q for p, q in powers])
