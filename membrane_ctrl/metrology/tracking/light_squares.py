"""The mirror in squares, for the light of a frame."""

import numpy as np

from membrane_ctrl.metrology.numerics.grouped_sums import sums_by
from membrane_ctrl.metrology.tracking.crossed_scene import CrossedScene
from membrane_ctrl.metrology.tracking.frame_verdict import CONTRAST, COVERED_DEGRADED, Finding
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray, Singles

# Light of a square of the mirror against the median's: less or more is a hand, a lamp, a blind part
# of the screen.
_COVERED = 0.25
# contrast of a square against the median's: less is no fringe but a grey thing before it
_GREY = 0.3
_UNEVEN = 0.1  # of a square's light: as much of a fringe does not average out in it


class Squares:
    """The mirror in squares, for the light of a frame.

    Where the film's slopes spread the fringes, a square shows parts of one, and its light depends
    on the phase: by that much more it may differ.
    """

    def __init__(self, scene: CrossedScene) -> None:
        self._number = _assign_squares(scene.position_mm, scene.surface.radius_mm, 12)
        self._count = np.bincount(self._number)
        self._whole = self._count > 0.5 * np.median(
            self._count
        )  # at the rim a part shows no whole fringe
        self._light_adu = scene.light_adu[0].astype(np.float32)
        waves = (scene.light_adu[1:] * np.exp(1j * scene.phase_rad(scene.surface))).astype(
            np.complex64
        )
        swing: Singles = np.sum(
            (scene.light_adu[1:] / self._light_adu) ** 2, axis=0, dtype=np.float32
        )
        means = self._means(self._light_adu, swing, *waves.real, *waves.imag)
        self._level, self._swing = means[0], np.sqrt(means[1] / 2)
        self._fringe = (
            np.hypot(means[2:4], means[4:]).sum(axis=0) / self._level
        )  # that does not average out
        self._even = self._whole & (
            self._fringe <= max(_UNEVEN, float(np.median(self._fringe[self._whole])))
        )

    def _means(self, *values: Singles) -> FloatArray:
        return np.asarray(sums_by(self._number, np.stack(values), self._count.size) / self._count)

    def look(self, seen: Singles) -> tuple[float, BoolArray]:
        """Light of a frame over the scene's, and the squares whose light is wrong."""
        share, contrast = self._shares(seen)
        light = float(np.median(share[self._even]))
        wrong = np.abs(share - light) > (_COVERED + self._fringe) * max(light, 1e-6)
        grey = self._even & (contrast < _GREY * float(np.median(contrast[self._even])))
        return light, self._whole & (wrong | grey)

    def blinded(self, seen: Singles, covered: float) -> Finding | None:
        """Why a frame has no fit, if it is not that the mirror moved; `covered` is a share of the
        squares.
        """
        contrast = float(np.median(self._shares(seen)[1][self._even]))
        if contrast < CONTRAST:
            return Finding("rejected", f"no fringes: {contrast:.0%} of the reference's contrast")
        if covered > COVERED_DEGRADED:
            left = f"without {covered:.0%} of the mirror there is no fit"
            return Finding("rejected", f"covered or order lost: {left}", lost=True)
        return None

    def _shares(self, seen: Singles) -> FloatArray:
        """Of the scene's light and contrast (2, squares)."""
        share = seen / self._light_adu
        level, mean, square = self._means(seen, share, share**2)
        scatter = np.sqrt(np.maximum(square - mean**2, 0.0))
        return np.stack([level / self._level, scatter / self._swing / np.maximum(mean, 1e-6)])

    def bins(self, chosen: BoolArray) -> BoolArray:
        """The bins (n,) of squares."""
        return np.asarray(chosen[self._number])


def _assign_squares(position_mm: FloatArray, radius_mm: float, across: int) -> IntArray:
    """Number (n,) of the square of the mirror, so many across, that each bin is in; numbers without
    gaps.
    """
    column, row = np.floor((position_mm / radius_mm + 1) / 2 * across).astype(int)
    return np.unique(row * across + column, return_inverse=True)[1]
