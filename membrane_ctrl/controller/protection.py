"""What protects the mirror in each process value and state in which gas can move: a table for review and tests.

The rules themselves stand in `safety.TABLE`, the guards in the modules that `Guard` names. This table states that
none of them is missing: whichever sensor the loop follows, each `Duty` has at least one keeper in each `Activity`.
`docs/faults.md` shows it, and the campaign measures the bounds (`docs/protection.md`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.redundancy import FilmSensor
from membrane_ctrl.model.telemetry import State


class ProcessValue(Enum):
    """What the inner loop holds: `estimator.process_value`."""

    LASER = "laser"
    ESTIMATE = "estimate"
    OPTICS = "optics"


class Activity(Enum):
    """What a hold does while gas can move; the value is its name for people.

    Gains and a pump curve on trial change the numbers of the loop, not its activity. In `lower` and `fault` the pump
    is off or ramps down; `pump_runs_on` and `gas_comes_in` watch it there.
    """

    INFLATE = "inflate"
    SETTLE = "settle"
    HOLD = "hold"
    PAUSE = "pause"
    MANUAL = "manual"
    TUNE = "tune"

    @property
    def state(self) -> State:
        """The controller's state in it."""
        return State.HOLD if self is Activity.PAUSE else State[self.name]


class Duty(Enum):
    """What must be noticed, or bounded, while gas can move; the value is a phrase for people."""

    PRESSURE = "pressure limit"
    DEPTH = "displacement limits"
    RANGE = "distance from the setpoint"
    TIME = "time without progress"
    MISSING = "no displacement"
    FROZEN = "displacement frozen"
    JUMP = "displacement jumps"
    GAUGE = "comparison with the gauge"
    MAJORITY = "two sensors against one"
    GAS = "excess gas"
    REDUNDANCY = "loss of a sensor"


class Guard(Enum):
    """Protections beside the rules of the safety table; the value says where each is and what it does."""

    MANUAL_RANGE = "`states.manual_range_um` ends it"
    EXPERIMENT = "the experiment's guard brings the mirror back"
    RAMP_WAITS = "the ramp waits for the mirror (`states.inflate_pause_um`)"
    FIGURE_GATE = "such figures count as missing"
    ESTIMATE_ROBUST = "the estimate leaves it out"
    TRIM_LIMIT = "`shape.trim_max_um`, notice `trim_limit`"
    SENSOR_NOTICE = "notices `laser_lost`, `optics_lost`, `gauge_lost`"
    DRIFT_NOTICE = "notice `slow_drift`"
    PLAUSIBILITY = "event `plausibility`"
    PAUSE_TIME = "`states.pause_max_s` ends it"
    MANUAL_TIME = "`states.manual_max_s` ends it"
    EXPERIMENT_TIME = "the experiment's duration ends it"


Keeper = str | Guard  # the name of a rule of `safety.TABLE`, or a guard
_Keepers = tuple[Keeper, ...]

_MOTIONS: Mapping[Activity, _Keepers] = {
    Activity.INFLATE: (Guard.RAMP_WAITS,),
    Activity.SETTLE: ("overdue",),
    Activity.HOLD: ("following_error",),
    Activity.PAUSE: (Guard.MANUAL_RANGE,),
    Activity.MANUAL: (Guard.MANUAL_RANGE,),
    Activity.TUNE: (Guard.EXPERIMENT,),
}
_TIMES: Mapping[Activity, _Keepers] = {
    Activity.INFLATE: ("overdue",),
    Activity.SETTLE: ("overdue",),
    Activity.HOLD: ("following_error",),
    Activity.PAUSE: (Guard.PAUSE_TIME,),
    Activity.MANUAL: (Guard.MANUAL_TIME,),
    Activity.TUNE: (Guard.EXPERIMENT_TIME,),
}
_DEPTHS: _Keepers = ("over_displacement", "under_displacement")
_COMPARED = frozenset(Activity) - {Activity.INFLATE}


def find_keepers(process_value: ProcessValue, activity: Activity, duty: Duty) -> _Keepers:
    """The rules and guards that fulfil a duty in a cell; each keeps it by itself.

    Parameters
    ----------
    process_value : ProcessValue
    activity : Activity
    duty : Duty

    Returns
    -------
    tuple of str or Guard
        Empty only for `MAJORITY`, which needs a third sensor and a mirror that is not far from its setpoint, and for
        `GAS`, which needs a mirror that is held.
    """
    uses_laser = process_value is not ProcessValue.OPTICS
    uses_optics = process_value is not ProcessValue.LASER
    by_figures: _Keepers = (Guard.FIGURE_GATE,) if uses_optics else ()
    by_laser: _Keepers
    match duty:
        case Duty.PRESSURE:
            return ("over_pressure", "pressure_missing", "gauge_stuck", "gauge_jump")
        case Duty.DEPTH:
            return _DEPTHS if activity.state is State.HOLD else _DEPTHS[:1]
        case Duty.RANGE:
            return _MOTIONS[activity]
        case Duty.TIME:
            return _TIMES[activity]
        case Duty.MISSING:
            return ("displacement_missing",) if uses_laser else ("displacement_missing", "film_unseen")
        case Duty.FROZEN:
            by_laser = ("displacement_frozen", "displacement_stuck") if uses_laser else ("displacement_frozen",)
            return (*by_laser, *by_figures, "laser_gauge_apart")
        case Duty.JUMP:
            by_laser = ("displacement_jump",) if uses_laser else ()
            return (*by_laser, *by_figures, "laser_gauge_apart")
        case Duty.GAUGE:
            return ("laser_gauge_apart", Guard.DRIFT_NOTICE)
        case Duty.MAJORITY:
            if activity not in _COMPARED or not uses_laser:
                return ()
            return (
                Guard.PLAUSIBILITY,
                Guard.ESTIMATE_ROBUST if uses_optics else "laser_implausible",
                Guard.TRIM_LIMIT,
            )
        case Duty.GAS:
            return ("gas_excess",) if activity.state is State.HOLD else ()
        case Duty.REDUNDANCY:
            return (Guard.SENSOR_NOTICE,)


class Failure(Enum):
    """How a sensor of the film fails, by what bounds its effect; the value is a phrase for people."""

    LOST = "lost, frozen to the last bit, of bad quality, or with wrong times"
    STEP = "a step, or a drift of 1 um/s or more"
    DRIFT = "a drift of 0.05 or 0.2 um/s"
    HIDDEN = "a drift of 0.02 um/s, which climate may hide"


@dataclass(frozen=True, slots=True)
class Bound:
    """How far the true centre can be from where it is held, and which other sensor bounds it."""

    by: FilmSensor
    distance_um: float


# A film at 5.3 um/s is found by means over ten seconds, and the pump then ramps down.
_FAST_MOTION_UM = 65.0


def find_bound(process_value: ProcessValue, failed: FilmSensor, failure: Failure, config: Config) -> Bound:
    """What bounds the true displacement when one sensor fails, in every activity.

    Parameters
    ----------
    process_value : ProcessValue
    failed : FilmSensor
    failure : Failure
    config : Config
        Its limits and the trim's range.

    Returns
    -------
    Bound
        By a sensor other than the failed one.
    """
    if failed is FilmSensor.GAUGE:  # it moves nothing: laser or optics are followed
        by = FilmSensor.OPTICS if process_value is ProcessValue.OPTICS else FilmSensor.LASER
        return Bound(by, _FAST_MOTION_UM)
    optics_fail = failed is FilmSensor.OPTICS
    if optics_fail and process_value is not ProcessValue.OPTICS and failure in (Failure.DRIFT, Failure.HIDDEN):
        return Bound(FilmSensor.LASER, 1.1 * config.shape.trim_max_um)
    limits = config.limits
    distances_um = {
        Failure.LOST: _FAST_MOTION_UM,
        Failure.STEP: limits.laser_gauge_apart_max_um + _FAST_MOTION_UM,
        Failure.DRIFT: 2.0 * limits.laser_gauge_drift_max_um,
        Failure.HIDDEN: 1.3 * limits.laser_gauge_day_max_um,
    }
    return Bound(FilmSensor.GAUGE, distances_um[failure])
