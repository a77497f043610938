"""One capture set for the calibration: screen points of its bins, and what is known besides."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from membrane_ctrl.metrology.rays.artefacts import Artefact, SeenScreen
from membrane_ctrl.metrology.rays.bench_poses import SCREEN_MOVE
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray

# Unknowns of a screen elsewhere: its move, by how much the film was deeper then, and deeper in x
# than in y.
MOVED = SCREEN_MOVE + 2
STILL_UM = 1e-3  # 1 sigma of the motion of a film that does not move
# Of a mirror that is turned by hand, by marks on its ring.
TURN_SIGMA_DEG = 0.2
SEAT_SIGMA_MM = 0.5
_PER_POINT = ("column_px", "row_px", "screen_mm", "sigma_mm")  # arrays whose last axis is points


@dataclass(frozen=True)
class MovedScreen:
    """What is known, besides the fringes, of the same film seen with the screen put elsewhere.

    Attributes
    ----------
    shift_mm : tuple[float, float, float]
        Shift of the screen along s_x, s_y and towards the mirror.
    shift_sigma_mm : float
        Standard uncertainty of the shift's length.
    turn_sigma_deg : float
        Standard uncertainty of the shift's direction, and of the screen's turns.
    deeper_um : float
        Additional depth of the film then, according to the laser.
    motion_um : float
        Additional depth of the film in the x frames over the y frames.
    motion_sigma_um : float
    glass_sigma_mm : float
        Standard uncertainty of the glass over a screen that is seen directly.
    """

    shift_mm: tuple[float, float, float]
    shift_sigma_mm: float
    turn_sigma_deg: float
    deeper_um: float
    motion_um: float
    motion_sigma_um: float
    glass_sigma_mm: float = 0.0

    def make_prior(self, laser_sigma_um: float) -> FloatArray:
        """Values and sigmas (2, MOVED), mm and degrees, of the unknowns of a screen elsewhere.

        `laser_sigma_um` is the standard uncertainty of a set's mean laser reading.
        """
        film_mm = 1e-3 * np.array([self.deeper_um, self.motion_um])
        values = np.concatenate([self.shift_mm, np.zeros(3), film_mm])

        # The shift: a rail is as parallel to the screen's normal as the screen is to itself after
        # the move, so that the direction's error adds to the components across the shift.
        squares_mm2 = np.square(self.shift_mm)
        across_mm = np.sqrt(np.sum(squares_mm2) - squares_mm2) * np.radians(self.turn_sigma_deg)
        shift_sigmas_mm = np.hypot(self.shift_sigma_mm, across_mm)

        # The film: two laser readings, or the glass over a screen that is seen directly.
        deeper_sigma_mm = self.glass_sigma_mm or 1e-3 * np.sqrt(2) * laser_sigma_um
        motion_sigma_mm = 1e-3 * max(self.motion_sigma_um, STILL_UM)
        film_sigmas_mm = np.array([deeper_sigma_mm, motion_sigma_mm])
        turn_sigmas_deg = np.full(3, self.turn_sigma_deg)
        return np.stack(
            [values, np.concatenate([shift_sigmas_mm, turn_sigmas_deg, film_sigmas_mm])]
        )


# A screen that is seen directly: nothing is known of its place, and its pixels may lie behind some
# mm of glass.
ANYWHERE = MovedScreen((0.0, 0.0, 0.0), 1e3, 1e2, 0.0, 0.0, 0.0, glass_sigma_mm=3.0)


@dataclass(frozen=True)
class TurnedMirror:
    """How the mirror stood that was turned about its axis; height and tilt of its seat are free."""

    angle_deg: float  # counter-clockwise as the camera sees the mirror
    angle_sigma_deg: float = TURN_SIGMA_DEG
    seat_sigma_mm: float = SEAT_SIGMA_MM  # of the place of its axis, along x and along y
    figure_turns: bool = True  # False: its figure is unknown, whatever the other sets show


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

    def seen_with(self, screen: int) -> BoolArray:
        """Which points (n,) were seen with the screen in that place."""
        if self.screen is None:
            return np.full(self.sigma_mm.size, True)
        return np.asarray(self.screen == screen)

    def thinned(self, most: int) -> "SetPhases":
        """Every k-th bin, so that at most `most` are left."""
        return self.subset(slice(None, None, -(-self.column_px.size // most)))

    def subset(self, keep: slice | BoolArray) -> "SetPhases":
        """Some of the bins."""
        parts = {name: getattr(self, name)[..., keep] for name in _PER_POINT}
        return replace(self, **parts, screen=None if self.screen is None else self.screen[keep])

    def beside(self, again: "SetPhases", known: MovedScreen) -> "SetPhases":
        """The set with the points of the same film, seen again with the screen elsewhere."""
        before = self.screen
        if before is None:
            before = np.zeros(self.sigma_mm.size, int)
        screen = np.append(before, np.full(again.sigma_mm.size, len(self.moved_screens) + 1))
        parts: Any = {}
        for name in _PER_POINT:
            parts[name] = np.concatenate([getattr(self, name), getattr(again, name)], -1)
        return replace(self, **parts, moved_screens=(*self.moved_screens, known), screen=screen)
