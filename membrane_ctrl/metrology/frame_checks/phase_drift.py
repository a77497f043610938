"""Drift of the phases from frame to frame of an axis, which shows a camera or screen that moves.

The patterns step by known phases. If the whole picture of a frame is shifted besides, by more than
the film's motion explains, camera, screen or mirror moved as bodies.
"""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import FloatArray

# Share of the phases' change by the film's motion that is left as a shift of the picture: films of
# the second world that move by 10 µm RMS within an axis seem to shift it by 1 to 4 %.
_FILM_SHARE = 0.03


@dataclass(frozen=True)
class PhaseShifts:
    """Shifts of the phases of the used sinusoids of one axis, about those of the pattern.

    Attributes
    ----------
    frames : (N,) array
        Numbers of the frames in the set.
    shift_rad : (N,) array
        Shift of the whole picture, without that by the film's motion.
    film_rad : float
        Change of the phases by the film's motion, RMS over the frames and the mirror.
    patches_rad : (N, patches) array
        What the residuals of each patch of the picture add to the shifts.
    """

    frames: FloatArray
    shift_rad: FloatArray
    film_rad: float
    patches_rad: FloatArray

    @property
    def drift_rad(self) -> float:
        """Drift per frame."""
        return float(self._rate() @ self.shift_rad)

    @property
    def drift_by_film_rad(self) -> float:
        """1 sigma of the drift per frame that a film in motion seems to cause."""
        return _FILM_SHARE * self.film_rad * float(np.linalg.norm(self._rate()))

    @property
    def drift_sigma_rad(self) -> float:
        """1 sigma of the drift per frame by what the frames' models leave.

        Noise, and waves of a response, a blur or a previous picture that no model represents: what
        patches of the picture contribute scatters, in all frames together.
        """
        return float(np.linalg.norm(self._rate() @ self.patches_rad))

    def _rate(self) -> FloatArray:
        """Weights (N,) of the shifts in the drift.

        What alternates from frame to frame is no drift: with four steps of a quarter of a period,
        waves of twice the fringes' frequency alternate.
        """
        from_middle = self.frames - self.frames.mean()
        alternating = (-1.0) ** np.arange(self.frames.size)
        design = np.stack([np.ones(self.frames.size), from_middle, alternating], axis=1)
        return np.asarray(np.linalg.pinv(design)[1])
