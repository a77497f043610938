"""One capture set for the calibration: screen points of its bins, and what is known besides."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from membrane_ctrl.metrology.rays.artefacts import Artefact, SeenScreen
from membrane_ctrl.metrology.rays.moved_screen import MovedScreen
from membrane_ctrl.metrology.rays.turned_mirror import TurnedMirror
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray

_PER_POINT = ("column_px", "row_px", "screen_mm", "sigma_mm")  # arrays whose last axis is points


@dataclass(frozen=True)
class SetPhases:
    """One capture set as screen points of bins, and those of the same film with the screen put
    elsewhere.

    Attributes
    ----------
    name : str
    column_px : (n,) array
        Centres of the bins.
    row_px : (n,) array
    screen_mm : (2, n) array
        s_x and s_y seen there.
    sigma_mm : (n,) array
        Expected noise of each of the two coordinates.
    displacement_um : float
        Mean laser reading of the set; NaN without.
    motion_um : float
        Additional depth of the film in the x frames over the y frames; with a sigma of 0 it is 0.
    motion_sigma_um : float
    moved_um : float
        RMS motion of the film during the set; that from frame to frame of an axis is corrected.
    artefact : Artefact | SeenScreen, optional
        What is seen instead of the film.
    moved_screens : tuple of MovedScreen
    turned : TurnedMirror, optional
        How the mirror stood, if it was turned about its axis.
    screen : (n,) int array, optional
        Place of the screen (from 1, in `moved_screens`) with which a point was seen; 0 or None: its
        own place.
    period_mm : float
        Period of the fringes; 0: unknown, and no waves that repeat with them are removed.
    """

    name: str
    column_px: FloatArray
    row_px: FloatArray
    screen_mm: FloatArray
    sigma_mm: FloatArray
    displacement_um: float
    motion_um: float = 0.0
    motion_sigma_um: float = 0.0
    moved_um: float = 0.0
    artefact: Artefact | SeenScreen | None = None
    moved_screens: tuple[MovedScreen, ...] = ()
    turned: TurnedMirror | None = None
    screen: IntArray | None = None
    period_mm: float = 0.0

    def select_screen(self, screen: int) -> BoolArray:
        """Which points (n,) were seen with the screen in that place."""
        if self.screen is None:
            return np.full(self.sigma_mm.size, True)
        return np.asarray(self.screen == screen)

    def thin_to(self, most: int) -> "SetPhases":
        """Every k-th bin, so that at most `most` are left."""
        stride = math.ceil(self.column_px.size / most)
        return self.subset(slice(None, None, stride))

    def subset(self, keep: slice | BoolArray) -> "SetPhases":
        """Some of the bins: a range, or those where an array (n,) is True."""
        parts = {name: getattr(self, name)[..., keep] for name in _PER_POINT}
        screen = self.screen
        if screen is not None:
            screen = screen[keep]
        return replace(self, **parts, screen=screen)

    def add_screen_place(self, again: "SetPhases", known: MovedScreen) -> "SetPhases":
        """Add the points of the same film, seen again with the screen elsewhere.

        Parameters
        ----------
        again : SetPhases
            The set with the screen elsewhere.
        known : MovedScreen
            What is known of the move.

        Returns
        -------
        SetPhases
            With the points of both, and one more place of the screen.
        """
        before = self.screen
        if before is None:
            before = np.zeros(self.sigma_mm.size, int)
        place = len(self.moved_screens) + 1
        screen = np.append(before, np.full(again.sigma_mm.size, place))
        parts: Any = {}
        for name in _PER_POINT:
            parts[name] = np.concatenate([getattr(self, name), getattr(again, name)], -1)
        return replace(self, **parts, moved_screens=(*self.moved_screens, known), screen=screen)
