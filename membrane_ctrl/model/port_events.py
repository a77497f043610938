"""Events of the control port and of the alarms."""

from membrane_ctrl.model.event_base import Event, LogLevel
from membrane_ctrl.model.notices import GLITCH_S, Topic


class PortAddresses(Event, kind="port", sentence="Control port open[ on {socket}]"):
    """Where the control port listens."""

    socket: str | None = None


class PortFailed(
    Event,
    kind="port_failed",
    sentence="Control port {port} failed: {message}[. Tries again in {again_s:g} s]",
    level=LogLevel.WARNING,
    opens=(Topic.PORT,),
    subject="port",
    delay_s=GLITCH_S,
):
    """A listener or one of its clients failed."""

    port: str
    message: str
    again_s: float | None = None

    @property
    def opens_notice(self) -> bool:
        """Whether the listener failed, which ends with `PortOpen`; a failed client is gone."""
        return self.again_s is not None


class PortOpen(
    Event,
    kind="port_open",
    sentence="Control port {port} works again",
    closes=(Topic.PORT,),
    subject="port",
):
    """The listener works again."""

    port: str


class CommanderChanged(
    Event, kind="commander", sentence="Control taken by {who}[ (previously {former})][: {why}]"
):
    """Who has command now, and who had it before."""

    who: str | None
    former: str | None
    why: str

    def _choose_template(self) -> str:
        if self.who:
            return self._template
        return "Control released[ by {former}][: {why}]"


class Refused(
    Event, kind="refused", sentence="Refused {command} of {who}: {reason}", level=LogLevel.WARNING
):
    """The port refused a request, and perhaps others not recorded."""

    who: str
    command: str
    why: str
    reason: str
    and_unrecorded: int | None = None


class AlarmsAcknowledged(
    Event,
    kind="alarms_acknowledged",
    sentence="Alarms acknowledged by {who}[: {why}]",
    notable=True,
):
    """Somebody acknowledged all alarms."""

    who: str
    why: str


class AlarmSent(Event, kind="alarm", sentence="Alarm {alarm}[ to {to}]: {text}"):
    """An alarm's notice was sent, or failed."""

    alarm: str
    what: str
    severity: str
    text: str
    to: str
    sent: bool
    escalated: bool
