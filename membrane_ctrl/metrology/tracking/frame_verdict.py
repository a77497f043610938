"""Faults of a tracked frame that its light or its fit shows."""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.tracking.frame_fit import FrameFit
from membrane_ctrl.model import shape_estimate
from membrane_ctrl.model.arrays import BoolArray

# Share of the mirror with wrong light.
COVERED_REJECTED = 0.25
COVERED_DEGRADED = 0.02
CONTRAST = 0.4  # least contrast of the fringes, over the reference's
_EXPOSURE = 0.03  # change of light from frame to frame that no panel makes
_DIMMED = 0.9  # least light, over that at the anchor
# What the fit leaves, over the swing of the fringes: noise, light and dust leave hundredths, a lost
# order 0.7.
REST_REJECTED = 0.15
_OUT_REJECTED = 0.1  # share of bins without weight and far off
_DARK = 0.3  # least light, over the reference's


@dataclass(frozen=True)
class Finding:
    """A fault of a frame.

    Attributes
    ----------
    verdict : Verdict
        What the fault makes of the frame.
    reason : str
        Sentence for people.
    lost : bool
        Whether the mirror may have moved further than frames can be followed.
    """

    verdict: shape_estimate.Verdict
    reason: str
    lost: bool = False


def light_faults(saturated: float, light: float, covered: BoolArray) -> list[Finding]:
    """Faults that the light of a frame shows before any fit.

    Parameters
    ----------
    saturated : float
        Share of the bins with a saturated pixel.
    light : float
        Light over the reference's.
    covered : (squares,) bool array
        Squares of the mirror with wrong light.
    """
    share = float(np.mean(covered))
    # Faults that reject the frame come first.
    faults = []
    if saturated > shape_estimate.SATURATED_REJECTED_FRACTION:
        faults.append(Finding("rejected", f"saturated: {saturated:.0%} of the bins"))
    if light < _DARK:
        faults.append(Finding("rejected", f"dark: {light:.0%} of the reference's light"))
    if share > COVERED_REJECTED:
        reason = f"covered: the light of {share:.0%} of the mirror is wrong"
        faults.append(Finding("rejected", reason))
    if saturated > shape_estimate.SATURATED_DEGRADED_FRACTION:
        faults.append(Finding("degraded", f"saturated: {saturated:.1%} of the bins"))
    if share > COVERED_DEGRADED:
        faults.append(Finding("degraded", f"covered: {share:.0%} of the mirror is left out"))
    return faults


def light_changes(light: float, last: float, anchor: float) -> list[Finding]:
    """Faults of exposure and panel.

    Parameters
    ----------
    light, last, anchor : float
        Light of this frame, of the last one and at the anchor, each over the reference's.

    Returns
    -------
    list of Finding
        At most one.
    """
    if abs(light / last - 1) > _EXPOSURE:
        reason = f"exposure changed: {light / last:.2f} of the light of the last frame"
        return [Finding("degraded", reason)]
    if light < _DIMMED * anchor:
        return [Finding("degraded", f"the screen dimmed to {light / anchor:.0%} of its light")]
    return []


def fit_fault(fit: FrameFit, rest: float, out: float) -> Finding | None:
    """Why a fit has failed; None if it has not.

    Parameters
    ----------
    fit : FrameFit
        The solution.
    rest : float
        Scale of what it leaves, over the swing of the fringes.
    out : float
        Share of the bins without weight and far off.
    """
    is_far = not fit.converged or rest > REST_REJECTED
    if is_far or out > _OUT_REJECTED:
        left = f"the fit leaves {rest:.0%} of the fringes, {out:.0%} of the bins do not fit"
        if not is_far:
            return Finding("rejected", f"covered or order lost: {left}", True)
        return Finding(
            "rejected",
            f"order lost: the mirror moved too far since the last good frame ({left})",
            True,
        )

    # Contrast of the worse axis over the reference's: the first term of the maps is 1 everywhere.
    level = 1 + fit.light[0, 0]
    swings = 1 + fit.light[1:, 0]
    contrast = float(np.min(swings) / level)
    if contrast < -CONTRAST:
        return Finding("rejected", "order lost: the fringes moved by half a period", True)
    if contrast < CONTRAST:
        return Finding("rejected", f"no fringes: {abs(contrast):.0%} of the reference's contrast")
    return None
