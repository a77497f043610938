"""What protects the mirror in each process value and state in which the pump may run: a table for
review and tests.

The rules are in `safety.TABLE`. Whichever sensor the loop follows, for each `Duty` and `Activity`
at least one rule or guard exists; tests check that. `docs/reference/faults.md` shows the table, and
the campaign measures the bounds (`docs/measurements/protection.md`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from membrane_ctrl.config.schema import Config
from membrane_ctrl.control.climate_allowance import HOUR_MOST_UM, MINUTES_MOST_UM
from membrane_ctrl.controller.duties import Activity, Duty, FilmSensor, Guard, ProcessValue
from membrane_ctrl.model.telemetry import State

# The pump moves the film by 5.3 µm/s at most: means over ten seconds find that after 53 µm, and
# some µm more are gone until the pump is off.
_FAST_MOTION_UM = 65.0
# The hour's limit is judged by a lagging mean, and a stretched film hides a part of a drift: if 30
# % of its pressure is linear in the sag, the gauge shows 80 %. A drift of 0.05 µm/s then passes the
# limit by little and late: the protection campaign measured 313 µm after 1.7 h.
_DRIFT_FACTOR = 3.0
# As much further goes a drift while the day's reference follows it.
_DAY_FACTOR = 1.3
# Until the estimate no longer follows the optics.
_TRIM_FACTOR = 1.1
_CLIMATE_ROLES = frozenset(("film_thermometer", "ring_thermometer", "hygrometer"))


Protection = str | Guard  # the name of a rule of `safety.TABLE`, or a guard
_Protections = tuple[Protection, ...]

_MOTIONS: Mapping[Activity, _Protections] = {
    Activity.INFLATE: (Guard.RAMP_WAITS,),
    Activity.SETTLE: ("overdue",),
    Activity.HOLD: ("following_error",),
    Activity.PAUSE: (Guard.MANUAL_RANGE,),
    Activity.MANUAL: (Guard.MANUAL_RANGE,),
    Activity.TUNE: (Guard.EXPERIMENT,),
}
_TIMES: Mapping[Activity, _Protections] = {
    Activity.INFLATE: ("overdue",),
    Activity.SETTLE: ("overdue",),
    Activity.HOLD: ("following_error",),
    Activity.PAUSE: (Guard.PAUSE_TIME,),
    Activity.MANUAL: (Guard.MANUAL_TIME,),
    Activity.TUNE: (Guard.EXPERIMENT_TIME,),
}
_DEPTHS: _Protections = ("over_displacement", "under_displacement")
_COMPARED = frozenset(Activity) - {Activity.INFLATE}


def find_protections(process_value: ProcessValue, activity: Activity, duty: Duty) -> _Protections:
    """The rules and guards that fulfil a duty in a cell; each keeps it by itself.

    Parameters
    ----------
    process_value : ProcessValue
        What the loop follows.
    activity : Activity
        What the controller does with the mirror.
    duty : Duty
        What must be detected, or limited.

    Returns
    -------
    tuple of str or Guard
        Empty only for `MAJORITY`, which needs a third sensor and a mirror that is not far from its
        setpoint, and for `GAS`, which needs a mirror that is held.
    """
    # A sensor that does not measure the process value cannot mislead the loop: its own rules are
    # fewer, or none.
    uses_laser = process_value is not ProcessValue.OPTICS
    uses_optics = process_value is not ProcessValue.LASER
    by_figures: _Protections = (Guard.FIGURE_GATE,) if uses_optics else ()
    by_laser: _Protections
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
            return (
                ("displacement_missing",) if uses_laser else ("displacement_missing", "film_unseen")
            )
        case Duty.FROZEN:
            by_laser = (
                ("displacement_frozen", "displacement_stuck")
                if uses_laser
                else ("displacement_frozen",)
            )
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
    """How a sensor of the film fails, in classes of equal bounds;
    the value is a phrase for people.
    """

    LOST = "lost, frozen to the last bit, of bad quality, or with wrong times"
    STEP = "a step, or a drift of 1 µm/s or more"
    DRIFT = "a drift of 0.05 or 0.2 µm/s"
    DRIFT_WITHIN_CLIMATE = "a drift of 0.02 µm/s, which climate may hide"


@dataclass(frozen=True, slots=True)
class Bound:
    """How far the true centre can be from where it is held, and which other sensor bounds it."""

    sensor: FilmSensor
    distance_um: float


def find_bound(
    process_value: ProcessValue,
    failed: FilmSensor,
    failure: Failure,
    config: Config,
    laser_and_optics: bool = True,
) -> Bound:
    """What bounds the true displacement when one sensor fails, in every activity.

    Parameters
    ----------
    process_value : ProcessValue
        What the loop follows.
    failed : FilmSensor
        The sensor that shows something wrong.
    failure : Failure
        How it fails: by a step, a drift, or a drift that climate could explain.
    config : Config
        Its limits and the trim's range.
    laser_and_optics : bool
        Both are there, unless one of them is the failed one; otherwise only the gauge is left.

    Returns
    -------
    Bound
        By a sensor other than the failed one.
    """
    if failed is FilmSensor.GAUGE:  # the loop does not follow it
        sensor = FilmSensor.OPTICS if process_value is ProcessValue.OPTICS else FilmSensor.LASER
        return Bound(sensor, _FAST_MOTION_UM)
    has_laser = laser_and_optics and process_value is not ProcessValue.OPTICS
    drifts = failure in (Failure.DRIFT, Failure.DRIFT_WITHIN_CLIMATE)
    if failed is FilmSensor.OPTICS and has_laser and drifts:
        return Bound(FilmSensor.LASER, _TRIM_FACTOR * config.shape.trim_max_um)
    limits = config.limits
    minutes_um, hour_um = _find_climate_allowances(config)
    distances_um = {
        Failure.LOST: _FAST_MOTION_UM,
        Failure.STEP: limits.laser_gauge_apart_max_um + minutes_um + _FAST_MOTION_UM,
        Failure.DRIFT: _DRIFT_FACTOR * (limits.laser_gauge_drift_max_um + hour_um),
        Failure.DRIFT_WITHIN_CLIMATE: _DAY_FACTOR * limits.laser_gauge_day_max_um,
    }
    return Bound(FilmSensor.GAUGE, distances_um[failure])


def _find_climate_allowances(config: Config) -> tuple[float, float]:
    """What sensors of the climate may explain of a difference from the gauge, within minutes and
    an hour, µm; 0 on a bench without them.
    """
    if config.devices is None or config.devices.roles().keys().isdisjoint(_CLIMATE_ROLES):
        return 0.0, 0.0
    return MINUTES_MOST_UM, HOUR_MOST_UM
