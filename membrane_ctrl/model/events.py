"""Events of the controller, one class per kind, and the sentence on any event; `run_events` has the other kinds.

As JSON they are the lines of `events.jsonl`, without their times. A field is a key of the line (`from_` is "from", a
Python keyword). Keys with None as default are omitted if None.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, dataclass, fields
from typing import Any, ClassVar, dataclass_transform

EventLine = dict[str, Any]  # of `events.jsonl`, with or without its times

KINDS: dict[str, type["Event"]] = {}


@dataclass_transform(frozen_default=True)
@dataclass(frozen=True)
class Event:
    """The base of all kinds; derived classes are frozen dataclasses."""

    _kind: ClassVar[str]
    keys: ClassVar[tuple[tuple[Field[Any], str], ...]]  # the fields, each with its key in the line

    def __init_subclass__(cls, kind: str = "") -> None:
        dataclass(frozen=True)(cls)
        cls._kind = kind
        cls.keys = tuple((field, field.name.rstrip("_")) for field in fields(cls))
        if kind:
            KINDS[kind] = cls

    @property
    def kind(self) -> str:
        """Kind as in the line."""
        return self._kind

    def to_dict(self) -> EventLine:
        """The line, without its times."""
        told = ((key, getattr(self, field.name), field.default is MISSING) for field, key in self.keys)
        return {"kind": self.kind} | {key: value for key, value, always in told if always or value is not None}

    def numbers(self) -> tuple[float, ...]:
        """Numbers and codes of the event, in the order of its fields; texts and missing values are left out.

        Together with `kind` they identify what happened, independently of the wording: the checksum of a tick covers
        them. A table counts with its numbers, in the order of its keys.
        """
        return tuple(number for field, _ in self.keys for number in _numbers_in(getattr(self, field.name)))


def _numbers_in(value: object) -> Iterator[float]:
    if isinstance(value, bool | int | float):
        yield float(value)
    elif isinstance(value, Mapping):
        for key in sorted(value):
            yield from _numbers_in(value[key])
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _numbers_in(item)


class StateEntered(Event, kind="state"):
    """The state machine entered another state."""

    state: str
    from_: str
    why: str


class Why(Event, kind="why"):
    """The operator's line changed."""

    why: str


class Fault(Event, kind="fault"):
    """A rule of the safety table tripped."""

    code: int
    name: str
    cause: str
    seen: str
    limit: str
    safe_level: str
    latching: bool
    remedy: str


class Cleared(Event, kind="cleared"):
    """The cause of a fault that only held the flow has gone."""

    name: str


class Resumed(Event, kind="resumed"):
    """A latched fault was cleared by the resume rule."""

    name: str


class ShapeLoopState(Event, kind="shape"):
    """The shape loop's state, or the reason for it, changed."""

    state: str
    reason: str


class CommandTaken(Event, kind="command"):
    """A tick executed or refused a command."""

    command: str
    who: str
    why: str
    value: float | None = None
    text: str | None = None
    loop: Any = None
    experiment: Any = None
    shape_time_constant_s: float | None = None
    setpoint_step_um: float | None = None
    refused: str | None = None


class LockSet(Event, kind="lock"):
    """A person locked the mirror, or the run started with a lock of an earlier one."""

    word: str
    text: str
    author: str
    account: str
    session: str
    set_utc: str
    number: int  # of the request; 0: from the start of the run


class LockRemoved(Event, kind="unlock"):
    """A person removed a lock: its author, or somebody who typed its word (`how`)."""

    word: str
    text: str
    author: str
    set_utc: str
    remover: str
    how: str
    number: int


class GainsReverted(Event, kind="gains_reverted"):
    """Gains on trial were reverted."""

    why: str


class ExperimentEnded(Event, kind="experiment"):
    """An experiment is over."""

    experiment: str
    completed: bool
    reason: str
    pump_map: Any = None


class Plausibility(Event, kind="plausibility"):
    """Which of laser, gauge and camera is wrong now, if any."""

    liar: str
    seen: str


class HeldBy(Event, kind="held_by"):
    """Which sensors the estimate of the centre follows now, and which of them have jumped."""

    sensors: str
    jumped: str


class Maintenance(Event, kind="maintenance"):
    """Something is wearing out, or will need attention."""

    name: str
    message: str


class PumpLearned(Event, kind="pump"):
    """What is known of the pump: its flow relative to the configured curve, one standard error, the scale in use."""

    scale: float
    sigma: float
    correction: float


class MaintenanceOver(Event, kind="maintenance_over"):
    """A maintenance notice no longer applies."""

    name: str
    message: str


class InterlockOpened(Event, kind="interlock_opened"):
    """The circuit of an interlock opened, or its signal was lost; `text` is the configuration's, for people."""

    name: str
    text: str
    safe_level: str


class InterlockClosed(Event, kind="interlock_closed"):
    """The circuit of an interlock is closed again."""

    name: str


# Events as sentences for people: what happened, where, and what to do; one wording for every timeline.

# A part in brackets is left out if one of its fields is empty.
_SENTENCES = {
    "start": "Run started[ on {devices}][, {priority} priority][; {message}]",
    "end": "Run ended: {exit}",
    "state": "State {state}[, from {from}][: {why}]",
    "why": "{why}",
    "fault": "Fault {name}: {cause}[ ({seen})][. Do: {remedy}][. Limit: {limit}][; safe level {safe_level}]",
    "cleared": "Fault {name} is over: its cause has gone",
    "resumed": "Fault {name} is cleared by the resume rule",
    "shape": "Shape loop {state}[: {reason}]",
    "command": 'Command {command}[ {value:g} {unit}][ "{text}"][ by {who}][: {why}][. Refused: {refused}]',
    "lock": 'Locked by {author}[ ({session})][, {set_utc}]: "{text}", word {word}',
    "unlock": 'Lock "{text}" of {author} removed by {remover} (by its {how})',
    "lock_not_stored": "The lock {word} is not stored: {message}. Do: mend the disk, the lock ends with this run",
    "lock_stored": "The lock {word} is stored now",
    "gains_reverted": "Gains on trial are reverted: {why}",
    "experiment": "Experiment {experiment} ended[: {reason}]",
    "plausibility": "Laser and camera disagree ({seen}). Do: check the laser's mount, the camera and the screen",
    "agreement": "Laser and camera agree again[ ({seen})]",
    "maintenance": "Maintenance {name}: {message}",
    "vibrations": "Vibrations of the mirror: {message}",
    "maintenance_over": "Maintenance {name} is over: {message}",
    "interlock_opened": "Interlock {name} is open[: {text}]",
    "interlock_closed": "Interlock {name} is closed",
    "held_by": "The mirror is held by {sensors}[; jumped: {jumped}]",
    "pump": "The pump gives {scale:.3f} of its curve, +- {sigma:.3f}; the loop reckons with {correction:.3f}",
    "link": "Link to the pump board: {message}",
    "latch_written": "The latched fault's file is written again",
    "child_ended": "The {child} process ended[ with exit code {exit_code}]; the hold continues",
    "child_silent": "The {child} process does not answer; the hold continues",
    "child_restarted": "The {child} process was replaced (replacement {restarts})",
    "child_given_up": "The {child} process ended too often and is not replaced for an hour. Do: check the run",
    "acquisition": "Acquisition {state}[: {message}]",
    "geometry": "Geometry {hash}[ from {file}][, calibrated {calibrated_utc}][; {message}]",
    "capture": "Capture[ of cycle {cycle}][ in {set}][, {verdict}][: {reason}][. Failed: {failed}]",
    "recorder_error": "Not recorded: {message}. Do: check the disk and the folder of the run",
    "disk_low": "Disk almost full: {message}",
    "port": "Control port open[ on {socket}][, TLS {tls}][, metrics {metrics}]",
    "port_failed": "Control port {port} failed: {message}[. Tries again in {again_s:g} s]",
    "port_open": "Control port {port} works again",
    "commander": "Command of the mirror[ taken by {who}][, left by {former}][: {why}]",
    "refused": "Refused {command} of {who}: {reason}",
    "alarms_acknowledged": "Alarms acknowledged by {who}[: {why}]",
    "alarm": "Alarm {alarm}[ to {to}]: {text}",
    "mark": "Mark[ by {who}]: {text}",
}
_UNITS = {"setpoint": "um", "manual": "um/s", "gains": "s on trial"}  # of a command's value
_PART = re.compile(r"\[([^\]]*)\]")
_FIELD = re.compile(r"{(\w+)")
_NOT_TOLD = frozenset({"time_utc", "mono_s", "kind", "crc32"})

_ERRORS = frozenset(
    {"fault", "recorder_error", "unreadable_event", "latch_failed", "lock_not_stored", "child_given_up"}
)
_WARNINGS = frozenset({
    "disk_low", "plausibility", "maintenance", "gains_reverted", "inputs_not_recorded", "shape_unreadable",
    "child_ended", "child_silent", "port_failed", "interlock_opened", "refused", "no_claim", "raw_frames", "lock",
})  # fmt: skip


def sentence(line: EventLine) -> str:
    """One sentence on an event, with the remedy if there is one; never raises.

    An event of an unknown kind, or without what its sentence needs, gives its message or else its fields.
    """
    kind = _kind(line)
    fields = {key: value for key, value in line.items() if key not in _NOT_TOLD and value not in (None, "")}
    unit = _UNITS.get(str(line.get("command")))
    named = fields | ({"unit": unit} if unit else {})
    form = _PART.sub(lambda part: part[1] if _there(part[1], named) else "", _SENTENCES.get(kind, "{message}"))
    if _there(form, named):
        try:
            words = for_people(form.format_map(named))
        except (ValueError, TypeError):  # a number that is none
            pass
        else:
            return words[:1].upper() + words[1:]
    details = [
        f"{key} {value:.6g}" if isinstance(value, float) else f"{key} {value}" for key, value in fields.items()
    ]
    return for_people(f"{kind}: {', '.join(details)}" if details else kind)


def _kind(line: EventLine) -> str:
    return "agreement" if line.get("liar") == "nobody" else str(line.get("kind", "?"))


def _there(form: str, fields: EventLine) -> bool:
    return set(_FIELD.findall(form)) <= set(fields)


def level(line: EventLine) -> str:
    """ERROR: the run is affected; WARN: somebody should look at it; otherwise INFO."""
    kind, word = _kind(line), line.get("state")
    if kind in _ERRORS or (kind == "acquisition" and word == "failed"):
        return "ERROR"
    lost = (kind == "link" and line.get("up") is False) or (kind == "acquisition" and word == "retrying")
    return "WARN" if lost or kind in _WARNINGS or line.get("refused") else "INFO"


def for_people(text: str) -> str:
    """A text of ours as people read it: `µm` for `um`, `±` for `+-`, in one line."""
    return " ".join(re.sub(r"\bu(m|rad)\b", r"µ\1", text).replace("+-", "±").split())
