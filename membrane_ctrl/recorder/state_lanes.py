"""State lanes: the words of a lane, their colours, and the meaning of a row's codes."""

from membrane_ctrl.recorder.lane import Lane
from membrane_ctrl.run_files import named_tables

_CALM = 0x5A5A5AFF
_BUSY = 0x56B4E9FF
_GOOD = 0x009E73FF
_WARN = 0xE69F00FF
_BAD = 0xD55E00FF
_FAULTS = named_tables.WORDS["fault"]


STATE = Lane(
    "/state/controller",
    "state",
    named_tables.WORDS["state"],
    {
        "standby": _CALM,
        "check": _BUSY,
        "inflate": _BUSY,
        "settle": _WARN,
        "hold": _GOOD,
        "manual": 0xCC79A7FF,
        "tune": 0xF0E442FF,
        "lower": _WARN,
        "fault": _BAD,
    },
)
SHAPE = Lane(
    "/state/shape_loop",
    "shape_state",
    named_tables.WORDS["shape_state"],
    {"off": _CALM, "waiting": _BUSY, "tracking": _GOOD, "suspended": _WARN},
)
SAFE_LEVEL = Lane(
    "/state/safe_level",
    "safe_level",
    named_tables.WORDS["safe_level"],
    {"none": _CALM, "hold_flow": _WARN, "ramp_down": _WARN, "pump_off": _BAD, "vent": _BAD},
)
FAULT = Lane(
    "/state/fault", "fault", _FAULTS, dict.fromkeys(_FAULTS.values(), _BAD) | {"none": _CALM}
)
VERDICT = Lane("/state/verdict", "", {}, {"ok": _GOOD, "degraded": _WARN, "rejected": _BAD})

TELEMETRY_LANES: tuple[Lane, ...] = (STATE, SHAPE, SAFE_LEVEL, FAULT)
LANES: tuple[Lane, ...] = (*TELEMETRY_LANES, VERDICT)
