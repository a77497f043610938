"""What a hold follows and does, what must be noticed meanwhile, and the guards beside the rules."""

from enum import Enum

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.telemetry import State


class FilmSensor(Enum):
    """The sensors that show where the film is; the value is what people call them."""

    LASER = "laser"
    OPTICS = "optics"
    GAUGE = "gauge"


class ProcessValue(Enum):
    """What the inner loop holds: `estimator.process_value`.

    With `auto` the estimate runs all the time, and all its protections hold, whatever the loop
    follows.
    """

    LASER = "laser"
    ESTIMATE = "estimate"
    OPTICS = "optics"

    @classmethod
    def from_config(cls, config: Config) -> "ProcessValue":
        """Whose protections hold with a configuration."""
        value = config.estimator.process_value
        if value == "auto":
            return cls.ESTIMATE if config.estimates_centre else cls.LASER
        return cls(value)


class Activity(Enum):
    """What a hold does while gas can move; the value is its name for people.

    Gains and a pump curve on trial change the numbers of the loop, not its activity. In `check` the
    actuator test runs the pump for at most five seconds, and only while all sensors are good. In
    `lower` and `fault` the pump is off or ramps down; `pump_runs_on` and `gas_comes_in` watch it
    there.
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
    """Protections beside the rules of the safety table; the value is a sentence for people."""

    MANUAL_RANGE = "a pause or manual flow ends beyond `states.manual_range_um` (`tick_context.py`)"
    EXPERIMENT = (
        "an experiment ends near its limit, and brings the mirror back "
        "(`experiments/excursion_guard.py`)"
    )
    RAMP_WAITS = (
        "the setpoint's ramp waits for a mirror that lags by `states.inflate_pause_um` "
        "(`states.py`)"
    )
    FIGURE_GATE = "a figure that cannot be used counts as missing (`figure_gate.py`)"
    ESTIMATE_ROBUST = "the estimate does not use a reading far from what it expects (`centre.py`)"
    TRIM_LIMIT = (
        "beyond `shape.trim_max_um` the optics are left out; notice `trim_limit` "
        "(`sensor_consistency.py`)"
    )
    SENSOR_NOTICE = (
        "a notice `laser_lost`, `optics_lost` or `gauge_lost` calls the operator (`redundancy.py`)"
    )
    DRIFT_NOTICE = "the notice `slow_drift` calls the operator (`sensor_consistency.py`)"
    PLAUSIBILITY = (
        "laser, optics and gauge are compared, and the outvoted one is not used (`film.py`)"
    )
    PAUSE_TIME = "a pause ends after `states.pause_max_s` (`states.py`)"
    MANUAL_TIME = "manual flow ends after `states.manual_max_s` (`states.py`)"
    EXPERIMENT_TIME = "an experiment ends after its duration (`experiments/trial.py`)"
