"""Reports the learned state of the pump, and warns of a drift beyond its limit. Pure."""

from dataclasses import dataclass

from membrane_ctrl.control.maintenance_notice import WITHDRAWN_BELOW, MaintenanceNotice
from membrane_ctrl.control.pump_drift import PumpScale
from membrane_ctrl.model.state_tree import Count, StateNode

_PUMP_EVERY = 10  # segments of a minute between reports
_PUMP_SIGMAS = 3.0


@dataclass(slots=True)
class PumpHealthState(StateNode):
    """Segments so far, and whether the warning applies."""

    count: Count = 0
    warned: bool = False


class PumpHealth:
    """Reports what a hold has learned of its pump, and warns once of
    a drift beyond `change_max`.
    """

    def __init__(self, change_max: float, memory: PumpHealthState | None = None) -> None:
        self._change_max = change_max
        self.memory = memory or PumpHealthState()

    def set_pump(self, change_max: float) -> None:
        """Set by which share the pump may differ from its curve (`pump.change_max`)."""
        self._change_max = change_max

    def step(self, known: PumpScale) -> tuple[bool, tuple[MaintenanceNotice, ...]]:
        """Take a segment's estimate; returns whether to report it,
        and a new or withdrawn warning.
        """
        memory = self.memory
        memory.count += 1
        # A certain change beyond the limit; a smaller one withdraws the warning.
        change = known.scale - 1.0
        threshold = max(self._change_max, _PUMP_SIGMAS * known.sigma)
        if memory.warned:
            threshold *= WITHDRAWN_BELOW
        bad = abs(change) > threshold
        notices: tuple[MaintenanceNotice, ...] = ()
        if bad != memory.warned:
            side = "less" if change < 0 else "more"
            message = "no longer so"
            if bad:
                message = (
                    f"the pump gives {100 * abs(change):.0f} % {side} than its curve "
                    f"(+- {100 * known.sigma:.0f} %): check it, then `tune pump`"
                )
            notices = (MaintenanceNotice("pump_drift", message, bad),)
        memory.warned = bad
        return bool(notices) or memory.count % _PUMP_EVERY == 0, notices
