"""Faults of a tracked frame that its light or its fit shows."""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.tracking.frame_fit import FrameFit
from membrane_ctrl.model import shape_estimate
from membrane_ctrl.model.arrays import BoolArray

COVERED_REJECTED, COVERED_DEGRADED = 0.25, 0.02
CONTRAST = 0.4  # of the fringes, against the reference's
_EXPOSURE = 0.03  # change of light from frame to frame that no panel makes
_DIMMED = 0.9  # of the light at the anchor
# What the fit leaves, over the swing of the fringes: noise, light and dust leave hundredths, a lost
# order 0.7
REST_REJECTED = 0.15
_OUT_REJECTED = 0.1  # share of bins without weight and far off
_DARK = 0.3  # of the reference's light


@dataclass(frozen=True)
class Finding:
    """Why a frame is not what it should be."""

    verdict: shape_estimate.Verdict
    reason: str
    lost: bool = False


def light_faults(saturated: float, light: float, covered: BoolArray) -> list[Finding]:
    """What the picture's light says before any fit."""
    share = float(np.mean(covered))
    rejected, degraded = (
        shape_estimate.SATURATED_REJECTED_FRACTION,
        shape_estimate.SATURATED_DEGRADED_FRACTION,
    )
    checks = (
        (saturated > rejected, "rejected", f"saturated: {saturated:.0%} of the bins"),
        (light < _DARK, "rejected", f"dark: {light:.0%} of the reference's light"),
        (
            share > COVERED_REJECTED,
            "rejected",
            f"covered: the light of {share:.0%} of the mirror is wrong",
        ),
        (saturated > degraded, "degraded", f"saturated: {saturated:.1%} of the bins"),
        (share > COVERED_DEGRADED, "degraded", f"covered: {share:.0%} of the mirror is left out"),
    )
    return [Finding(verdict, reason) for wrong, verdict, reason in checks if wrong]  # type: ignore[arg-type]


def light_changes(light: float, last: float, anchor: float) -> list[Finding]:
    """What the light of a frame says of exposure and panel, beside that of the last and that at the
    anchor.
    """
    if abs(light / last - 1) > _EXPOSURE:
        return [
            Finding(
                "degraded", f"exposure changed: {light / last:.2f} of the light of the last frame"
            )
        ]
    if light < _DIMMED * anchor:
        return [Finding("degraded", f"the screen dimmed to {light / anchor:.0%} of its light")]
    return []


def fit_fault(fit: FrameFit, rest: float, out: float) -> Finding | None:
    """Whether a fit has failed: `rest` over the swing of the fringes is left, `out` of the bins
    have no weight.
    """
    if not fit.converged or rest > REST_REJECTED or out > _OUT_REJECTED:
        left = f"the fit leaves {rest:.0%} of the fringes, {out:.0%} of the bins do not fit"
        if fit.converged and rest <= REST_REJECTED:
            return Finding("rejected", f"covered or order lost: {left}", True)
        return Finding(
            "rejected",
            f"order lost: the mirror moved too far since the last good frame ({left})",
            True,
        )
    contrast = float(
        np.min(1 + fit.light[1:, 0]) / (1 + fit.light[0, 0])
    )  # of the first term, 1 everywhere
    if contrast < -CONTRAST:
        return Finding("rejected", "order lost: the fringes moved by half a period", True)
    if contrast < CONTRAST:
        return Finding("rejected", f"no fringes: {abs(contrast):.0%} of the reference's contrast")
    return None
