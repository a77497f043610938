"""Events of the controller, one class per kind; `event_lines` reads all kinds."""

from enum import StrEnum
from typing import Any

from membrane_ctrl.model.event_base import Event as Event
from membrane_ctrl.model.event_base import EventLine as EventLine
from membrane_ctrl.model.event_base import LogLevel
from membrane_ctrl.model.notices import GLITCH_S, Notice, NoticeChanges, NoticeKey, Notices, Topic

_COMMAND_UNITS = {"setpoint": "µm", "manual": "µm/s", "gains": "s on trial"}  # of a command's value
# others: "command"
_COMMAND_MARKS = {
    "setpoint": "setpoint",
    "pause": "pause",
    "resume": "pause",
    "mark": "mark",
}


class StateEntered(
    Event,
    kind="state",
    sentence="State {state}[, from {from}][: {why}]",
    opens=(Topic.FAULT,),
    closes=(Topic.FAULT, Topic.GLITCH),
    notable=True,
):
    """The state machine entered another state."""

    state: str
    from_: str
    why: str

    def notice_changes(self, standing: Notices) -> NoticeChanges:
        """Latch a fault that has held the flow for too long;
        end all faults with the state `fault`.
        """
        if self.from_ == "fault":
            return NoticeChanges(closed=tuple(NoticeKey(topic) for topic in self.closes))
        glitch = standing.get(NoticeKey(Topic.GLITCH))
        if self.state == "fault" and glitch is not None:
            return NoticeChanges(opened=(latched_notice(glitch.text),))
        return NoticeChanges()


class Why(Event, kind="why", sentence="{why}"):
    """The operator's line changed; `code` names the reason (`reason.WhyCode`)."""

    why: str
    code: str = ""


class Fault(
    Event,
    kind="fault",
    sentence="Fault {name}[: {cause}][ ({seen})][. Do: {remedy}][. Limit: {limit}][; safe level "
    "{safe_level}]",
    level=LogLevel.ERROR,
    opens=(Topic.FAULT, Topic.GLITCH),
    delay_s=GLITCH_S,
    urgent=True,
):
    """A rule of the safety table tripped."""

    code: int
    name: str
    cause: str
    seen: str
    limit: str
    safe_level: str
    latching: bool
    remedy: str

    @property
    def plot_mark(self) -> str:
        """A line of faults."""
        return "fault"

    def notice_changes(self, standing: Notices) -> NoticeChanges:
        """Open the notice of a latched fault, or of one that only holds the flow so far."""
        if self.latching:
            return NoticeChanges(opened=(latched_notice(self.sentence),))
        return NoticeChanges(opened=(self._make_notice(NoticeKey(Topic.GLITCH)),))


def latched_notice(text: str) -> Notice:
    """Return the notice of a latched fault: each is a new alarm."""
    return Notice(NoticeKey(Topic.FAULT), text, severity="critical", always_new=True)


class Cleared(
    Event,
    kind="cleared",
    sentence="Fault[ {name}] is over: its cause has gone",
    closes=(Topic.GLITCH,),
):
    """The cause of a fault that only held the flow has gone."""

    name: str


class ShortLosses(
    Event,
    kind="short_losses",
    sentence="Fault {name} repeats: {count} times within {over_min:g} min, each for less than a "
    "second. Such faults are counted and not listed. Do: look for the cause of the short losses",
    level=LogLevel.WARNING,
):
    """Short faults repeat; one such event when that begins, then one an hour with their count."""

    name: str
    count: int
    over_min: float


class Resumed(
    Event, kind="resumed", sentence="Fault {name} is cleared by the resume rule", notable=True
):
    """A latched fault was cleared by the resume rule."""

    name: str


class ShapeLoopState(Event, kind="shape", sentence="Shape loop {state}[: {reason}]"):
    """The shape loop's state, or the reason for it, changed; `code` names the reason."""

    state: str
    reason: str
    code: str = ""


class HeldScalarState(Event, kind="held", sentence="Held {holds}: {state}[: {reason}]"):
    """What is held besides the centre is followed, or the centre is held at the last offset, and
    why; `code` names the reason.
    """

    holds: str
    state: str
    offset_um: float
    reason: str
    code: str = ""
    sigma_um: float | None = None


class CommandTaken(
    Event,
    kind="command",
    sentence='Command {command}[ {value:g} {unit}][ "{text}"][ by {who}][: {why}][. Refused: '
    "{refused}]",
    notable=True,
):
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

    @property
    def level(self) -> LogLevel:
        """A refused command is a warning."""
        if self.refused:
            return LogLevel.WARNING
        return LogLevel.INFO

    @property
    def unit(self) -> str:
        """Unit of the value."""
        return _COMMAND_UNITS.get(self.command, "")

    @property
    def plot_mark(self) -> str:
        """A line of the command, unless it was refused."""
        if self.refused:
            return ""
        return _COMMAND_MARKS.get(self.command, "command")


class LockSet(
    Event,
    kind="lock",
    sentence='Locked by {author}[ ({session})][, {set_utc}]: "{text}", word {word}',
    level=LogLevel.WARNING,
    opens=(Topic.LOCK,),
    subject="word",
):
    """A person locked the mirror, or the run started with a lock of an earlier one."""

    word: str
    text: str
    author: str
    account: str
    session: str
    set_utc: str
    number: int  # of the request; 0: from the start of the run


class LockRemoved(
    Event,
    kind="unlock",
    sentence='Lock "{text}" of {author} removed by {remover} (by its {how})',
    closes=(Topic.LOCK, Topic.LOCK_STORAGE),
    subject="word",
):
    """A person removed a lock: its author, or somebody who typed its word (`how`)."""

    word: str
    text: str
    author: str
    set_utc: str
    remover: str
    how: str
    number: int


class GainsReverted(
    Event,
    kind="gains_reverted",
    sentence="Gains on trial are reverted: {why}",
    level=LogLevel.WARNING,
):
    """Gains on trial were reverted."""

    why: str


class ExperimentEnded(
    Event, kind="experiment", sentence="Experiment {experiment} ended[: {reason}]", notable=True
):
    """An experiment is over; `end` is how (`machine.ExperimentEnd`)."""

    experiment: str
    completed: bool
    reason: str
    end: str


class FaultySensor(StrEnum):
    """Which sensor contradicts the others."""

    NONE = "none"
    UNKNOWN = "unknown"
    LASER = "laser"
    OPTICS = "optics"


class Plausibility(
    Event,
    kind="plausibility",
    sentence="Laser and camera disagree[, {faulty_sensor} is wrong][ ({readings})]. Do: check the laser's "  # noqa: E501
    "mount, the "
    "camera and the screen",
    level=LogLevel.WARNING,
    opens=(Topic.PLAUSIBILITY,),
    closes=(Topic.PLAUSIBILITY,),
):
    """Which of laser, gauge and camera is wrong now, if any (`FaultySensor`)."""

    faulty: FaultySensor
    readings: str

    @property
    def opens_notice(self) -> bool:
        """Whether one of them is wrong."""
        return self.faulty is not FaultySensor.NONE

    @property
    def faulty_sensor(self) -> str:
        """The wrong one; empty if that is not known."""
        return {FaultySensor.LASER: "the laser", FaultySensor.OPTICS: "the camera"}.get(
            self.faulty, ""
        )

    @property
    def level(self) -> LogLevel:
        """An agreement is no warning."""
        if self.opens_notice:
            return LogLevel.WARNING
        return LogLevel.INFO

    def _choose_template(self) -> str:
        if self.opens_notice:
            return self._template
        return "Laser and camera agree again[ ({readings})]"


class SensorsUsed(
    Event,
    kind="sensors_used",
    sentence="The centre is estimated from {sensors}[; jumped: {jumped}]",
):
    """Which sensors the estimate of the centre follows now, and which of them have jumped, with the
    distance.
    """

    sensors: tuple[str, ...]
    jumped: tuple[str, ...]


class Maintenance(
    Event,
    kind="maintenance",
    sentence="Maintenance {name}: {message}",
    level=LogLevel.WARNING,
    opens=(Topic.MAINTENANCE,),
    subject="name",
):
    """Something is wearing out, or will need attention."""

    name: str
    message: str


class MaintenanceOver(
    Event,
    kind="maintenance_over",
    sentence="Maintenance {name} is over[: {message}]",
    closes=(Topic.MAINTENANCE,),
    subject="name",
):
    """A maintenance notice no longer applies."""

    name: str
    message: str


class PumpLearned(
    Event,
    kind="pump",
    sentence="The pump gives {scale:.3f} of its curve, +- {sigma:.3f}; the loop uses {correction:.3f}",  # noqa: E501
):
    """What is known of the pump: its flow relative to the configured curve, one standard error, the
    scale in use.
    """

    scale: float
    sigma: float
    correction: float


class PumpResponseFound(
    Event,
    kind="pump_response",
    sentence="The pump responds after a dead time of {delay_s:.2f} ± {delay_sigma_s:.2f} s with a "
    "lag of {lag_s:.2f} ± {lag_sigma_s:.2f} s; together {sum_s:.2f} ± {sum_sigma_s:.2f} s",
):
    """Dead time and lag of the pump, as the test of the actuators found them, with their standard
    deviations.
    """

    delay_s: float
    delay_sigma_s: float
    lag_s: float
    lag_sigma_s: float
    sum_s: float
    sum_sigma_s: float


class GainsLimited(
    Event,
    kind="gains_limited",
    sentence="The gains are limited to Kp {kp_per_s:.3g} 1/s and Ti {ti_s:.3g} s, as the pump is "
    "slow; stated were {stated_kp_per_s:g} 1/s and {stated_ti_s:g} s. `tune run` finds better ones",
    notable=True,
):
    """The pump's identified response forbids the stated gains: those in use, and the stated."""

    kp_per_s: float
    ti_s: float
    stated_kp_per_s: float
    stated_ti_s: float


class PumpStronger(
    Event,
    kind="pump_stronger",
    sentence="The pump gives about {flow_full_um_per_s:.3g} µm/s, not {assumed_um_per_s:.3g}: the "
    "loop takes it as a straight line until `tune pump` measures it",
    notable=True,
):
    """A pump whose curve is not stated is much stronger than the default one."""

    flow_full_um_per_s: float
    assumed_um_per_s: float


class ProcessValueChosen(
    Event, kind="process_value", sentence="The loop follows the {value}: {reason}"
):
    """What the inner loop follows with `process_value = "auto"`; `code` names the reason
    (`process_value_reason.ProcessValueReason`).
    """

    value: str
    reason: str
    code: str


class InterlockOpened(
    Event,
    kind="interlock_opened",
    sentence="Interlock {name} is open[: {text}]",
    level=LogLevel.WARNING,
    opens=(Topic.INTERLOCK,),
    subject="name",
):
    """The circuit of an interlock opened, or its signal was lost; `text` is the configuration's,
    for people.
    """

    name: str
    text: str
    safe_level: str


class InterlockClosed(
    Event,
    kind="interlock_closed",
    sentence="Interlock {name} is closed",
    closes=(Topic.INTERLOCK,),
    subject="name",
):
    """The circuit of an interlock is closed again."""

    name: str
