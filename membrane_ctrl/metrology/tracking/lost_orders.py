"""Changes of shape that lost fringe orders would make, against those of a film.

If all bins lose m periods along x and n along y, the parameters change by m p_x + n p_y
(`FrameFitter.period_um`): mostly a tilt, with micrometres of astigmatism and coma, which no film
makes from frame to frame. A change is therefore scored by

    s = (other / usual)^2 + (tilt / 150 um)^2,

with `other` the RMS of all but tilt and bowl. The orders are certain if s is small, and larger with
any other orders.
"""

import math

import numpy as np

from membrane_ctrl.metrology.rays import surface
from membrane_ctrl.metrology.tracking.frame_fit import FrameFitter
from membrane_ctrl.metrology.tracking.frame_verdict import Finding
from membrane_ctrl.model.arrays import FloatArray

_LASER_UM = 20.0  # change of sag from frame to frame that the laser must see, too
_MOST_PERIODS = 8  # along x and along y
# Usual change of the other terms: at once, per second, and after any time.
_USUAL_UM = 0.5
_USUAL_UM_PER_S = 0.05
_USUAL_MOST_UM = 1.0
_USUAL_TILT_UM = 150.0
_MOST_SCORE = 16.0  # of a film: four sigmas
_LEAST_DIFFERENCE = 16.0  # of the score with any other orders


class LostOrders:
    """Decides whether a change of the parameters is that of a film, or of lost fringe orders.

    Parameters
    ----------
    fitter : FrameFitter
        Fitter of the reference's scene.
    """

    def __init__(self, fitter: FrameFitter) -> None:
        bowl = surface.Surface.hencky_bowl(1.0, fitter.scene.surface.radius_mm).parameters
        self._bowl = bowl / np.linalg.norm(bowl)
        x_um, y_um = fitter.period_um()
        periods = range(-_MOST_PERIODS, _MOST_PERIODS + 1)
        pairs = [(m, n) for m in periods for n in periods if m or n]
        self._lost_um = np.array([m * x_um + n * y_um for m, n in pairs])

    def require_distinguishable(self) -> None:
        """Raise ValueError if lost orders cannot be excluded even for a mirror that stood still."""
        if self.is_certain(np.zeros(surface.PARAMETERS), math.inf):
            return
        tilt_um = np.hypot(self._lost_um[:, 0], self._lost_um[:, 1])
        other_um = self.other_terms_um(self._lost_um)
        least = int(np.argmin(other_um**2 + (tilt_um / _USUAL_TILT_UM) ** 2))
        raise ValueError(
            f"a lost period looks like a tilt of {tilt_um[least]:.0f} µm RMS with "
            f"{other_um[least]:.1f} µm of other terms, as if the mirror had moved: use a longer "
            "period"
        )

    def other_terms_um(self, change_um: FloatArray) -> FloatArray:
        """RMS of a change (..., parameters) without its tilt and without its bowl."""
        rest = np.array(change_um)
        rest[..., :2] = 0.0
        rest -= (rest @ self._bowl)[..., None] * self._bowl
        return np.asarray(np.linalg.norm(rest, axis=-1))

    def find_lost_order(
        self, change_um: FloatArray, passed_s: float, displacement_um: float
    ) -> Finding | None:
        """Why a change is not that of this mirror; None if it is.

        Parameters
        ----------
        change_um : (parameters,) array
            Change of the parameters since the last good frame.
        passed_s : float
            Time since then; infinite for the first frame.
        displacement_um : float
            Change of the laser's reading; NaN without.
        """
        if not self.is_certain(change_um, passed_s):
            tilt_um = np.hypot(*change_um[:2])
            other_um = self.other_terms_um(change_um)
            return Finding(
                "rejected",
                "order lost: the mirror moved by a period or more since the last good frame, "
                f"or changed its shape (tilt {tilt_um:.0f} µm RMS, other terms {other_um:.1f})",
                lost=True,
            )
        sag_um = float(surface.sag_gradient() @ change_um)
        if abs(sag_um - displacement_um) > _LASER_UM:
            return Finding(
                "rejected", f"the sag changed by {sag_um:.0f} µm, which the laser did not see", True
            )
        return None

    def is_certain(self, change_um: FloatArray, passed_s: float) -> bool:
        """Whether a change is that of a film, and would not be with other orders.

        Parameters
        ----------
        change_um : (parameters,) array
            Change of the surface since the last frame.
        passed_s : float
            Time since then.
        """
        usual_um = min(_USUAL_UM + _USUAL_UM_PER_S * passed_s, _USUAL_MOST_UM)
        # The score s of the change as it is, and of the same change with whole periods added.
        own = float(self._score(change_um, usual_um))
        others = self._score(change_um + self._lost_um, usual_um)
        return own < _MOST_SCORE and bool(np.all(others > own + _LEAST_DIFFERENCE))

    def _score(self, change_um: FloatArray, usual_um: float) -> FloatArray:
        """s (...) of changes (..., parameters)."""
        tilt_um = np.hypot(change_um[..., 0], change_um[..., 1])
        other = (self.other_terms_um(change_um) / usual_um) ** 2
        return np.asarray(other + (tilt_um / _USUAL_TILT_UM) ** 2)
