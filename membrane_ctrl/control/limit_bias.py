"""Reduces the mean error of a loop whose pump often stands at its limit. Pure.

The pump only adds gas. Where the leak is small for the weather, the wanted flow is often below 0:
what lifts the mirror is removed slowly, by the leak, and what lowers it at once, by the pump. A
loop that always aims at the setpoint then holds the mirror above it on average. So the aim moves
against the mean error, the faster the larger the share of time is that the pump spends at a limit:

    dw/dt = (a - w) / T_w                      a: 1 at a limit, 0 otherwise; w: their share
    do/dt = w e / T_o - o / T_m                e: setpoint less estimate; o: moves the aim (1)

A pump that is never at its limit leaves the aim at the setpoint.
"""

from dataclasses import dataclass

from membrane_ctrl.control.filters import lag_step_fraction
from membrane_ctrl.model.state_tree import StateNode

_SHARE_S = 60.0  # T_w
_OFFSET_S = 20.0  # T_o: slow against any loop
_MEMORY_S = 300.0  # T_m: the weather of half an hour ago is another one
# Larger errors count as this much
_ERROR_MOST_UM = 1.0
# Errors beyond this are those of a start or of a film that has jumped: they pass, and show nothing
# of the mean. A return from 50 µm at the speed of the leak would otherwise move the aim by 0.2 µm.
_PASSING_UM = 3.0
# More than the mean error of any of the benchmark's random benches (0.8 µm). A pump that cannot
# hold the mirror at all winds the aim no further, so that it returns without a lasting error once
# it can.
_OFFSET_MOST_UM = 2.0


@dataclass(slots=True)
class LimitBias(StateNode):
    """The aim's offset, and the share of time at a limit."""

    offset_um: float = 0.0
    share: float = 0.0

    def step(self, error_um: float, at_limit: bool, dt_s: float) -> None:
        """Run one tick of (1).

        Parameters
        ----------
        error_um : float
            Setpoint less estimate of the centre.
        at_limit : bool
            The wanted flow is beyond the pump's range.
        dt_s : float
            Time since the last tick.
        """
        self.share += lag_step_fraction(dt_s, _SHARE_S) * (float(at_limit) - self.share)
        limited_um = 0.0
        if abs(error_um) < _PASSING_UM:
            limited_um = min(max(error_um, -_ERROR_MOST_UM), _ERROR_MOST_UM)
        self.offset_um += dt_s * self.share * limited_um / _OFFSET_S
        self.offset_um -= lag_step_fraction(dt_s, _MEMORY_S) * self.offset_um
        self.offset_um = min(max(self.offset_um, -_OFFSET_MOST_UM), _OFFSET_MOST_UM)
