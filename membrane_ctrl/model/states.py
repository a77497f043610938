"""Names of states and safe levels, in one place for code, files and Rerun paths; their order gives their codes."""

from enum import IntEnum


class State(IntEnum):
    """States of the controller (docs/architecture.md)."""

    STANDBY = 0
    CHECK = 1
    INFLATE = 2
    SETTLE = 3
    HOLD = 4
    MANUAL = 5
    TUNE = 6
    LOWER = 7
    FAULT = 8


class ShapeState(IntEnum):
    """States of the shape loop inside `hold`."""

    OFF = 0
    WAITING = 1
    TRACKING = 2
    SUSPENDED = 3


class SafeLevel(IntEnum):
    """The safe levels, by their names in telemetry; each times out into the next."""

    NONE = 0
    HOLD_FLOW = 1
    RAMP_DOWN = 2
    PUMP_OFF = 3
    VENT = 4
