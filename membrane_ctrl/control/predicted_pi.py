"""Predicts what the PI on the laser would do while another loop holds the mirror. Pure.

    y' = y + z        dz/dt = q' - q                                                         (1)

y is the laser's reading, q the flow that arrives, q' the flow that would arrive with the PI, both
behind the pump's dead time and lag. The mirror adds the gas of both loops in the same way, so the
weather and the laser's noise in y' are those that the PI would have met.
"""

import math
from dataclasses import dataclass, field

from membrane_ctrl.config.control import EstimatorConfig, LoopConfig, PumpConfig
from membrane_ctrl.control.feedforward import FeedForward, FeedForwardState
from membrane_ctrl.control.filters import LowPass
from membrane_ctrl.control.gas_transit import Transit, TransitState
from membrane_ctrl.control.pid import Pid, PidGains, PidState
from membrane_ctrl.model.state_tree import StateNode


@dataclass(slots=True)
class PredictedPiState(StateNode):
    """What the prediction remembers from tick to tick.

    Attributes
    ----------
    moved_um : float
        z of (1).
    flow_um_per_s : float
        The PI's in the last tick; NaN before `start`.
    kept_s : float
        For how long it is kept, in ticks without a new reading.
    """

    moved_um: float = 0.0
    flow_um_per_s: float = math.nan
    kept_s: float = 0.0
    measured: LowPass = field(default_factory=LowPass)
    integrator: PidState = field(default_factory=PidState)
    feedforward: FeedForwardState = field(default_factory=FeedForwardState)
    transit: TransitState = field(default_factory=TransitState)


class PredictedPi:
    """A PI on the laser beside the loop that holds the mirror.

    Parameters
    ----------
    loop, pump, estimator
        Gains, the pump's range, its dead time and lag.
    memory : PredictedPiState, optional
        From the snapshot of an earlier controller; else it waits for `start`.
    """

    def __init__(
        self,
        loop: LoopConfig,
        pump: PumpConfig,
        estimator: EstimatorConfig,
        memory: PredictedPiState | None = None,
    ) -> None:
        self.memory = memory or PredictedPiState()
        self._filter_s = loop.measurement_filter_s
        gains = PidGains(loop.kp_per_s, loop.ti_s, loop.td_s)
        self._flow_max_um_per_s = loop.flow_most_um_per_s(pump)
        self._pid = Pid(gains, self._flow_max_um_per_s, self.memory.integrator)
        self._feedforward = FeedForward(loop, self.memory.feedforward)
        self._transit = Transit(
            estimator.pump_delay_s, estimator.pump_lag_s, 1.0 / loop.rate_hz, self.memory.transit
        )

    @property
    def runs(self) -> bool:
        """Whether it was started."""
        return math.isfinite(self.memory.flow_um_per_s)

    def start(self, reading_um: float, mean_flow_um_per_s: float, flow_um_per_s: float) -> None:
        """Begin with both loops at the same place.

        Parameters
        ----------
        reading_um, mean_flow_um_per_s : float
            Filtered reading, and the first value of the integrator.
        flow_um_per_s : float
            Of the present loop, in the last tick.
        """
        memory = self.memory
        memory.moved_um = 0.0
        memory.flow_um_per_s = flow_um_per_s
        memory.kept_s = 0.0
        memory.measured.reset(reading_um)
        self._pid.place(mean_flow_um_per_s)
        self._transit.place(0.0)

    def stop(self) -> None:
        """End the prediction."""
        self.memory.flow_um_per_s = math.nan

    def step(
        self,
        reading_um: float,
        setpoint_um: float,
        weather: tuple[float, float],
        last_flow_um_per_s: float,
        dt_s: float,
    ) -> float:
        """One tick after `start`.

        Parameters
        ----------
        reading_um : float
            The laser's; NaN without one.
        setpoint_um : float
            With the trim.
        weather : tuple of float
            Ambient pressure in Pa and air temperature in °C; NaN without a sensor.
        last_flow_um_per_s : float
            Of the present loop, since the last tick.
        dt_s : float
            Time since the last tick.

        Returns
        -------
        float
            The reading that the PI would have seen, µm; NaN without one.
        """
        memory = self.memory
        # The gas that the PI would have added beyond the present loop moves its mirror.
        extra_um_per_s = memory.flow_um_per_s - last_flow_um_per_s
        memory.moved_um += self._transit.advance(extra_um_per_s, dt_s)
        seen_um = reading_um + memory.moved_um
        known_um_per_s = self._feedforward.update(*weather, dt_s)
        if math.isnan(seen_um):
            memory.kept_s += dt_s
            return seen_um
        # Then a tick of that PI, as `InnerLoop.step` does it.
        since_s = memory.kept_s + dt_s
        memory.kept_s = 0.0
        before_um = memory.measured.value
        filtered_um = memory.measured.update(seen_um, since_s, self._filter_s)
        rate_um_per_s = (filtered_um - before_um) / since_s
        terms = self._pid.terms(setpoint_um - filtered_um, rate_um_per_s)
        wanted_um_per_s = terms.sum_um_per_s + known_um_per_s
        self._pid.integrate(since_s)
        memory.flow_um_per_s = min(max(wanted_um_per_s, 0.0), self._flow_max_um_per_s)
        return seen_um
