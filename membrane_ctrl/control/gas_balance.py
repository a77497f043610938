"""Gas that the pump gives beyond the leak, as a motion of the centre, beside the gauge. Pure.

Optics that are frozen with their noise show a mirror that answers nothing. Without the laser the
estimate takes that for a growing or shrinking leak, and the mirror leaves. Only the gauge shows it,
and alone it must show much, because climate moves it as well. If as much gas has gone in or out, it
need not.

The gas of the last minute counts: an error of the leak of 0.1 µm/s then adds up to 6 µm.
"""

import math
from dataclasses import dataclass

from membrane_ctrl.model.state_tree import StateNode

MEMORY_S = 60.0
# Gas that may be the error of the leak, or compensates weather.
EXCESS_LEAST_UM = 12.0
# With that much gas the gauge and the optics may differ by this share of what they else may.
GAUGE_SHARE = 0.4


@dataclass(slots=True)
class GasBalanceState(StateNode):
    """Leak while the laser was there, and gas beyond it since; NaN: unknown."""

    leak_um_per_s: float = math.nan
    excess_um: float = 0.0


class GasBalance:
    """Counts gas from the moment at which the laser is lost."""

    def __init__(self, memory: GasBalanceState) -> None:
        self.memory = memory

    def step(
        self, flow_um_per_s: float, leak_um_per_s: float, optics_alone: bool, dt_s: float
    ) -> None:
        """Process one tick.

        Parameters
        ----------
        flow_um_per_s, leak_um_per_s : float
            Flow of the pump, and the loop's mean leak; NaN without.
        optics_alone : bool
            The optics show the mirror in the laser's place, at a setpoint that rests.
        dt_s : float
            Since the last tick.
        """
        memory = self.memory
        if not optics_alone:
            memory.leak_um_per_s = leak_um_per_s
            memory.excess_um = 0.0
            return
        gained_um = (flow_um_per_s - memory.leak_um_per_s) * dt_s
        if math.isfinite(gained_um):
            memory.excess_um += gained_um - memory.excess_um * dt_s / MEMORY_S

    def explain_contradiction(self, gauge_share: float) -> str:
        """What gas and gauge show together against the optics; empty if that is not enough.

        `gauge_share` is the distance of optics and gauge in units of its limit.
        """
        excess_um = self.memory.excess_um
        if abs(excess_um) < EXCESS_LEAST_UM or gauge_share < GAUGE_SHARE:
            return ""
        return (
            f"the optics show a mirror at rest, but {excess_um:+.0f} µm of gas and the gauge a "
            "moving one"
        )
