"""State lanes: which words a lane may show, in which colours, and what the codes of a row mean."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from membrane_ctrl import safety
from membrane_ctrl.names import Rung, ShapeState, State


@dataclass(frozen=True, slots=True)
class Lane:
    """One row of the state timeline.

    Attributes
    ----------
    path : str
        Rerun entity.
    field : str
        Telemetry field that holds the code; empty when the lane is not made from telemetry.
    words : dict
        Code to word.
    colours : dict
        Word to 0xRRGGBBAA; a word without one gets the viewer's choice.
    """

    path: str
    field: str
    words: dict[int, str]
    colours: dict[str, int]

    def word(self, code: int) -> str:
        """The word for a code; an unknown code is shown as it is."""
        return self.words.get(code, f"code {code}")


_CALM, _BUSY, _GOOD, _WARN, _BAD = 0x5A5A5AFF, 0x56B4E9FF, 0x009E73FF, 0xE69F00FF, 0xD55E00FF


def _words(codes: type[IntEnum]) -> dict[int, str]:
    return {int(code): code.name.lower() for code in codes}


_FAULTS = {0: "none"} | {rule.code: rule.name for rule in safety.TABLE}

STATE = Lane(
    "/state/controller",
    "state",
    _words(State),
    {
        "standby": _CALM, "check": _BUSY, "inflate": _BUSY, "settle": _WARN, "hold": _GOOD,
        "manual": 0xCC79A7FF, "tune": 0xF0E442FF, "lower": _WARN, "fault": _BAD,
    },
)  # fmt: skip
SHAPE = Lane(
    "/state/shape_loop",
    "shape_state",
    _words(ShapeState),
    {"off": _CALM, "waiting": _BUSY, "tracking": _GOOD, "suspended": _WARN},
)
RUNG = Lane(
    "/state/rung",
    "rung",
    _words(Rung),
    {"none": _CALM, "hold_flow": _WARN, "ramp_down": _WARN, "pump_off": _BAD, "vent": _BAD},
)
FAULT = Lane("/state/fault", "fault", _FAULTS, dict.fromkeys(_FAULTS.values(), _BAD) | {"none": _CALM})
VERDICT = Lane("/state/verdict", "", {}, {"ok": _GOOD, "degraded": _WARN, "rejected": _BAD})

TELEMETRY_LANES: tuple[Lane, ...] = (STATE, SHAPE, RUNG, FAULT)
LANES: tuple[Lane, ...] = (*TELEMETRY_LANES, VERDICT)
