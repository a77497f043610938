"""The diaphragm pump: command for a flow, and the flow a command gives.

    q = q_full (d - dead) / (1 - dead)   while it runs; starts at `start`, stalls below `stall`   (PHYSICS, pump)

Between rest and the least running flow there is nothing: a wanted flow in that gap goes to the nearer end, so that
the error of the gap has no sign of its own. (Always running on would add gas that nothing takes away, always stopping
would leave the least flow missing: each is a bias.) What remains is left to the integrator, which is not told of
the gap: it sees the error that follows.
"""

from __future__ import annotations

from membrane_ctrl.config import PumpConfig

# Above the stall command by this much, so that a rounded register or a cold pump does not stall.
STALL_MARGIN = 0.005

# A stopped pump gets the start command for this long: about its lag (0.15 s), in which it adds less than 0.1 um.
KICK_S = 0.1


class PumpCurve:
    """The inverse of the pump; it remembers whether it left the pump running.

    Parameters
    ----------
    pump : PumpConfig
    """

    def __init__(self, pump: PumpConfig) -> None:
        self._pump = pump
        self._least_fraction = pump.stall_fraction + STALL_MARGIN
        self._kick_left_s = KICK_S

    @property
    def least_flow_um_per_s(self) -> float:
        """The smallest flow of a running pump."""
        return self.flow(self._least_fraction)

    def stopped(self) -> None:
        """The pump was stopped by somebody else: the next flow starts it."""
        self._kick_left_s = KICK_S

    def flow(self, fraction: float) -> float:
        """Flow in um/s that a running pump gives for a command."""
        pump = self._pump
        return max(0.0, pump.flow_full_um_per_s * (fraction - pump.dead_fraction) / (1.0 - pump.dead_fraction))

    def command(self, flow_um_per_s: float, dt_s: float) -> float:
        """Command for a flow; the pump is kicked when it stands still."""
        if flow_um_per_s < 0.5 * self.least_flow_um_per_s:
            self.stopped()
            return 0.0
        pump = self._pump
        fraction = pump.dead_fraction + (1.0 - pump.dead_fraction) * flow_um_per_s / pump.flow_full_um_per_s
        fraction = min(max(fraction, self._least_fraction), 1.0)
        if self._kick_left_s > 0.0:
            self._kick_left_s -= dt_s
            fraction = max(fraction, pump.start_fraction)
        return fraction
