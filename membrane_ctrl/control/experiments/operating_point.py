"""Operating point of an experiment: flows, noise, limit, and the room around them. Pure."""

from dataclasses import dataclass, replace
from itertools import product

from membrane_ctrl.control import pump_curve
from membrane_ctrl.control.experiments.centre_motion import USUAL_LATE_S, CentreMotion
from membrane_ctrl.model.state_tree import StateNode

NOISE_MARGIN_SIGMAS = 3.0
# Of the limit, for the noise: with more, the noise stops sound experiments; longer filters see
# motion later
_IN_HAND_SHARE = 0.22
_STRETCHES = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
PULL_PER_S = 0.15  # stable on a pump three times as strong as configured, and 2 s late


@dataclass(frozen=True, slots=True)
class OperatingPoint(StateNode):
    """The operating point of an experiment."""

    holding_flow_um_per_s: float  # mean flow of the loop before it
    least_flow_um_per_s: float  # of the pump while it runs
    full_flow_um_per_s: float
    laser_um: float  # standard deviation of a reading
    limit_um: float = 10.0  # largest excursion of the centre from where it stood
    late_s: float = USUAL_LATE_S  # delay and lag of the pump, if known
    stretch: float = 1.0  # of the filters, for a noisy laser with few readings (`choose_filters`)

    def within(self, flow_um_per_s: float) -> float:
        """The nearest flow of a running pump."""
        return min(max(flow_um_per_s, self.least_flow_um_per_s), self.full_flow_um_per_s)


def choose_filters(around: OperatingPoint, rate_hz: float) -> OperatingPoint:
    """Return the operating point with filters that leave the noise its share of the limit.

    Parameters
    ----------
    around : OperatingPoint
        Its noise of a reading decides.
    rate_hz : float
        Ticks a second.

    Returns
    -------
    OperatingPoint
        With the longest filters for the usual delay if none suffices.
    """
    share_um = _IN_HAND_SHARE * around.limit_um / NOISE_MARGIN_SIGMAS
    for late_s, stretch in product((around.late_s, USUAL_LATE_S), _STRETCHES):
        if (
            around.laser_um * CentreMotion(stretch, late_s).compute_noise_per_laser(rate_hz)
            <= share_um
        ):
            break
    return replace(around, late_s=late_s, stretch=stretch)


def require_room(around: OperatingPoint) -> tuple[float, float]:
    """Flow above and below the holding flow. Raises ValueError without any: the mirror is too tight
    or too leaky.
    """
    up = around.full_flow_um_per_s - around.holding_flow_um_per_s
    down = around.holding_flow_um_per_s - around.least_flow_um_per_s
    if min(up, down) <= 0:
        remedy = "find the leak"
        if down <= 0:
            remedy = describe_bleed_remedy(around.holding_flow_um_per_s, around.least_flow_um_per_s)
        raise ValueError(
            f"no room around the holding flow of {around.holding_flow_um_per_s:.2f} µm/s in "
            f"the pump's range of {around.least_flow_um_per_s:.2f} .. "
            f"{around.full_flow_um_per_s:.2f} µm/s: {remedy}"
        )
    return up, down


def describe_bleed_remedy(loss_um_per_s: float, least_um_per_s: float = 0.0) -> str:
    """Say what to do where a mirror loses too little gas for the least flow of its pump.

    Parameters
    ----------
    loss_um_per_s : float
        Leak and bleed, as speed of the centre.
    least_um_per_s : float
        Least flow of the running pump.
    """
    more_um_per_s = max(0.3, 1.5 * least_um_per_s - loss_um_per_s)
    share = more_um_per_s / pump_curve.VENT_FULL_UM_PER_S
    return f"open the bleed by {more_um_per_s:.1f} µm/s (loop.bleed_fraction larger by {share:.3f})"
