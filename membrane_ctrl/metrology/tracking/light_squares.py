"""The light of a frame, judged in squares of the mirror."""

import numpy as np

from membrane_ctrl.metrology.numerics.grouped_sums import sum_by_group
from membrane_ctrl.metrology.tracking.crossed_scene import CrossedScene
from membrane_ctrl.metrology.tracking.frame_verdict import CONTRAST, COVERED_DEGRADED, Finding
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray, Singles

_SQUARES_ACROSS = 12
# Relative deviation of a square's light from the median: beyond it a hand or a lamp is in the way,
# or a part of the screen is dark.
_COVERED = 0.25
# Contrast of a square over the median's: with less, something grey covers the fringes.
_GREY = 0.3
_WHOLE = 0.5  # share of the usual number of bins; smaller squares, at the rim, show no whole fringe
# Share of a square's light by which fringes that do not average out may change it.
_UNEVEN = 0.1
_LEAST_LIGHT = 1e-6  # instead of a division by zero


class LightSquares:
    """The mirror in squares, which compare the light of a frame with that of the scene.

    Where the film's slopes spread the fringes, a square shows parts of one, and its light depends
    on the phase: by that much more it may differ.

    Parameters
    ----------
    scene : CrossedScene
        The bench as the reference shows it.
    """

    def __init__(self, scene: CrossedScene) -> None:
        # Squares of the mirror; those at the rim that have few bins are not whole.
        self._number = _assign_squares(scene.position_mm, scene.surface.radius_mm, _SQUARES_ACROSS)
        self._count = np.bincount(self._number)
        self._whole = self._count > _WHOLE * np.median(self._count)
        self._light_adu = scene.light_adu[0].astype(np.float32)

        # What the scene shows in each square: level, contrast, and the mean of the fringes.
        phasors = scene.light_adu[1:] * np.exp(1j * scene.phase_rad(scene.surface))
        waves = phasors.astype(np.complex64)
        contrasts = scene.light_adu[1:] / self._light_adu
        contrast_squared: Singles = np.sum(contrasts**2, axis=0, dtype=np.float32)
        means = self._average_bins(self._light_adu, contrast_squared, *waves.real, *waves.imag)
        self._level_adu = means[0]
        self._scatter = np.sqrt(means[1] / 2)
        mean_fringe = np.hypot(means[2:4], means[4:]).sum(axis=0)
        self._fringe_share = mean_fringe / self._level_adu
        # Where fringes do not average out in a square, its level is no measure of the light.
        usual_share = float(np.median(self._fringe_share[self._whole]))
        self._even = self._whole & (self._fringe_share <= max(_UNEVEN, usual_share))

    def _average_bins(self, *values: Singles) -> FloatArray:
        """Means (k, squares) of k values, each (n,), of the bins."""
        return np.asarray(
            sum_by_group(self._number, np.stack(values), self._count.size) / self._count
        )

    def judge_light(self, seen_adu: Singles) -> tuple[float, BoolArray]:
        """Compare a frame with the scene.

        Parameters
        ----------
        seen_adu : (n,) array
            Light of the bins.

        Returns
        -------
        light : float
            Light of the frame over the scene's.
        covered : (squares,) bool array
            Squares whose light or contrast is wrong.
        """
        share, contrast = self._compare_squares(seen_adu)
        light = float(np.median(share[self._even]))
        allowed = (_COVERED + self._fringe_share) * max(light, _LEAST_LIGHT)
        is_wrong = np.abs(share - light) > allowed
        usual_contrast = float(np.median(contrast[self._even]))
        is_grey = self._even & (contrast < _GREY * usual_contrast)
        return light, self._whole & (is_wrong | is_grey)

    def explain_failed_fit(self, seen_adu: Singles, covered: float) -> Finding | None:
        """Why a frame has no fit, other than by a motion of the mirror.

        Parameters
        ----------
        seen_adu : (n,) array
            Light of the bins.
        covered : float
            Share of the squares that are covered.

        Returns
        -------
        Finding or None
            None if nothing is wrong.
        """
        _, contrasts = self._compare_squares(seen_adu)
        contrast = float(np.median(contrasts[self._even]))
        if contrast < CONTRAST:
            return Finding("rejected", f"no fringes: {contrast:.0%} of the reference's contrast")
        if covered > COVERED_DEGRADED:
            left = f"without {covered:.0%} of the mirror there is no fit"
            return Finding("rejected", f"covered or order lost: {left}", lost=True)
        return None

    def _compare_squares(self, seen_adu: Singles) -> FloatArray:
        """Light and contrast (2, squares) of a frame over those of the scene."""
        ratio = seen_adu / self._light_adu
        level, mean, square = self._average_bins(seen_adu, ratio, ratio**2)
        scatter = np.sqrt(np.maximum(square - mean**2, 0.0))
        contrast = scatter / self._scatter / np.maximum(mean, _LEAST_LIGHT)
        return np.stack([level / self._level_adu, contrast])

    def bins(self, chosen: BoolArray) -> BoolArray:
        """Bins (n,) of chosen squares (squares,)."""
        return np.asarray(chosen[self._number])


def _assign_squares(position_mm: FloatArray, radius_mm: float, across: int) -> IntArray:
    """Number (n,) of the square that each bin is in; numbers without gaps.

    `position_mm` (2, n) are the bins on the mirror, `across` the squares along its diameter.
    """
    column, row = np.floor((position_mm / radius_mm + 1) / 2 * across).astype(int)
    return np.unique(row * across + column, return_inverse=True)[1]
