"""The inner loop: holds the centre (the laser's reading, or the estimate) at the setpoint with the
pump's flow. Pure: no I/O, no clock.

Order of a tick on the laser: setpoint ramp and trim -> measurement filter -> P, I, D ->
feed-forward -> limits -> back-calculation -> pump curve. The measurement filter stands before the
limits: noise that meets a one-sided limit becomes a bias.
"""

import math
from dataclasses import dataclass, field, replace

from membrane_ctrl.config.schema import EstimatorConfig, LoopConfig, PumpConfig
from membrane_ctrl.control import (
    filters,
    flow_limiter,
    leak_estimate,
    loop_margins,
    pid,
    pump_curve,
    pump_drift,
    setpoint_ramp,
    setpoint_weight,
)
from membrane_ctrl.control.centre_estimate import CentreEstimate
from membrane_ctrl.control.feedforward import FeedForward, FeedForwardState
from membrane_ctrl.control.limit_bias import LimitBias
from membrane_ctrl.model.state_tree import StateNode

_AT_TARGET_UM = 0.1  # of the ramp: the pump is probed only then
# Memory with which the error that the laser's loop left is removed after the hand-over
_HAND_OVER_S = 0.5


@dataclass(frozen=True, slots=True)
class LoopInput:
    """Inputs of one tick."""

    target_um: float  # end of the setpoint's ramp, without the trim
    # the share of shape loop and held scalar in the setpoint; it changes slowly and is added behind
    # the ramp
    trim_um: float
    displacement_um: float  # laser reading, as read
    ambient_pressure_pa: float  # NaN without a sensor
    air_temperature_c: float
    estimate: CentreEstimate | None = None  # held instead of the laser, if given


@dataclass(frozen=True, slots=True)
class LoopOutput(StateNode):
    """Results of one tick, with their components."""

    setpoint_um: float = math.nan  # ramp and trim
    filtered_um: float = math.nan  # NaN in a tick without a reading
    # setpoint minus filtered reading; NaN without one, and while another sets the flow
    error_um: float = math.nan
    p_um_per_s: float = math.nan
    i_um_per_s: float = math.nan
    d_um_per_s: float = math.nan
    feedforward_um_per_s: float = math.nan  # the ramp's own speed included
    flow_wanted_um_per_s: float = math.nan  # before the limits
    flow_um_per_s: float = math.nan
    pump_fraction: float = 0.0  # command, 0..1
    saturated: bool = False  # the wanted flow exceeds the pump's, or is negative
    leak_um_per_s: float = math.nan  # estimated loss of gas, NaN in a tick without an estimate
    too_tight: bool = False  # the mirror loses too little gas to be held within the band


@dataclass(slots=True)
class InnerLoopState(StateNode):
    """What the loop remembers from tick to tick."""

    setpoint_um: float = math.nan
    shaped_um: float = math.nan  # the setpoint behind its weight
    measured: filters.LowPass = field(default_factory=filters.LowPass)
    # The setpoint passes the same lag as the measurement: a ramp is then no error of its own.
    matched: filters.LowPass = field(default_factory=filters.LowPass)
    ramp: setpoint_ramp.SetpointRampState = field(default_factory=setpoint_ramp.SetpointRampState)
    weight: setpoint_weight.SetpointWeightState = field(
        default_factory=setpoint_weight.SetpointWeightState
    )
    integrator: pid.PidState = field(default_factory=pid.PidState)
    feedforward: FeedForwardState = field(default_factory=FeedForwardState)
    limiter: flow_limiter.FlowState = field(default_factory=flow_limiter.FlowState)
    curve: pump_curve.PumpCurveState = field(default_factory=pump_curve.PumpCurveState)
    drift: pump_drift.PumpDriftState = field(default_factory=pump_drift.PumpDriftState)
    leak: leak_estimate.LeakEstimate = field(default_factory=leak_estimate.LeakEstimate)
    learned: bool = False  # the last tick has ended a segment of the probe
    # Of the last automatic tick, and since when it is kept; None after any other tick
    kept_output: LoopOutput | None = None
    kept_s: float = 0.0
    follows_estimate: bool = False  # the last automatic tick did
    # Added to the aim of the loop on the estimate after a hand-over; decays in 0.5 s
    aim_offset_um: float = 0.0
    # Added to that aim against the mean error of a pump that stands at a limit
    limit_bias: LimitBias = field(default_factory=LimitBias)


class InnerLoop:
    """Two-degree-of-freedom PI(D) with feed-forward, on flow as a speed of the mirror's centre.

    Call exactly one of `step`, `keep_output`, `step_without_reading`, `follow_flow` and
    `resume_at_mean` per tick; the first four may follow each other without a bump.
    """

    def __init__(
        self,
        loop: LoopConfig,
        pump: PumpConfig,
        estimator: EstimatorConfig = EstimatorConfig(),  # noqa: B008 (frozen)
        memory: InnerLoopState | None = None,
    ) -> None:
        self.memory = memory = memory or InnerLoopState()
        self._loop = loop
        self.set_pump_lag(estimator)
        self._flow_full_um_per_s = pump.flow_full_um_per_s
        flow_max_um_per_s = loop.flow_most_um_per_s(pump)
        self._ramp = setpoint_ramp.SetpointRamp(
            loop.setpoint_ramp_um_per_s, flow_max_um_per_s, memory.ramp
        )
        self._weight = setpoint_weight.SetpointWeight(
            loop.setpoint_weight, loop.ti_s, memory.weight
        )
        self._pid = pid.Pid(_make_pid_gains(loop), flow_max_um_per_s, memory.integrator)
        self._feedforward = FeedForward(loop, memory.feedforward)
        self._limiter = flow_limiter.FlowLimiter(
            flow_max_um_per_s, loop.flow_rate_limit_um_per_s2, memory.limiter
        )
        self._curve = pump_curve.PumpCurve(pump, memory.curve)
        self._probe_um = pump.probe_um
        self._drift = pump_drift.PumpDrift(
            loop_margins.DEAD_S, loop_margins.PUMP_LAG_S, memory.drift
        )
        self.may_probe = True  # not while gains are judged

    @property
    def learned(self) -> bool:
        """Whether the last tick has ended a segment of the probe."""
        return self.memory.learned

    @property
    def mean_flow_um_per_s(self) -> float:
        """The mean flow, which `step_without_reading` puts out."""
        return self._pid.integral_um_per_s

    @property
    def ramp_um(self) -> float:
        """Where the setpoint's ramp stands, without the trim; NaN before the first step."""
        return self._ramp.value_um

    @property
    def pump_known(self) -> pump_drift.PumpScale:
        """The pump against its configured curve."""
        return self._drift.known

    @property
    def pump_correction(self) -> float:
        """The scale of the curve that is in use."""
        return self._drift.correction

    @property
    def lag_um(self) -> float:
        """Present setpoint minus the last filtered reading; NaN before the first reading."""
        return self.memory.setpoint_um - self.memory.measured.value

    def start(self, displacement_um: float, flow_um_per_s: float) -> None:
        """Start at a reading: the setpoint ramps from there, the integrator stands at the flow.

        Parameters
        ----------
        displacement_um : float
            The reading of this tick.
        flow_um_per_s : float
            The pump's present flow, or the mean it is known to need.
        """
        self._forget_output()
        self.memory.limit_bias = LimitBias()
        self.memory.measured.reset(displacement_um)
        self._hold_setpoint_at(displacement_um)
        self._ramp.place(math.nan)  # placed by the first step, which has the trim
        self._pid.place(self._limiter.place(flow_um_per_s))
        self._curve.note_stop()
        self.memory.leak.skip_step()

    def step(self, given: LoopInput, dt_s: float) -> LoopOutput:
        """Run one automatic tick, on the estimate if there is one.

        Without estimate and reading, the reading counts as missing (`step_without_reading`).
        Source: docs/explanation/control.md, eq. 2; with an estimate docs/explanation/estimator.md,
        eq. 2.

        Parameters
        ----------
        given : LoopInput
            Target, trim and readings of the tick.
        dt_s : float
            Time since the last tick, above 0.
        """
        self.memory.learned = False
        if given.estimate is None and not math.isfinite(given.displacement_um):
            return self.step_without_reading(given, dt_s)
        dt_s += self.memory.kept_s
        # 1. The wanted flow: the terms of the controller, the known disturbances, the ramp's speed
        weather_um_per_s = self._feedforward.update(
            given.ambient_pressure_pa, given.air_temperature_c, dt_s
        )
        known_um_per_s = weather_um_per_s
        if given.estimate is None:
            terms, ramp_um_per_s = self._step_on_laser(given, dt_s)
        else:
            terms, ramp_um_per_s = self._step_on_estimate(given, given.estimate, dt_s)
            known_um_per_s = given.estimate.drift_um_per_s - given.estimate.leak_um_per_s
        filtered_um = self.memory.measured.value
        wanted_um_per_s = terms.sum_um_per_s + known_um_per_s + ramp_um_per_s
        # 2. The probe of the pump, at a setpoint that rests
        probing = (
            self.may_probe
            and self._probe_um > 0.0
            and abs(given.target_um - self._ramp.value_um) < _AT_TARGET_UM
        )
        probe_um_per_s = 0.0
        if probing:
            probe_um_per_s = self._drift.flow_um_per_s(self._probe_um)
        # 3. The limits, from which the integrator is back-calculated; then the pump's command
        limited_um_per_s = self._limiter.limit(wanted_um_per_s + probe_um_per_s, dt_s)
        if given.estimate is None:
            self._pid.integrate(dt_s)
        fraction = self._pump_command(limited_um_per_s, dt_s)
        # 4. What this tick shows of the pump and of the leak
        if probing and math.isfinite(given.displacement_um):
            self.memory.learned = self._drift.step(
                given.displacement_um, self._curve.flow(fraction), dt_s
            )
        else:
            self._drift.discard_segment()
        if given.estimate is None:
            self.memory.leak.update(
                self._pump_flow(fraction) - weather_um_per_s,
                given.displacement_um,
                filtered_um,
                dt_s,
            )
        else:
            self.memory.leak.add_loss(given.estimate.leak_um_per_s, filtered_um, dt_s)
            is_in_range = 0.0 <= wanted_um_per_s <= self._limiter.flow_max_um_per_s
            error_um = self.memory.shaped_um - given.estimate.um
            self.memory.limit_bias.step(error_um, not is_in_range, dt_s)
        output = self._make_output(
            terms, known_um_per_s + ramp_um_per_s, wanted_um_per_s, fraction, filtered_um
        )
        self.memory.kept_output = output
        self.memory.kept_s = 0.0
        self.memory.follows_estimate = given.estimate is not None
        return output

    def keep_output(self, given: LoopInput, dt_s: float) -> LoopOutput:
        """Run one tick whose reading is that of an earlier one: the output stays.

        A sensor slower than the loop gives such readings. The next `step` covers the time since the
        last one, so the loop runs at the sensor's rate.

        Parameters
        ----------
        given, dt_s
            As of `step`.
        """
        memory = self.memory
        if memory.kept_output is None:
            return self.step_without_reading(given, dt_s)
        memory.learned = False
        memory.kept_s += dt_s
        return memory.kept_output

    def _forget_output(self) -> None:
        self.memory.kept_output = None
        self.memory.kept_s = 0.0
        self.memory.aim_offset_um = 0.0

    def _step_on_laser(self, given: LoopInput, dt_s: float) -> tuple[pid.PidTerms, float]:
        """PI(D) on the filtered reading: its terms, and the ramp's own speed."""
        before_um = self.memory.measured.value
        filtered_um = self._filter_reading(given.displacement_um, dt_s)
        shaped_um, ramp_um_per_s = self._shape_setpoint(given, filtered_um, dt_s)
        matched_um = self.memory.matched.update(shaped_um, dt_s, self._loop.measurement_filter_s)
        error_um = matched_um - filtered_um
        rate_um_per_s = 0.0
        if not math.isnan(before_um):
            rate_um_per_s = (filtered_um - before_um) / dt_s
        return self._pid.terms(error_um, rate_um_per_s), ramp_um_per_s

    def _step_on_estimate(
        self, given: LoopInput, estimate: CentreEstimate, dt_s: float
    ) -> tuple[pid.PidTerms, float]:
        """P on the centre that the gas in transit leads to, and the ramp's own speed; the leak is
        the integrator.

        The prediction takes dead time and lag out of the loop, and the filter, whose model contains
        the flow after its limits, cannot wind up. Everything that `_step_on_laser` needs follows,
        so that either may take over at any tick.
        """
        # What the laser's loop would need to take over: reading, matched setpoint, integrator
        self.memory.measured.reset(estimate.um)
        shaped_um, ramp_um_per_s = self._shape_setpoint(given, estimate.um, dt_s)
        self.memory.matched.reset(shaped_um)
        self._pid.place(estimate.leak_um_per_s)
        # Equation 2: the error of the centre after all gas in transit has arrived, and the flow
        # that is due at the end of the dead time
        aim_um = shaped_um + self.memory.limit_bias.offset_um
        p_um_per_s = (
            self._error_gain_per_s * (aim_um - estimate.ahead_um)
            + self._due_gain * estimate.due_um_per_s
        )
        known_um_per_s = estimate.drift_um_per_s + ramp_um_per_s
        p_um_per_s += self._smooth_hand_over(p_um_per_s + known_um_per_s, dt_s)
        terms = pid.PidTerms(p_um_per_s, self._pid.integral_um_per_s, 0.0)
        return terms, ramp_um_per_s

    def _smooth_hand_over(self, wanted_um_per_s: float, dt_s: float) -> float:
        """The flow to add so that a hand-over from the laser's loop does not step the flow.

        The loop on the estimate would remove the error that the laser's loop left within a tenth of
        a second. It aims first at the centre to which the present flow leads, and from there moves
        to the setpoint.
        """
        memory = self.memory
        if memory.kept_output is not None and not memory.follows_estimate:
            step_um_per_s = wanted_um_per_s - self._limiter.flow_um_per_s
            memory.aim_offset_um = -step_um_per_s / self._error_gain_per_s
        else:
            memory.aim_offset_um *= 1.0 - filters.lag_step_fraction(dt_s, _HAND_OVER_S)
        return self._error_gain_per_s * memory.aim_offset_um

    def step_without_reading(self, given: LoopInput, dt_s: float) -> LoopOutput:
        """Run one tick without control: the integrator is frozen and put out, for it is the
        mean flow.

        Repeating the last reading instead would integrate its error: 5 times the excursion
        (docs/explanation/physics.md). A reading that is there (a pause) is filtered nevertheless,
        so that the error is the present one.

        Parameters
        ----------
        given, dt_s
            As of `step`.
        """
        self._forget_output()
        seen = math.isfinite(given.displacement_um)
        filtered_um = math.nan
        if seen:
            filtered_um = self._filter_reading(given.displacement_um, dt_s)
        # The ramp waits where it stands, and the weather's rates decay as without sensors
        if not math.isnan(self._ramp.value_um):
            self.memory.setpoint_um = self._ramp.value_um + given.trim_um
        self._feedforward.update(math.nan, math.nan, dt_s)
        self.memory.leak.skip_step()
        self._discard_learned()
        mean_um_per_s = self._pid.integral_um_per_s
        self._limiter.limit(mean_um_per_s, dt_s)
        fraction = self._pump_command(self._limiter.flow_um_per_s, dt_s)
        return self._make_output(
            pid.PidTerms(0.0, mean_um_per_s, 0.0), 0.0, mean_um_per_s, fraction, filtered_um
        )

    def follow_flow(self, given: LoopInput, flow_um_per_s: float, dt_s: float) -> LoopOutput:
        """Run one tick with an external flow (manual, tuning, ramp-down), within the pump's range.

        The setpoint stands at the last finite reading and the integrator at the flow, so that
        `step` continues from there.

        Parameters
        ----------
        given, dt_s
            As of `step`; the target is not used.
        flow_um_per_s : float
            The external flow.
        """
        self._forget_output()
        # 1. The filter runs on, and the setpoint stands at its output: a later `step` has no jump
        seen = math.isfinite(given.displacement_um)
        if seen:
            self._filter_reading(given.displacement_um, dt_s)
        if not math.isnan(self.memory.measured.value):
            self._hold_setpoint_at(self.memory.measured.value)
            self._ramp.place(self.memory.measured.value - given.trim_um)
        # 2. The flow within the pump's range; the integrator holds what is not for the weather
        weather_um_per_s = self._feedforward.update(
            given.ambient_pressure_pa, given.air_temperature_c, dt_s
        )
        placed_um_per_s = self._limiter.place(flow_um_per_s)
        self._pid.place(placed_um_per_s - weather_um_per_s)
        self._discard_learned()
        fraction = self._pump_command(placed_um_per_s, dt_s)
        # 3. The leak is learned from the pump's flow and the motion
        if seen:
            pumped_um_per_s = self._pump_flow(fraction) - weather_um_per_s
            self.memory.leak.update(
                pumped_um_per_s, given.displacement_um, self.memory.measured.value, dt_s
            )
        else:
            self.memory.leak.skip_step()
        terms = pid.PidTerms(0.0, self._pid.integral_um_per_s, 0.0)
        filtered_um = self.memory.measured.value if seen else math.nan
        return replace(
            self._make_output(terms, weather_um_per_s, flow_um_per_s, fraction, filtered_um),
            error_um=math.nan,
        )

    def resume_at_mean(self, given: LoopInput, mean_um_per_s: float, dt_s: float) -> LoopOutput:
        """Run `follow_flow` with the flow that holds the mirror on average.

        The feed-forward of the weather is added to it. If the weather's present share were taken
        out of the mean, as `follow_flow` does for a flow that a person has set, the integrator
        would be wrong by the present gust.

        Parameters
        ----------
        given, dt_s
            As of `step`.
        mean_um_per_s : float
            The mean flow.
        """
        output = self.follow_flow(given, mean_um_per_s, dt_s)
        self._pid.place(self._limiter.flow_um_per_s)
        return output

    def follow_raw(self, given: LoopInput, fraction: float, dt_s: float) -> LoopOutput:
        """Run `follow_flow` with a raw pump command, which is output unchanged.

        Whether the pump runs is unknown.

        Parameters
        ----------
        given, dt_s
            As of `step`.
        fraction : float
            Command of the pump, 0..1.
        """
        flow_um_per_s = self._pump_flow(fraction)
        output = self.follow_flow(given, flow_um_per_s, dt_s)
        self._curve.note_stop()
        self.memory.leak.skip_step()
        output = replace(output, feedforward_um_per_s=0.0, leak_um_per_s=math.nan)
        return replace(output, flow_um_per_s=self._pump_flow(fraction), pump_fraction=fraction)

    def follow_pump(self, given: LoopInput, fraction: float, dt_s: float) -> LoopOutput:
        """Run `follow_flow` behind a pump that another controller drives.

        Parameters
        ----------
        given, dt_s
            As of `step`.
        fraction : float
            The pump's read-back, 0..1.
        """
        return self.follow_flow(given, self._pump_flow(fraction), dt_s)

    def set_gains(self, loop: LoopConfig) -> None:
        """Take new settings without a bump in the flow."""
        flow_max_um_per_s = min(loop.flow_max_um_per_s, self._flow_full_um_per_s)
        self._loop = loop
        self._ramp.rate_um_per_s = loop.setpoint_ramp_um_per_s
        self._ramp.flow_max_um_per_s = flow_max_um_per_s
        self._weight.weight = loop.setpoint_weight
        self._weight.ti_s = loop.ti_s
        self._weight.reset(self.memory.shaped_um)
        self._limiter.flow_max_um_per_s = self._pid.flow_max_um_per_s = flow_max_um_per_s
        self._limiter.rate_um_per_s2 = loop.flow_rate_limit_um_per_s2
        self._feedforward.set_gains(loop)
        self._pid.set_gains(_make_pid_gains(loop))

    def set_pump_lag(self, estimator: EstimatorConfig) -> None:
        """Take the gains of the loop on the estimate from other settings."""
        self._error_gain_per_s, self._due_gain = _place_poles(estimator, 1 / self._loop.rate_hz)

    def _filter_reading(self, displacement_um: float, dt_s: float) -> float:
        return self.memory.measured.update(displacement_um, dt_s, self._loop.measurement_filter_s)

    def _pump_command(self, flow_um_per_s: float, dt_s: float) -> float:
        """Command for a flow, with what was learned of the pump."""
        return self._curve.command(flow_um_per_s / self._drift.correction, dt_s)

    def _pump_flow(self, fraction: float) -> float:
        return self._drift.correction * self._curve.flow(fraction)

    def _discard_learned(self) -> None:
        self.memory.learned = False
        self._drift.discard_segment()

    def set_pump(self, pump: PumpConfig) -> None:
        """Take another curve of the pump; the mean command stays, and the mean flow becomes the
        flow that the new curve has there.
        """
        # The command that held the mirror is known for certain, the flow only by the old curve
        mean_fraction = self._curve.fraction(self._pid.integral_um_per_s / self._drift.correction)
        self._flow_full_um_per_s = pump.flow_full_um_per_s
        self._probe_um = pump.probe_um
        self.memory.curve = pump_curve.PumpCurveState()
        self._curve = pump_curve.PumpCurve(pump, self.memory.curve)
        self.memory.drift = pump_drift.PumpDriftState()
        self._drift = pump_drift.PumpDrift(
            loop_margins.DEAD_S, loop_margins.PUMP_LAG_S, self.memory.drift
        )
        self.set_gains(self._loop)
        self._pid.place(self._limiter.place(self._curve.flow(mean_fraction)))
        self.memory.leak.skip_step()

    def _hold_setpoint_at(self, setpoint_um: float) -> None:
        """Set everything that follows the setpoint to this value."""
        self.memory.setpoint_um = setpoint_um
        self.memory.shaped_um = setpoint_um
        self._weight.reset(setpoint_um)
        self.memory.matched.reset(setpoint_um)

    def _shape_setpoint(
        self, given: LoopInput, filtered_um: float, dt_s: float
    ) -> tuple[float, float]:
        """Advance the setpoint; return it as the loop sees it, and its speed in µm/s."""
        # First tick: the setpoint begins at the reading, and the ramp below it by the trim
        if math.isnan(self.memory.setpoint_um):
            self._hold_setpoint_at(filtered_um)
        if math.isnan(self._ramp.value_um):
            self._ramp.place(self.memory.setpoint_um - given.trim_um)
        base_um = self._ramp.advance(given.target_um, self._pid.integral_um_per_s, dt_s)
        self.memory.setpoint_um = base_um + given.trim_um
        shaped_um = self._weight.update(self.memory.setpoint_um, dt_s)
        # An integrating mirror follows a ramp with a flow equal to the ramp's speed. Bounded, as it
        # includes the trim's steps.
        limit_um_per_s = self._loop.setpoint_ramp_um_per_s
        speed_um_per_s = min(
            max((shaped_um - self.memory.shaped_um) / dt_s, -limit_um_per_s), limit_um_per_s
        )
        self.memory.shaped_um = shaped_um
        return shaped_um, speed_um_per_s

    def _make_output(
        self,
        terms: pid.PidTerms,
        feedforward: float,
        wanted: float,
        fraction: float,
        filtered_um: float,
    ) -> LoopOutput:
        """Return the outputs of the tick; flows in µm/s."""
        return LoopOutput(
            setpoint_um=self.memory.setpoint_um,
            filtered_um=filtered_um,
            error_um=self.memory.setpoint_um - filtered_um,
            p_um_per_s=terms.p_um_per_s,
            i_um_per_s=terms.i_um_per_s,
            d_um_per_s=terms.d_um_per_s,
            feedforward_um_per_s=feedforward,
            flow_wanted_um_per_s=wanted,
            flow_um_per_s=self._pump_flow(fraction),
            pump_fraction=fraction,
            saturated=not 0.0 <= wanted <= self._limiter.flow_max_um_per_s,
            leak_um_per_s=self.memory.leak.leak_um_per_s,
            too_tight=self.memory.leak.too_tight,
        )


def _place_poles(estimator: EstimatorConfig, tick_s: float) -> tuple[float, float]:
    """Return the gains of the loop on the estimate, in 1/s and without unit.

    They stand before the predicted error and before the flow that is due at the end of the dead
    time (docs/explanation/estimator.md, eq. 2: p_1 p_2 L and (1 - p_1 L) (1 - p_2 L)).

    Parameters
    ----------
    estimator : EstimatorConfig
        Its wanted pole, 1/s, and the lag L of the pump, s.
    tick_s : float
        Between two ticks; (1 - exp(-p h)) / h stands for a pole p in ticks of h.
    """
    lag_s = estimator.pump_lag_s
    # The loop's own pole; a faster one would drive a slow pump from limit to limit
    own_s = max(1 / estimator.gain_per_s, lag_s / 3)
    slow_per_s = filters.lag_step_fraction(tick_s, own_s) / tick_s
    # The pump's pole, or the loop's own if that is faster
    fast_per_s = filters.lag_step_fraction(tick_s, min(own_s, lag_s)) / tick_s
    if lag_s > 0:
        error_gain_per_s = lag_s * slow_per_s * fast_per_s
    else:
        error_gain_per_s = slow_per_s
    return error_gain_per_s, (1 - lag_s * slow_per_s) * (1 - lag_s * fast_per_s)


def _make_pid_gains(loop: LoopConfig) -> pid.PidGains:
    return pid.PidGains(loop.kp_per_s, loop.ti_s, loop.td_s)
