"""Changes of shape that lost fringe orders would make, against those of a film."""

import math

import numpy as np

from membrane_ctrl.metrology.rays import surface
from membrane_ctrl.metrology.tracking.frame_fit import FrameFitter
from membrane_ctrl.metrology.tracking.frame_verdict import Finding
from membrane_ctrl.model.arrays import FloatArray

_LASER_UM = 20.0  # change of sag from frame to frame, less the laser's


class LostOrders:
    """What a change of shape would be if whole periods were lost."""

    def __init__(self, fitter: FrameFitter) -> None:
        bowl = surface.Surface.hencky_bowl(1.0, fitter.scene.surface.radius_mm).parameters
        self._bowl = bowl / np.linalg.norm(bowl)
        x, y = fitter.period_um()
        pairs = [(m, n) for m in range(-8, 9) for n in range(-8, 9) if m or n]
        self._lost_um = np.array([m * x + n * y for m, n in pairs])

    def require_telling(self) -> None:
        """Raise ValueError if even a mirror that stood still might have lost an order since the
        reference.
        """
        if self.sure(np.zeros(surface.PARAMETERS), math.inf):
            return
        tilt_um, odd_um = (
            np.hypot(self._lost_um[:, 0], self._lost_um[:, 1]),
            self.odd_um(self._lost_um),
        )
        least = int(np.argmin(odd_um**2 + (tilt_um / 150.0) ** 2))
        raise ValueError(
            f"a lost period looks like a tilt of {tilt_um[least]:.0f} µm RMS with "
            f"{odd_um[least]:.1f} µm of "
            "other terms, as if the mirror had moved: use a longer period"
        )

    def odd_um(self, change_um: FloatArray) -> FloatArray:
        """RMS of a change (..., parameters) without its tilt and without its bowl."""
        rest = np.array(change_um)
        rest[..., :2] = 0.0
        rest -= (rest @ self._bowl)[..., None] * self._bowl
        return np.asarray(np.linalg.norm(rest, axis=-1))

    def doubt(
        self, change_um: FloatArray, passed_s: float, displacement_um: float
    ) -> Finding | None:
        """Whether a change (parameters,) is none of this mirror's; `displacement_um` is that of the
        laser, NaN without."""
        if not self.sure(change_um, passed_s):
            tilt_um, odd_um = np.hypot(*change_um[:2]), self.odd_um(change_um)
            return Finding(
                "rejected",
                "order lost: the mirror moved by a period or more since the last good frame, "
                "or changed its shape "
                f"(tilt {tilt_um:.0f} µm RMS, other terms {odd_um:.1f})",
                lost=True,
            )
        sag_um = float(surface.sag_gradient() @ change_um)
        if abs(sag_um - displacement_um) > _LASER_UM:
            return Finding(
                "rejected", f"the sag changed by {sag_um:.0f} µm, which the laser did not see", True
            )
        return None

    def sure(self, change_um: FloatArray, passed_s: float) -> bool:
        """Whether a change is that of a film, and would not be with any orders lost."""
        usual_um = min(0.5 + 0.05 * passed_s, 1.0)

        def strange(change: FloatArray) -> FloatArray:
            tilt_um = np.hypot(change[..., 0], change[..., 1])
            return np.asarray((self.odd_um(change) / usual_um) ** 2 + (tilt_um / 150.0) ** 2)

        own = float(strange(change_um))
        return own < 16.0 and bool(np.all(strange(change_um + self._lost_um) > own + 16.0))
