"""The first step of a session: relay until the gain is known, doublets until the dead time is,
within bounds.
"""

from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np

from membrane_ctrl.control.experiments import operating_point
from membrane_ctrl.control.experiments.experiment import ExperimentEnd, Finished
from membrane_ctrl.control.experiments.spec import ExperimentKind, ExperimentSpec
from tuning.identification.disturbance import SLOWEST_S
from tuning.identification.identify import (
    Identified,
    identify,
    independence,
    prediction_errors,
    two_gains,
    whiteness,
)
from tuning.identification.loop_model import Record

MAP_THE_PUMP = "run `tune pump`"
_FURTHER = "repeat `tune characterise` with a larger --limit-um"

# Whether the data support a proposal; if not, the problem and the experiment that would help.

_LOST_MAX = 0.01
# an error of k beyond +-20 % (2 sigma) changes Ms and variance by more than designs differ
_GAIN_SIGMA_MAX = 0.10
_GAIN_SIGMA_GOOD = 0.03
_DELAY_SIGMA_MAX_S = 0.1
# or of the delay: the loop is as slow as its delay is long, and as tolerant
_DELAY_SIGMA_SHARE = 0.1
_UNANSWERED = 5.0  # k below this many standard errors: the pump's effect is lost in the weather
_JUMP_SIGMAS = 8.0  # of 10^4 residuals none is beyond 5
_P_MIN = 1e-4
# sound benches show up to 2.7 in 192 sessions, pumps that saturate at 0.6 of the command 9
_BENT_SIGMAS = 5.0
_BENT_SHARE = 0.2  # of k; the margins tolerate less
_STRONG = 1.5  # k of a pump whose least flow may be more than the leak: it swings with any gains
_WORSE_MAX = 1.5  # innovation on new data relative to the fit
_TOO_STRONG, _CERTAIN_SIGMAS = 1.25, 3.0  # k of a pump that stopped its relays


@dataclass(frozen=True, slots=True)
class FitQuality:
    """Verdict on data and fit."""

    # "ok"; "degraded": usable, the uncertainty is larger than it should be; "refused": no proposal
    verdict: Literal["ok", "degraded", "refused"]
    reasons: tuple[str, ...]  # the findings, each with a remedy
    pump_suspected: bool = False  # by one of them: the pump may not match its configured curve

    @property
    def pump_unknown(self) -> bool:
        """Refused because the pump does not match its configured curve."""
        return self.verdict == "refused" and self.pump_suspected


@dataclass(frozen=True, slots=True)
class FitFinding:
    """A problem of a record or its fit, with a remedy."""

    text: str
    pump_suspected: bool = False  # the remedy is to map the pump


def _suspect_pump(problem: str) -> FitFinding:
    return FitFinding(f"{problem}: {MAP_THE_PUMP}", pump_suspected=True)


@dataclass(frozen=True, slots=True)
class Validation:
    """A fit tested on data not used for it."""

    innovation_ratio: float  # one-step prediction error relative to the fit
    whiteness_p: float  # as in `Identified`
    independence_p: float


def validate(identified: Identified, fresh: Record, settle_s: float = 2.0) -> Validation:
    """Predict a fresh record with a fitted model, without the noise filter's start-up."""
    errors = prediction_errors(
        fresh,
        identified.model,
        identified.noise,
        identified.pressure_gain_um_per_pa if fresh.has_barometer else 0.0,
    )[round(settle_s / fresh.dt_s) :]
    change = np.diff(fresh.flow_um_per_s)[-errors.size :]
    return Validation(
        float(errors.std() / identified.innovation_um),
        whiteness(errors),
        independence(errors, change),
    )


def judge(
    record: Record, identified: Identified, validation: Validation | None = None
) -> FitQuality:
    """Verdict on a record and its fit."""
    refused, degraded = _faults(record, identified)
    if validation is not None and validation.innovation_ratio > _WORSE_MAX:
        worse = (
            f"new data are predicted {validation.innovation_ratio:.1f} times worse than those of "
            "the fit"
        )
        degraded.append(
            FitFinding(
                f"{worse}: the bench changed in between; repeat the relay in steadier weather"
            )
        )
    if validation is not None and validation.independence_p < _P_MIN:
        degraded.append(
            FitFinding("new residuals still follow the flow: repeat with the doublets experiment")
        )
    verdict: Literal["ok", "degraded", "refused"] = (
        "refused" if refused else "degraded" if degraded else "ok"
    )
    findings = (*refused, *degraded)
    texts = tuple(finding.text for finding in findings)
    return FitQuality(verdict, texts, any(finding.pump_suspected for finding in findings))


def _faults(record: Record, identified: Identified) -> tuple[list[FitFinding], list[FitFinding]]:
    """Findings that forbid a proposal, and those that only widen its error bars."""
    model, sigma = identified.model, identified.sigma
    refused: list[FitFinding] = []
    degraded: list[FitFinding] = []
    if record.lost_fraction > _LOST_MAX:
        lost = f"{record.lost_fraction:.0%} of the readings were lost"
        refused.append(FitFinding(f"{lost}: check the laser (without one, the camera), repeat"))
    if model.gain < _UNANSWERED * sigma.gain:
        known = f"k = {model.gain:.2f} +- {sigma.gain:.2f}"
        refused.append(_suspect_pump(f"the mirror did not answer the pump ({known})"))
        return refused, degraded
    if identified.largest_residual > _JUMP_SIGMAS:
        at_s = float(np.argmax(np.abs(identified.residual_um))) * record.dt_s
        refused.append(FitFinding(f"the mirror jumped at {at_s:.1f} s (a door?): repeat the relay"))
    if sigma.gain > _GAIN_SIGMA_MAX * model.gain:
        refused.append(FitFinding(f"k is known to {sigma.gain / model.gain:.0%} only: {_FURTHER}"))
    elif sigma.gain > _GAIN_SIGMA_GOOD * model.gain:
        degraded.append(
            FitFinding(
                f"k is known to {sigma.gain / model.gain:.0%}: a longer relay would make it 3 %"
            )
        )
    if sigma.delay_s > max(_DELAY_SIGMA_MAX_S, _DELAY_SIGMA_SHARE * model.delay_s):
        refused.append(FitFinding(f"the delay is known to {sigma.delay_s:.2f} s only: {_FURTHER}"))
    refused.extend(bent(record, identified))
    if identified.independence_p < _P_MIN:
        degraded.append(
            _suspect_pump("the residuals follow the flow (a saturating or sticking pump?)")
        )
    if identified.whiteness_p < _P_MIN and model.gain > _STRONG:
        coloured = f"k = {model.gain:.2f}, and the residuals are coloured (a sticking pump?)"
        refused.append(_suspect_pump(coloured))
    elif identified.whiteness_p < _P_MIN:
        periodic = (
            "something periodic moves the mirror or the reading, or the weather is no random walk"
        )
        degraded.append(FitFinding(f"the residuals are coloured: {periodic}"))
    return refused, degraded


def bent(record: Record, identified: Identified) -> list[FitFinding]:
    """The problem, if one gain does not describe both halves of the pump's range."""
    found = two_gains(record, identified)
    least = max(_BENT_SIGMAS * found.difference_sigma, _BENT_SHARE * identified.model.gain)
    if abs(found.above - found.below) < least:
        return []
    what = "the pump saturates" if found.above < found.below else "the pump stalls at small flows"
    gains = f"k = {found.below:.2f} below the holding flow and {found.above:.2f} above"
    return [_suspect_pump(f"{what} ({gains})")]


_GAIN_SIGMA = 0.025  # k within 5 % at 2 sigma
_DEAD_TIME_SIGMA_S = 0.025  # within 0.05 s at 2 sigma
_BETWEEN_S = 15.0
_VALIDATE_LEAST_S = 10.0
_LESS = 1.5  # by which pulses are smaller after some that were stopped


@dataclass(frozen=True, slots=True)
class Plan:
    """How long the parts of the experiments last, and how often they are repeated at most."""

    settle_s: float = 20.0
    quiet_s: float = 40.0
    relay_s: float = 120.0
    relays: int = 4
    doublets_s: float = 60.0
    doublets: int = 4

    @property
    def typical_s(self) -> float:
        """With one relay and one round of doublets, enough for most benches."""
        return self.settle_s + self.quiet_s + self.relay_s + self.doublets_s + 2 * _BETWEEN_S


FULL = Plan()
# Five minutes; its quiet hold is long enough to know the weather from
SHORT = Plan(
    settle_s=0.0, quiet_s=2.0 * SLOWEST_S + 1.0, relay_s=45.0, relays=2, doublets_s=24.0, doublets=1
)


class ExperimentRig(Protocol):
    """The rig needed for characterising: `rig.Rig` on a bench,
    or `rig.HoldRig` on a running hold.
    """

    def hold(self, duration_s: float) -> Record:
        """Hold for a time."""
        ...

    def around(self, held: Record, limit_um: float) -> operating_point.Around:
        """Operating point of an experiment."""
        ...

    def perform(self, spec: ExperimentSpec) -> tuple[Record, Finished]:
        """Run an experiment."""
        ...


@dataclass(frozen=True, slots=True)
class Experiments:
    """Raw results of the experiments."""

    around: operating_point.Around  # holding flow, laser noise, limits
    record: Record  # relays, the holds between, doublets, without a gap
    relays_s: float  # duration of the relays with the holds after them
    pulses_s: tuple[float, float]  # start and end of the longest doublets
    finished: Finished  # how the last relay ended
    held: Record | None = None  # the hold before them; None if read from a file


@dataclass(frozen=True, slots=True)
class Characterised:
    """Fit and verdict of the experiments."""

    experiments: Experiments
    identified: Identified  # fit to the whole record
    quality: FitQuality  # verdict; the doublets are predicted with a fit to the relays alone


class ExperimentError(Exception):
    """No relay could be completed; the message is the last one's reason.

    `pump_suspected`: the pump may not match its configured curve.
    """

    def __init__(self, reason: str, pump_suspected: bool = False) -> None:
        super().__init__(reason)
        self.pump_suspected = pump_suspected


def spec_of(
    kind: ExperimentKind, around: operating_point.Around, duration_s: float, gain: float = 1.0
) -> ExperimentSpec:
    """The specification of an experiment at an operating point. Raises pydantic.ValidationError out
    of bounds.
    """
    return ExperimentSpec(
        kind=kind,
        duration_s=duration_s,
        limit_um=around.limit_um,
        holding_flow_um_per_s=around.holding_flow_um_per_s,
        laser_um=around.laser_um,
        gain=gain,
        late_s=round(around.late_s, 2),
    )


def characterise(rig: ExperimentRig, limit_um: float = 10.0) -> Characterised:
    """Run the experiments and fit them; raises like `experiment`."""
    return fitted(experiment(rig, limit_um))


def experiment(rig: ExperimentRig, limit_um: float = 10.0, plan: Plan = FULL) -> Experiments:
    """Hold, relay and doublets on a rig that holds its mirror.

    What was stopped is kept, and repeated while too little is known; `judge` sees a jump that
    stopped it.

    Raises ExperimentError if the relays were stopped before they lasted as long as one; ValueError
    if the pump has no room about the holding flow: the mirror is too tight or too leaky.
    """
    if plan.settle_s:
        rig.hold(plan.settle_s)
    held = rig.hold(plan.quiet_s)
    around = rig.around(held, limit_um)
    operating_point.room(around)  # without room a relay would only report that it was stopped
    relays, finished = _relays(rig, around, plan)
    found = identify(relays)
    around, gain = replace(around, late_s=found.model.delay_s), found.model.gain
    whole = relays
    longest_s = (relays.duration_s, relays.duration_s)
    for _ in range(0 if bent(relays, found) else plan.doublets):
        latest, ended = rig.perform(spec_of("doublets", around, plan.doublets_s, gain))
        gain *= 1.0 if ended.completed else _LESS
        if latest.duration_s > longest_s[1] - longest_s[0]:
            longest_s = (whole.duration_s, whole.duration_s + latest.duration_s)
        whole = whole.followed_by(latest, rig.hold(_BETWEEN_S))
        if identify(whole).sigma.dead_time_s <= _DEAD_TIME_SIGMA_S:
            break
    return Experiments(around, whole, relays.duration_s, longest_s, finished, held)


def fitted(done: Experiments) -> Characterised:
    """Fit all experiments; judge by the doublets, which a fit to the relays alone must predict."""
    found = identify(done.record)
    start_s, stop_s = done.pulses_s
    checked = None
    if stop_s - start_s > _VALIDATE_LEAST_S:
        relays = done.record.part(0.0, done.relays_s)
        checked = validate(identify(relays), done.record.part(start_s, stop_s))
    return Characterised(done, found, judge(done.record, found, checked))


def _relays(
    rig: ExperimentRig, around: operating_point.Around, plan: Plan
) -> tuple[Record, Finished]:
    """Relays until the gain is known, or the data ask for the pump's map, each followed by a hold.

    One that the guard stopped tells as much of its time as another, unless the mirror jumped: gusts
    and a laser's noise stop sound experiments, too.
    """
    done: Record | None = None
    finished = Finished(ExperimentEnd.INTERRUPTED, "")
    for _ in range(plan.relays):
        relay, finished = rig.perform(spec_of("relay", around, plan.relay_s))
        relay = relay.followed_by(rig.hold(_BETWEEN_S))
        done = relay if done is None else done.followed_by(relay)
        if finished.end is ExperimentEnd.NO_RESPONSE:
            otherwise = f"{finished.reason}; if that is not the cause, {MAP_THE_PUMP}"
            raise ExperimentError(otherwise, pump_suspected=True)
        try:
            found = identify(done)
        except ValueError:  # too short to tell
            continue
        if not finished.completed and found.largest_residual > _JUMP_SIGMAS:
            done = None
            continue
        if not finished.completed and _too_strong(found):
            raise ExperimentError(f"{finished.reason}: {MAP_THE_PUMP}", pump_suspected=True)
        around = replace(around, late_s=found.model.delay_s)
        if _enough(done, plan) and (
            found.sigma.gain <= _GAIN_SIGMA * found.model.gain or bent(done, found)
        ):
            break
    if done is None or not _enough(done, plan):
        stopped_near = finished.end is ExperimentEnd.STOPPED_BY_GUARD
        raise ExperimentError(finished.reason + (f": {_FURTHER}" if stopped_near else ""))
    return done, finished


def _enough(relays: Record, plan: Plan) -> bool:
    return relays.duration_s >= plan.relay_s


def _too_strong(found: Identified) -> bool:
    """Whether the pump stopped these relays, and not the weather:
    the next one would end like them.
    """
    return found.model.gain - _CERTAIN_SIGMAS * found.sigma.gain > _TOO_STRONG
