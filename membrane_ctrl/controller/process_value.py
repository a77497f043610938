"""Decides what the inner loop follows with `process_value = "auto"`: laser or estimate. Pure.

The estimate needs the pump's dead time and lag, and a second sensor of the centre or of the
weather. While it holds the mirror, it is judged in two ways: by what the PI on the laser would have
done (`control/predicted_pi.py`), and by its errors, which are uncorrelated if the pump responds as
assumed (`control/error_correlation.py`). If either contradicts it, the PI is tried for a minute
and a half. If the PI is better, it stays for a time that doubles with each such case. Either loop
takes over without a bump (`control/inner_loop.py`).

All protections are those of the estimate: the estimate runs all the time, and where the optics must
replace the laser, it holds the mirror at once.
"""

import math
from dataclasses import dataclass, field

from membrane_ctrl.config.control import EstimatorConfig, LoopConfig, PumpConfig
from membrane_ctrl.control.centre_estimate import CentreEstimate, Sensor
from membrane_ctrl.control.error_correlation import ErrorCorrelation, ErrorCorrelationState
from membrane_ctrl.control.filters import LowPass
from membrane_ctrl.control.innovation_test import InnovationTest, InnovationTestState
from membrane_ctrl.control.loop_comparison import (
    LoopComparison,
    LoopComparisonState,
    LoopErrors,
    MeanSquare,
)
from membrane_ctrl.control.predicted_pi import PredictedPi, PredictedPiState
from membrane_ctrl.controller.process_value_reason import ProcessValueReason
from membrane_ctrl.model.events import Event, Maintenance, MaintenanceOver, ProcessValueChosen
from membrane_ctrl.model.state_tree import Count, StateNode

NOTICE = "estimate_worse"
_FIRST_S = 0.5
# Sensors that come and go must not exchange the loops again and again: another choice, or another
# reason, waits so long. The wait doubles with each loss of a sensor, and is short again after an
# hour without one.
_AGAIN_S = 10.0
_AGAIN_MOST_S = 600.0
_CALM_S = 3600.0
# The estimate may be held by the laser alone for so long: a barometer's or a camera's short gap.
_ALONE_S = 5.0
# The laser contradicts the estimate beyond so many standard deviations (`control/centre.py`).
_CONTRADICTS_SIGMAS = 5.0
# The prediction starts from the estimate's steadier hold; so many integral times later it is the
# PI's own.
_WARM_UP_S = 10.0
_WARM_UP_INTEGRAL_TIMES = 2.0
# The PI is tried if it would be better by so many standard deviations, and by this share of the
# variance; or if errors are correlated by this much.
_WORSE_SIGMAS = 2.0
_WORSE_SHARE = 1.05
_CORRELATED = 0.33
# An identified response that the prediction favours by so many standard deviations is doubted
# only beyond a larger correlation: figures show that of the weather as well.
_CORRELATED_IDENTIFIED = 0.5
_BETTER_SIGMAS = 2.0
# After a trial the PI stays unless it is worse by so many standard deviations: what began the trial
# favours it. If the laser's noise hides a difference of so many, the camera decides.
_TRIAL_SPANS = 12
_RETURNS_SIGMAS = 1.0
_HIDDEN_SIGMAS = 2.0
_FALL_BACK_S = 600.0
_FALL_BACK_MOST_S = 6 * 3600.0
_DOUBLINGS_MOST = 10
# A door moves the film under any loop. For so long after the last jump of a sensor, the errors show
# nothing of the loops: a pump that gives little more than the leak takes that long to return.
_PASSING_S = 20.0
# Memory of the mean that shows whether laser and camera move apart
_APART_S = 60.0
_BY_ESTIMATE = (ProcessValueReason.RESPONSE_KNOWN, ProcessValueReason.LASER_UNUSABLE)
# Reasons that a lost sensor gives
_BY_SENSORS = (ProcessValueReason.LASER_ALONE, ProcessValueReason.LASER_UNUSABLE)


@dataclass(frozen=True, slots=True)
class ProcessValueFacts:
    """What decides in a tick.

    Attributes
    ----------
    now_s, dt_s : float
    estimate : CentreEstimate or None
        None in a state that holds no estimate.
    held_by_optics : bool
        The optics alone could hold the mirror.
    response_known : bool
        Dead time and lag of the pump are known.
    on_trial : bool
        Gains of the PI are on trial.
    laser_um : float
        Its reading; NaN without a new and moving one.
    repeats_sample : bool
        The reading is that of an earlier tick.
    laser_doubted : bool
        Optics and gauge contradict the laser.
    steady : bool
        The mirror is held at a setpoint that rests.
    setpoint_um, flow_um_per_s : float
        Of the last tick.
    weather : tuple of float
        Ambient pressure in Pa and air temperature in °C.
    """

    now_s: float
    dt_s: float
    estimate: CentreEstimate | None
    held_by_optics: bool
    response_known: bool
    on_trial: bool
    laser_um: float
    repeats_sample: bool
    laser_doubted: bool
    steady: bool
    setpoint_um: float
    flow_um_per_s: float
    weather: tuple[float, float]


@dataclass(slots=True)
class ProcessValueState(StateNode):
    """What the decision remembers from tick to tick.

    Attributes
    ----------
    follows_estimate : bool
        As decided; a laser that cannot be used overrules it.
    reason_name : str
        Name of the reported reason; empty before the first.
    wanted_since_s : float
        Since when another loop is wanted.
    again_s : float
        How long another choice is wanted before it is taken, if sensors come and go.
    sensor_lost_s : float
        When a sensor's loss last changed the decision or its reason.
    compares_from_s : float
        When the prediction has become the PI's own.
    tries_pi : bool
        The PI is tried.
    fall_back_until_s : float
        End of the present fall-back; infinite in the past without one.
    trusted_until_s : float
        Until then the PI is not tried again.
    passing_until_s : float
        Until then the errors are those of a disturbance that passes.
    trials : int
    estimate_error, estimate_error_by_camera : MeanSquare or None
        Of the estimate's loop before the trial, by the laser and by the camera; None without one.
    mount_mean : LowPass
        Mean of the laser's mount in the last minute; NaN without a camera.
    apart_um : float
        How far the mount was from that mean when the trial began.
    """

    follows_estimate: bool = False
    reason_name: str = ""
    wanted_since_s: float = math.nan
    again_s: float = _AGAIN_S
    sensor_lost_s: float = math.nan
    compares_from_s: float = math.nan
    tries_pi: bool = False
    fall_back_until_s: float = -math.inf
    trusted_until_s: float = -math.inf
    passing_until_s: float = -math.inf
    trials: Count = 0
    estimate_error: MeanSquare | None = None
    estimate_error_by_camera: MeanSquare | None = None
    mount_mean: LowPass = field(default_factory=LowPass)
    apart_um: float = math.nan
    noticed: bool = False
    prediction: PredictedPiState = field(default_factory=PredictedPiState)
    comparison: LoopComparisonState = field(default_factory=LoopComparisonState)
    comparison_by_camera: LoopComparisonState = field(default_factory=LoopComparisonState)
    innovations: InnovationTestState = field(default_factory=InnovationTestState)
    correlation: ErrorCorrelationState = field(default_factory=ErrorCorrelationState)


class ProcessValueChoice:
    """Chooses between laser and estimate in each tick.

    Parameters
    ----------
    loop, pump, estimator
        Present gains, curve, dead time and lag.
    memory : ProcessValueState, optional
        From the snapshot of an earlier controller; else nothing is known of the loops.
    """

    def __init__(
        self,
        loop: LoopConfig,
        pump: PumpConfig,
        estimator: EstimatorConfig,
        memory: ProcessValueState | None = None,
    ) -> None:
        self.memory = memory or ProcessValueState()
        self._comparison = LoopComparison(self.memory.comparison)
        self._comparison_by_camera = LoopComparison(self.memory.comparison_by_camera)
        self._innovations = InnovationTest(self.memory.innovations)
        self._loop = loop
        self._pump = pump
        self._estimator = estimator
        self._prediction = PredictedPi(loop, pump, estimator, self.memory.prediction)
        self._correlation = ErrorCorrelation(loop, estimator, self.memory.correlation)

    def set_loop(self, loop: LoopConfig, pump: PumpConfig, estimator: EstimatorConfig) -> None:
        """Predict and compare with other settings, from the beginning.

        Parameters
        ----------
        loop, pump, estimator
            The settings of the two loops that are compared.
        """
        self._loop = loop
        self._pump = pump
        self._estimator = estimator
        # The gas in transit is of the former dead time
        self.memory.prediction.start_afresh()
        self._prediction = PredictedPi(loop, pump, estimator, self.memory.prediction)
        self._correlation = ErrorCorrelation(loop, estimator, self.memory.correlation)
        self._correlation.reset()
        self._stop_comparing()

    def forget_verdict(self) -> None:
        """The pump's response was identified again: the estimate is to be judged again."""
        memory = self.memory
        memory.tries_pi = False
        memory.fall_back_until_s = memory.trusted_until_s = -math.inf
        memory.trials = 0

    def step(self, facts: ProcessValueFacts) -> tuple[CentreEstimate | None, list[Event]]:
        """One tick.

        Returns
        -------
        CentreEstimate or None
            What the loop follows; None: the laser.
        list of Event
            The decision if it is another one, and notices.
        """
        memory, estimate = self.memory, facts.estimate
        if estimate is None:
            memory.wanted_since_s = math.nan
            self._stop_comparing()
            return None, []
        events = self._judge_estimate(facts, estimate)
        wanted = self._find_reason(facts, estimate)
        events += self._decide(wanted, facts)
        overruled = facts.held_by_optics and not self._is_laser_usable(facts, estimate)
        return (estimate if memory.follows_estimate or overruled else None), events

    def _find_reason(
        self, facts: ProcessValueFacts, estimate: CentreEstimate
    ) -> ProcessValueReason:
        """What is best to follow in this tick.

        In this order: what cannot work, what is not yet known, what a person or a trial asks for,
        what the comparison of the loops has shown; else the estimate.
        """
        if facts.held_by_optics and not estimate.sensors[Sensor.LASER].fresh:
            return ProcessValueReason.LASER_UNUSABLE
        if not facts.response_known:
            return ProcessValueReason.RESPONSE_UNKNOWN
        if not (facts.held_by_optics or estimate.sensors[Sensor.BAROMETER].fresh):
            return ProcessValueReason.LASER_ALONE
        if facts.on_trial:
            return ProcessValueReason.GAINS_ON_TRIAL
        if self.memory.tries_pi:
            return ProcessValueReason.PI_TRIED
        if facts.now_s < self.memory.fall_back_until_s:
            return ProcessValueReason.ESTIMATE_WORSE
        return ProcessValueReason.RESPONSE_KNOWN

    def _decide(self, wanted: ProcessValueReason, facts: ProcessValueFacts) -> list[Event]:
        """Take another decision, at once or after it has been wanted for some time."""
        # Wanted for how long, in a row?
        memory, now_s = self.memory, facts.now_s
        by_estimate = wanted in _BY_ESTIMATE
        if wanted.name == memory.reason_name:
            memory.wanted_since_s = math.nan
            return []
        if math.isnan(memory.wanted_since_s):
            memory.wanted_since_s = now_s
        if now_s - memory.wanted_since_s < self._find_wait_s(wanted, facts):
            return []
        # Another loop: the errors so far are of the former one. A lost sensor that returns soon
        # must not switch the loops to and fro
        if by_estimate != memory.follows_estimate:
            self._stop_comparing()
        if wanted in _BY_SENSORS:
            self._lengthen_wait(now_s)
        memory.follows_estimate = by_estimate
        memory.reason_name = wanted.name
        memory.wanted_since_s = math.nan
        value = "estimate of the centre" if by_estimate else "laser"
        return [ProcessValueChosen(value, wanted.value, wanted.name.lower())]

    def _find_wait_s(self, wanted: ProcessValueReason, facts: ProcessValueFacts) -> float:
        """How long a choice must be wanted before it is taken."""
        memory = self.memory
        by_estimate = wanted in _BY_ESTIMATE
        if not memory.reason_name:
            return _FIRST_S if by_estimate else 0.0
        laser_was_lost = memory.reason_name == ProcessValueReason.LASER_UNUSABLE.name
        if by_estimate == memory.follows_estimate:
            # Only the reason is another one
            by_sensors = wanted in _BY_SENSORS or laser_was_lost
            return memory.again_s if by_sensors else 0.0
        if by_estimate:
            return memory.again_s
        if wanted is ProcessValueReason.LASER_ALONE:
            return _ALONE_S
        # A laser that has returned may go again; the optics hold the mirror
        return _AGAIN_S if laser_was_lost and facts.held_by_optics else 0.0

    def _lengthen_wait(self, now_s: float) -> None:
        """A sensor is lost: double the wait if another one was within the last hour."""
        memory = self.memory
        if now_s - memory.sensor_lost_s < _CALM_S:
            memory.again_s = min(2.0 * memory.again_s, _AGAIN_MOST_S)
        else:
            memory.again_s = _AGAIN_S
        memory.sensor_lost_s = now_s

    def _is_laser_usable(self, facts: ProcessValueFacts, estimate: CentreEstimate) -> bool:
        """Whether the PI may follow this tick's reading."""
        if facts.laser_doubted:
            return False
        read = math.isfinite(facts.laser_um) or facts.repeats_sample
        return read and abs(estimate.sensors[Sensor.LASER].innovation) <= _CONTRADICTS_SIGMAS

    def _judge_estimate(self, facts: ProcessValueFacts, estimate: CentreEstimate) -> list[Event]:
        """Compare the loops; begin or end a fall-back."""
        memory = self.memory
        # Only a steady mirror with a sound laser shows which loop is better.
        laser = estimate.sensors[Sensor.LASER]
        if not facts.steady or facts.laser_doubted or not laser.fresh:
            self._stop_comparing()
            return []
        # What is compared: innovations, sensors, and the errors of both loops.
        self._innovations.step(laser.innovation, facts.dt_s)
        apart_um = self._compare_sensors(facts, estimate)
        if estimate.jumped_sensors:
            memory.passing_until_s = facts.now_s + _PASSING_S
        passing = facts.now_s < memory.passing_until_s
        self._compare_loops(facts, passing)
        if memory.tries_pi:
            return self._end_trial(facts)
        # The PI is tried if the estimate may be the worse one.
        if memory.follows_estimate:
            if passing:
                self._correlation.skip()
            else:
                self._correlation.step(facts.setpoint_um - estimate.um, facts.dt_s)
            if memory.noticed:
                return self._end_notice("the estimate is tried again")
            errors = self._comparison.errors
            if facts.now_s < memory.trusted_until_s or errors is None:
                return []
            if self._may_be_worse(errors):
                memory.estimate_error = errors.own
                memory.estimate_error_by_camera = self._find_error_by_camera()
                memory.apart_um = apart_um
                memory.tries_pi = True
        return []

    def _compare_sensors(self, facts: ProcessValueFacts, estimate: CentreEstimate) -> float:
        """How far laser and camera moved apart in the last minute, µm; NaN without a camera."""
        mean = self.memory.mount_mean
        if not facts.held_by_optics:
            mean.reset(math.nan)
            return math.nan
        return estimate.mount_um - mean.update(estimate.mount_um, facts.dt_s, _APART_S)

    def _may_be_worse(self, errors: LoopErrors) -> bool:
        """Whether the PI may hold the mirror better than the estimate."""
        excess = errors.excess
        worse = excess.um2 > (1.0 - 1.0 / _WORSE_SHARE) * errors.own.um2
        predicted = worse and excess.um2 > _WORSE_SIGMAS * excess.sigma_um2
        better = excess.um2 < -_BETTER_SIGMAS * excess.sigma_um2
        correlated = _CORRELATED
        if better and self._estimator.pump_response == "identified":
            correlated = _CORRELATED_IDENTIFIED
        return predicted or self._correlation.largest > correlated

    def _find_error_by_camera(self) -> MeanSquare | None:
        """Error of the present loop as the camera shows it; None if it has not for long enough."""
        errors = self._comparison_by_camera.errors
        return None if errors is None else errors.own

    def _compare_loops(self, facts: ProcessValueFacts, passing: bool) -> None:
        """Add this tick's reading to the comparison, unless a disturbance passes."""
        memory = self.memory
        if passing:
            self._comparison.skip()
            self._comparison_by_camera.skip()
        error_um = facts.setpoint_um - facts.laser_um
        # Both loops need some integral times before their errors are comparable.
        if math.isnan(memory.compares_from_s):
            warm_up_s = _WARM_UP_S + _WARM_UP_INTEGRAL_TIMES * self._loop.ti_s
            memory.compares_from_s = facts.now_s + warm_up_s
        if not facts.held_by_optics:
            self._comparison_by_camera.reset()
        elif facts.now_s >= memory.compares_from_s and not passing:
            assert facts.estimate is not None  # the optics hold it
            by_camera_um = facts.setpoint_um - facts.estimate.um
            self._comparison_by_camera.step(by_camera_um, by_camera_um, facts.dt_s)
        # The PI holds the mirror: its error is measured.
        if not memory.follows_estimate:
            if facts.now_s >= memory.compares_from_s and not passing:
                self._comparison.step(error_um, error_um, facts.dt_s)
            return
        # The estimate holds it: what the PI would have done is predicted.
        if not self._prediction.runs:
            assert facts.estimate is not None  # it is followed
            self._prediction.start(
                facts.estimate.um, facts.estimate.leak_um_per_s, facts.flow_um_per_s
            )
        seen_um = self._prediction.step(
            facts.laser_um, facts.setpoint_um, facts.weather, facts.flow_um_per_s, facts.dt_s
        )
        if facts.now_s >= memory.compares_from_s and not passing:
            self._comparison.step(error_um, facts.setpoint_um - seen_um, facts.dt_s)

    def _stop_comparing(self) -> None:
        self._prediction.stop()
        self._comparison.reset()
        self._comparison_by_camera.reset()
        self.memory.compares_from_s = math.nan

    def _end_trial(self, facts: ProcessValueFacts) -> list[Event]:
        """End a trial of the PI once its errors are known: it stays if it is better."""
        memory = self.memory
        # The error of the PI, measured over some spans, against that of the estimate before
        errors, estimate_error = self._comparison.errors, memory.estimate_error
        if errors is None or estimate_error is None or self._comparison.spans < _TRIAL_SPANS:
            return []
        # Each fall-back lasts twice as long as the one before, up to a limit.
        memory.tries_pi = False
        doublings = min(memory.trials, _DOUBLINGS_MOST)
        until_s = facts.now_s + min(_FALL_BACK_S * 2.0**doublings, _FALL_BACK_MOST_S)
        memory.trials += 1
        if self._is_pi_worse(errors.own, estimate_error):
            memory.trusted_until_s = until_s
            self._correlation.reset()
            return []
        # The PI stays, and the event states why.
        memory.fall_back_until_s = until_s
        memory.noticed = True
        message = (
            f"by the laser, the centre moved by {_describe_root(estimate_error)} with the estimate "
            f"and by {_describe_root(errors.own)} with the PI; {self._explain_worse()}. "
            "The loop follows the laser"
        )
        return [Maintenance(NOTICE, message)]

    def _is_pi_worse(self, pi_error: MeanSquare, estimate_error: MeanSquare) -> bool:
        """Whether a trial is evidence against the PI: by the laser, and where that shows no clear
        difference, by the camera.
        """
        lead = _count_sigmas(pi_error, estimate_error)
        by_camera = self._find_error_by_camera()
        before_by_camera = self.memory.estimate_error_by_camera
        if abs(lead) < _HIDDEN_SIGMAS and by_camera is not None and before_by_camera is not None:
            lead = _count_sigmas(by_camera, before_by_camera)
        return lead > _RETURNS_SIGMAS

    def _explain_worse(self) -> str:
        """What errors, sensors and innovations show of the cause."""
        memory = self.memory
        error = memory.estimate_error
        if error is not None and abs(memory.apart_um) > _root_mean_square(error.um2):
            return (
                f"laser and camera moved apart by {abs(memory.apart_um):.1f} µm in the minute "
                "before: either of them may creep"
            )
        if self._correlation.largest > _CORRELATED:
            return (
                "its errors swing: it looks like another dead time, lag or curve of the pump than "
                "assumed, or like weather of one period"
            )
        return self._innovations.describe()

    def _end_notice(self, why: str) -> list[Event]:
        self.memory.noticed = False
        return [MaintenanceOver(NOTICE, why)]


def _count_sigmas(larger: MeanSquare, smaller: MeanSquare) -> float:
    """By how many standard deviations the first mean square is larger."""
    sigma_um2 = math.hypot(larger.sigma_um2, smaller.sigma_um2)
    return (larger.um2 - smaller.um2) / sigma_um2 if sigma_um2 > 0.0 else 0.0


def _root_mean_square(mean_square_um2: float) -> float:
    return math.sqrt(max(0.0, mean_square_um2))


def _describe_root(mean_square: MeanSquare) -> str:
    """A root mean square in µm; its upper limit if the laser's noise hides it."""
    margin_um2 = 2.0 * mean_square.sigma_um2
    if mean_square.um2 > margin_um2:
        return f"{_root_mean_square(mean_square.um2):.2f} µm"
    return f"less than {_root_mean_square(max(0.0, mean_square.um2) + margin_um2):.2f} µm"
