"""What the interface for programs answers and takes, as schemas (OpenAPI).

The client (`service_client`) checks the answers of another service against the same models: it may
be another program, a damaged service or a hostile one.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from membrane_ctrl.control_port.protocol import TEXT_BYTES, WHY_BYTES, RequestName
from membrane_ctrl.controller.command import Role

_Line = Annotated[str, Field(max_length=2000)]
_Lines = Annotated[list[_Line], Field(max_length=500)]
Viewer = Annotated[str, Field(max_length=40, pattern=r"^[\w.@+ -]*$")]


class _Answer(BaseModel):
    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)


class Reading(_Answer):
    """A device's last read-back."""

    pump_fraction: float | None
    vent_fraction: float | None
    time_utc: _Line


class RunEndAnswer(_Answer):
    """How the newest run ended."""

    run: _Line
    kind: _Line
    ended_utc: _Line
    cause: _Line
    remedy: _Line
    lines: _Lines
    read_back: Reading | None


class StateAnswer(_Answer):
    """A hold at one moment; without a hold, how the newest run ended."""

    hold: _Line
    run: _Line
    state: _Line
    in_contact: bool
    reason: _Line
    alarms: _Lines
    locks: _Lines
    error_um: float | None
    status: dict[str, Any]
    """The status of the control socket (docs/reference/control-port.md); empty without contact."""
    ended: RunEndAnswer | None


class StatesAnswer(_Answer):
    """All holds of the service."""

    holds: Annotated[list[StateAnswer], Field(max_length=200)]


class SignalAnswer(_Answer):
    """A published signal, the same as through all bridges, with its present value."""

    name: _Line
    title: _Line
    description: _Line
    unit: _Line
    value: float | Annotated[str, Field(max_length=20_000)] | None


class HistoryAnswer(_Answer):
    """A signal over time: least, mean and largest value of windows; null interrupts the line."""

    signal: _Line
    unit: _Line
    utc_s: list[float]
    low: list[float | None]
    mean: list[float | None]
    high: list[float | None]


class RunAnswer(_Answer):
    """A run of the folder."""

    name: _Line
    started_utc: _Line
    duration_s: float | None
    std_um: float | None
    faults: int
    exit: _Line
    ended_in: _Line
    has_report: bool


class ConfigurationAnswer(_Answer):
    """What a hold can be started with."""

    name: _Line
    has_devices: bool
    problem: _Line


class ConfigurationTextAnswer(_Answer):
    """A configuration's file; `digest` identifies this text."""

    text: str
    digest: _Line


class CheckedConfigurationAnswer(_Answer):
    """What is wrong with a configuration: `errors` refuse it."""

    errors: _Lines
    warnings: _Lines


class UserAnswer(_Answer):
    """Who asks."""

    name: _Line
    role: Role
    via: _Line


class CommandBody(BaseModel):
    """A command of `ctl` (docs/reference/control-port.md)."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    do: RequestName
    value: float | None = None
    text: Annotated[str, Field(max_length=TEXT_BYTES)] = ""
    loop: dict[str, bool | float] | None = None
    pump: dict[str, Any] | None = None
    shape_time_constant_s: float | None = None
    why: Annotated[str, Field(max_length=WHY_BYTES)] = ""
    take_over: bool = False
    expires_in_s: Annotated[float, Field(gt=0, le=600)] | None = None
    """Time after which the hold must not obey any more."""
    viewer: Viewer = ""
    """For whom the program asks; it is recorded behind the token's name, and not verified."""


class SafetyBody(BaseModel):
    """What may be added to a safety command."""

    model_config = ConfigDict(extra="forbid")

    text: Annotated[str, Field(max_length=TEXT_BYTES)] = ""
    why: Annotated[str, Field(max_length=WHY_BYTES)] = ""
    viewer: Viewer = ""


class ConfigurationBody(BaseModel):
    """The text of a configuration, and the digest of the text that was edited."""

    model_config = ConfigDict(extra="forbid")

    text: Annotated[str, Field(max_length=200_000)]
    digest: Annotated[str, Field(max_length=64)] = ""


class StartBody(BaseModel):
    """A hold to start."""

    model_config = ConfigDict(extra="forbid")

    configuration: Annotated[str, Field(max_length=64)]
    standby: bool = False
    clear_faults: bool = False


class RestartBody(BaseModel):
    """The configuration of the next hold."""

    model_config = ConfigDict(extra="forbid")

    configuration: Annotated[str, Field(max_length=64)]


class CommandAnswer(_Answer):
    """What became of a command: `text` is one line for people."""

    done: bool
    text: _Line
    answer: dict[str, Any] = {}
    """The hold's answer, such as the word of a lock."""
