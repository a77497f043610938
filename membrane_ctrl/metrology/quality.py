"""What one cycle's numbers say about it: a pure table of limits."""

from __future__ import annotations

from dataclasses import dataclass

from membrane_ctrl.estimate import Verdict

# Fringes weaker than this share of the sensor's range: at 2 % (5 of 255) the noise of the phase passes 0.06 rad a
# pixel and rounding no longer averages out; at 6 % something is wrong with exposure, focus or screen.
MODULATION_REJECTED_SHARE = 0.02
MODULATION_DEGRADED_SHARE = 0.06
# Saturated pixels bend the phase by harmonics; their bins are left out, so a few (glints) do no harm.
SATURATED_REJECTED_FRACTION = 0.20
SATURATED_DEGRADED_FRACTION = 0.005
# 36 terms over a disc with a quarter missing are extrapolated there.
VALID_REJECTED_FRACTION = 0.5
VALID_DEGRADED_FRACTION = 0.9
# Wrinkles and ripple leave some tens of microradian; a wrong fringe order leaves 8700 at its place.
RESIDUAL_REJECTED_URAD = 1000.0
RESIDUAL_DEGRADED_URAD = 200.0


@dataclass(frozen=True)
class Quality:
    """Figures of one cycle.

    Attributes
    ----------
    modulation_share : float
        Median fringe amplitude over the sensor's full scale.
    saturated_fraction : float
        Share of the points with a saturated pixel.
    valid_fraction : float
        Share of the analysis area that gave a slope.
    residual_urad : float
        RMS of measured minus fitted slopes.
    converged : bool
        Whether the fit stood still at its end.
    """

    modulation_share: float
    saturated_fraction: float
    valid_fraction: float
    residual_urad: float
    converged: bool


def judge(quality: Quality) -> tuple[Verdict, str]:
    """The worst verdict and its reason; NaN anywhere is a rejection."""
    q = quality
    rejected = (
        (
            q.modulation_share >= MODULATION_REJECTED_SHARE,
            f"fringe modulation {q.modulation_share:.1%} of full scale",
        ),
        (q.saturated_fraction <= SATURATED_REJECTED_FRACTION, f"{q.saturated_fraction:.1%} of the points saturated"),
        (q.valid_fraction >= VALID_REJECTED_FRACTION, f"only {q.valid_fraction:.0%} of the area gave a slope"),
        (q.converged, "the fit did not converge"),
        (q.residual_urad <= RESIDUAL_REJECTED_URAD, f"slope residual {q.residual_urad:.0f} urad"),
    )
    degraded = (
        (q.modulation_share >= MODULATION_DEGRADED_SHARE, rejected[0][1]),
        (q.saturated_fraction <= SATURATED_DEGRADED_FRACTION, rejected[1][1]),
        (q.valid_fraction >= VALID_DEGRADED_FRACTION, rejected[2][1]),
        (q.residual_urad <= RESIDUAL_DEGRADED_URAD, rejected[4][1]),
    )
    for fine, reason in rejected:
        if not fine:
            return "rejected", reason
    for fine, reason in degraded:
        if not fine:
            return "degraded", reason
    return "ok", ""
