"""One capture set for the calibration: screen points of its bins, and what is known besides."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from membrane_ctrl.metrology.rays.artefacts import Artefact, SeenScreen
from membrane_ctrl.metrology.rays.bench_poses import (
    SCREEN_MOVE,
)
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray

MOVED = (
    SCREEN_MOVE + 2
)  # of a screen elsewhere: its move, by how much the film was deeper, and in x than in y
STILL_UM = 1e-3  # of a film that does not move
_PER_POINT = ("column_px", "row_px", "screen_mm", "sigma_mm")  # the last axis: points


@dataclass(frozen=True)
class Elsewhere:
    """What is known, besides the fringes, of the same film seen with the screen put elsewhere."""

    shift_mm: tuple[float, float, float]  # of the screen along s_x, s_y and towards the mirror
    shift_sigma_mm: float  # of its length
    turn_sigma_deg: float  # of its direction, and of the screen's turns
    deeper_um: float  # by how much the film was deeper then, by the laser
    motion_um: float  # in the x frames than in the y frames
    motion_sigma_um: float
    glass_sigma_mm: float = 0.0  # of a screen seen directly, in place of a film that is deeper

    def known(self, laser_sigma_um: float) -> FloatArray:
        """Values and sigmas (2, MOVED), in mm and degrees: the move, the film deeper, deeper in x
        than in y.
        """
        deeper_mm = 1e-3 * np.array([self.deeper_um, self.motion_um])
        told = np.concatenate([self.shift_mm, np.zeros(3), deeper_mm])
        deeper_sigma_mm = self.glass_sigma_mm or 1e-3 * np.sqrt(2) * laser_sigma_um
        film_mm = np.array([deeper_sigma_mm, 1e-3 * max(self.motion_sigma_um, STILL_UM)])
        # a rail is as parallel to the screen's normal as the screen is to itself after the move
        across_mm = np.sqrt(
            np.sum(np.square(self.shift_mm)) - np.square(self.shift_mm)
        ) * np.radians(self.turn_sigma_deg)
        shift_mm = np.hypot(self.shift_sigma_mm, across_mm)
        return np.stack(
            [told, np.concatenate([shift_mm, np.full(3, self.turn_sigma_deg), film_mm])]
        )


# of the screen seen directly: nothing is known of its place, and its pixels may lie behind some mm
# of glass
ANYWHERE = Elsewhere((0.0, 0.0, 0.0), 1e3, 1e2, 0.0, 0.0, 0.0, glass_sigma_mm=3.0)


@dataclass(frozen=True)
class SetPhases:
    """One capture set as screen points of bins, and those of the same film with the screen put
    elsewhere.
    """

    name: str
    column_px: FloatArray  # (n,): centres of the bins
    row_px: FloatArray  # (n,)
    screen_mm: FloatArray  # (2, n): s_x, s_y seen there
    sigma_mm: FloatArray  # (n,): expected noise of each of the two
    displacement_um: float  # mean laser reading of the set; NaN without
    # by how much deeper the film was in the x frames than in the y frames, as told; a sigma of 0:
    # not at all
    motion_um: float = 0.0
    motion_sigma_um: float = 0.0
    # RMS motion of the film during the set; that from frame to frame of an axis is corrected
    moved_um: float = 0.0
    artefact: Artefact | SeenScreen | None = None  # what is seen instead of the film
    elsewhere: tuple[Elsewhere, ...] = ()
    # (n,): with which of them a point was seen, from 1; 0, or None, in its place
    screen: IntArray | None = None
    # of the fringes; 0: unknown, and nothing that repeats with them is taken out
    period_mm: float = 0.0

    def seen_with(self, screen: int) -> BoolArray:
        """Which points (n,) were seen with the screen in that place."""
        return np.full(self.sigma_mm.size, True) if self.screen is None else self.screen == screen

    def thinned(self, most: int) -> "SetPhases":
        """Every k-th bin, so that at most `most` are left."""
        return self.subset(slice(None, None, -(-self.column_px.size // most)))

    def subset(self, keep: slice | BoolArray) -> "SetPhases":
        """Some of the bins."""
        parts = {name: getattr(self, name)[..., keep] for name in _PER_POINT}
        return replace(self, **parts, screen=None if self.screen is None else self.screen[keep])

    def beside(self, again: "SetPhases", known: Elsewhere) -> "SetPhases":
        """The set with the points of the same film, seen again with the screen elsewhere."""
        before = np.zeros(self.sigma_mm.size, int) if self.screen is None else self.screen
        screen = np.append(before, np.full(again.sigma_mm.size, len(self.elsewhere) + 1))
        parts: Any = {
            name: np.concatenate([getattr(k, name) for k in (self, again)], -1)
            for name in _PER_POINT
        }
        return replace(self, **parts, elsewhere=(*self.elsewhere, known), screen=screen)
