"""The experiments of a session, within bounds, and their fit.

The relay is repeated until the gain is known, the doublets until the dead time is.
"""

from dataclasses import dataclass, replace
from typing import Protocol

from membrane_ctrl.control.experiments import operating_point
from membrane_ctrl.control.experiments.experiment import ExperimentEnd, Finished
from membrane_ctrl.control.experiments.spec import ExperimentKind, ExperimentSpec
from tuning.identification.fit_quality import (
    JUMP_SIGMAS,
    LARGER_LIMIT,
    MAP_THE_PUMP,
    FitQuality,
    find_bent_curve,
    judge_fit,
    validate_fit,
)
from tuning.identification.noise_spectrum import SLOWEST_S
from tuning.identification.plant_fit import Identified, identify_plant
from tuning.identification.record import Record

# k of a pump that stopped its relays
_TOO_STRONG = 1.25
_CERTAIN_SIGMAS = 3.0
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

    def around(self, held: Record, limit_um: float) -> operating_point.OperatingPoint:
        """Operating point of an experiment.

        Parameters
        ----------
        held : Record
            A quiet hold: mean flow and noise of the laser are taken from it.
        limit_um : float
            Largest excursion of the centre from the setpoint in the experiment.
        """
        ...

    def perform(self, spec: ExperimentSpec) -> tuple[Record, Finished]:
        """Run an experiment."""
        ...


@dataclass(frozen=True, slots=True)
class Experiments:
    """Raw results of the experiments.

    Attributes
    ----------
    around : OperatingPoint
        Holding flow, laser noise, limits.
    record : Record
        Relays, the holds between, doublets, without a gap.
    relays_s : float
        Duration of the relays with the holds after them.
    pulses_s : (float, float)
        Start and end of the longest doublets.
    finished : Finished
        How the last relay ended.
    held : Record, optional
        The hold before them; None if read from a file.
    """

    around: operating_point.OperatingPoint
    record: Record
    relays_s: float
    pulses_s: tuple[float, float]
    finished: Finished
    held: Record | None = None


@dataclass(frozen=True, slots=True)
class Characterised:
    """Fit and verdict of the experiments."""

    experiments: Experiments
    identified: Identified  # fit to the whole record
    quality: FitQuality  # verdict; the doublets are predicted with a fit to the relays alone


class ExperimentError(Exception):
    """No relay could be completed.

    Parameters
    ----------
    reason : str
        Why the last one ended, for people.
    pump_suspected : bool
        The pump may not match its configured curve: the remedy is to map it.
    """

    def __init__(self, reason: str, pump_suspected: bool = False) -> None:
        super().__init__(reason)
        self.pump_suspected = pump_suspected


def make_spec(
    kind: ExperimentKind,
    around: operating_point.OperatingPoint,
    duration_s: float,
    gain: float = 1.0,
) -> ExperimentSpec:
    """The specification of an experiment at an operating point.

    Parameters
    ----------
    kind : ExperimentKind
        Which experiment.
    around : OperatingPoint
        Where the mirror is held, and how far it may move.
    duration_s : float
        Length of the experiment.
    gain : float
        Assumed gain of the plant: µm/s of motion for each µm/s of commanded flow.

    Raises
    ------
    pydantic.ValidationError
        A value is out of bounds.
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


def run_experiments(rig: ExperimentRig, limit_um: float = 10.0, plan: Plan = FULL) -> Experiments:
    """Hold, relay and doublets on a rig that holds its mirror.

    What was stopped is kept, and repeated while too little is known; `judge_fit` detects a jump
    that stopped it.

    Parameters
    ----------
    rig : ExperimentRig
        The rig.
    limit_um : float
        Excursion at which an experiment is stopped.
    plan : Plan
        How long the parts last.

    Returns
    -------
    Experiments

    Raises
    ------
    ExperimentError
        The relays were stopped before they lasted as long as one.
    ValueError
        The pump has no room about the holding flow: the mirror is too tight or too leaky.
    """
    if plan.settle_s:
        rig.hold(plan.settle_s)
    held = rig.hold(plan.quiet_s)
    around = rig.around(held, limit_um)
    # Without room a relay would only report that it was stopped.
    operating_point.require_room(around)

    # Relays for the gain; then doublets, as large as that gain allows, for the dead time. A pump
    # whose curve is bent gets none: its map comes first.
    relays, finished = _run_relays(rig, around, plan)
    found = identify_plant(relays)
    around = replace(around, late_s=found.model.delay_s)
    gain = found.model.gain
    rounds = plan.doublets
    if find_bent_curve(relays, found):
        rounds = 0
    whole = relays
    longest_s = (relays.duration_s, relays.duration_s)
    for _ in range(rounds):
        latest, ended = rig.perform(make_spec("doublets", around, plan.doublets_s, gain))
        if not ended.completed:
            gain *= _LESS
        if latest.duration_s > longest_s[1] - longest_s[0]:
            longest_s = (whole.duration_s, whole.duration_s + latest.duration_s)
        whole = whole.followed_by(latest, rig.hold(_BETWEEN_S))
        if identify_plant(whole).sigma.dead_time_s <= _DEAD_TIME_SIGMA_S:
            break
    return Experiments(around, whole, relays.duration_s, longest_s, finished, held)


def fit_experiments(done: Experiments) -> Characterised:
    """Fit all experiments; judge by the doublets, which a fit to the relays alone must predict."""
    found = identify_plant(done.record)
    start_s, stop_s = done.pulses_s
    checked = None
    if stop_s - start_s > _VALIDATE_LEAST_S:
        relays = done.record.cut(0.0, done.relays_s)
        checked = validate_fit(identify_plant(relays), done.record.cut(start_s, stop_s))
    return Characterised(done, found, judge_fit(done.record, found, checked))


def _run_relays(
    rig: ExperimentRig, around: operating_point.OperatingPoint, plan: Plan
) -> tuple[Record, Finished]:
    """Relays until the gain is known, or the data ask for the pump's map, each followed by a hold.

    One that the guard stopped is as good for its duration as another, unless the mirror jumped:
    gusts and a laser's noise stop sound experiments, too.
    """
    done: Record | None = None
    finished = Finished(ExperimentEnd.INTERRUPTED, "")
    for _ in range(plan.relays):
        relay, finished = rig.perform(make_spec("relay", around, plan.relay_s))
        relay = relay.followed_by(rig.hold(_BETWEEN_S))
        if done is None:
            done = relay
        else:
            done = done.followed_by(relay)
        if finished.end is ExperimentEnd.NO_RESPONSE:
            otherwise = f"{finished.reason}; if that is not the cause, {MAP_THE_PUMP}"
            raise ExperimentError(otherwise, pump_suspected=True)
        try:
            found = identify_plant(done)
        except ValueError:  # too short for a fit
            continue

        # A relay that ended early: by a jump, after which the record begins again; by a pump that
        # is too strong; or by weather, which does not matter.
        if not finished.completed and found.largest_residual > JUMP_SIGMAS:
            done = None
            continue
        if not finished.completed and _is_too_strong(found):
            raise ExperimentError(f"{finished.reason}: {MAP_THE_PUMP}", pump_suspected=True)
        around = replace(around, late_s=found.model.delay_s)
        is_gain_known = found.sigma.gain <= _GAIN_SIGMA * found.model.gain
        if _has_enough(done, plan) and (is_gain_known or find_bent_curve(done, found)):
            break
    if done is None or not _has_enough(done, plan):
        reason = finished.reason
        if finished.end is ExperimentEnd.STOPPED_BY_GUARD:
            reason = f"{reason}: {LARGER_LIMIT}"
        raise ExperimentError(reason)
    return done, finished


def _has_enough(relays: Record, plan: Plan) -> bool:
    """Whether the relays together lasted as long as one."""
    return relays.duration_s >= plan.relay_s


def _is_too_strong(found: Identified) -> bool:
    """Whether the pump stopped these relays, and not the weather:
    the next one would end like them.
    """
    return found.model.gain - _CERTAIN_SIGMAS * found.sigma.gain > _TOO_STRONG
