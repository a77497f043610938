"""A command to a running hold, and a row of the table that states who may send it and when."""

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal

from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from membrane_ctrl.control.experiments.spec import ExperimentSpec
from membrane_ctrl.model.lock import Lock
from membrane_ctrl.model.telemetry import State

Kind = Literal[
    "hold",
    "stop",
    "pause",
    "resume",
    "manual",
    "setpoint",
    "gains",
    "shape_on",
    "shape_off",
    "mark",
    "ack",
    "lower",
    "vent",
    "tune",
    "keep",
    "latch",
    "unlock",
    "capture",
]
Role = Literal["read", "operate", "tune"]


@dataclass(frozen=True, slots=True)
class Command:
    """A request of a person or program."""

    # of `TABLE`, or what only the start of a run reports: an earlier run resumed within the last
    # day, or a fault is still latched
    kind: Kind | Literal["resumed", "latched"]
    who: str  # recorded, as is `why`
    why: str = ""
    # `setpoint`: µm. `manual`: flow, µm/s of the centre. `gains`: trial time, s; NaN: no trial.
    # `capture`: angle by which the mirror was turned about its axis, degrees; NaN: it was not.
    # `resumed`: age of the resume, s
    value: float = math.nan
    # `mark`: text for the timeline. `latch`: why the mirror is locked. `unlock`: the typed word.
    # `latched`: the fault
    text: str = ""
    loop: LoopConfig | None = None  # `gains`: all new loop settings
    experiment: ExperimentSpec | None = None  # `tune`: the experiment
    number: int = 0  # chosen by the client, returned with the answer
    shape_time_constant_s: float = math.nan  # `gains`: of the shape loop; NaN: as it is
    pump: PumpConfig | None = None  # `gains`: the pump's curve, if it changes
    # `gains` on trial: moves the setpoint, the shape loop off; NaN: neither
    setpoint_step_um: float = math.nan
    # `latch`: the lock, with author, word and time; None: made of the other fields
    lock: Lock | None = None
    account: str = ""  # login of the sender; empty: none, or not proven
    from_person: bool = True  # False: sent by a bridge, which represents no person


@dataclass(frozen=True, slots=True)
class CommandRule:
    """One row of the table."""

    role: Role  # required role
    states: Collection[State]  # where it is allowed
    does: str  # help text
    needs: tuple[str, ...] = ()  # required fields of the request
    takes: tuple[str, ...] = ()  # optional fields
