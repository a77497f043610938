"""Events of the control process other than the controller's, and marks by people.

`event_lines` reads events of all kinds back from their lines.
"""

from membrane_ctrl.model.event_base import Event, LogLevel
from membrane_ctrl.model.notices import GLITCH_S, Topic

_ENDED_WELL = frozenset({"done", "interrupted"})
# The recorder writes these when the control process has gone
ENDS_WITHOUT_CONTROL = frozenset({"killed", "terminated"})


class Started(
    Event,
    kind="start",
    sentence="Run started[ on {devices}][, {priority} priority][; {message}][; {program}]",
    notable=True,
):
    """The run starts, under a program with its commit."""

    devices: str
    priority: str
    message: str
    program: str | None = None


class MachineUsed(
    Event,
    kind="machine",
    sentence="The ticks run with {scheduling}; memory: {memory}; processors: {processors}; clock: "
    "{clock_source}",
):
    """What the machine grants the process of the ticks."""

    scheduling: str
    memory: str
    memory_locked: bool
    processors: str
    clock_source: str


class FigureModeChosen(
    Event,
    kind="figure_mode",
    sentence="Figures are measured by `{mode}`: {reason} ({processors} processors, {figure_ms:g} ms a figure)",  # noqa: E501
):
    """How figures are measured with `shape.mode = "auto"`, and what the machine offers."""

    mode: str
    reason: str
    processors: int
    figure_ms: float


class Ended(
    Event,
    kind="end",
    sentence="Run ended: {exit}",
    opens=(Topic.RUN_END,),
    severity="critical",
    notable=True,
    urgent=True,
):
    """The run is over; without the control process only `exit` is recorded."""

    exit: str
    exit_code: int | None = None
    ticks: int | None = None
    missed_ticks: int | None = None

    @property
    def opens_notice(self) -> bool:
        """Whether neither a person nor its duration ended it."""
        return self.exit not in _ENDED_WELL


class NoClaim(Event, kind="no_claim", level=LogLevel.WARNING):
    """The board cannot reserve itself for one program."""

    message: str


class _LinkReport:
    """Common to the events of a link, which fails and returns."""

    up: bool

    @property
    def opens_notice(self) -> bool:
        """Whether it failed."""
        return not self.up

    @property
    def level(self) -> LogLevel:
        """A failure is a warning."""
        if self.up:
            return LogLevel.INFO
        return LogLevel.WARNING


class Link(
    _LinkReport,
    Event,
    kind="link",
    sentence="Link to the pump board: {message}[ ({count} failures since the last report)]",
    opens=(Topic.LINK,),
    closes=(Topic.LINK,),
    delay_s=GLITCH_S,
):
    """The link to the board, or to the pump of a bench of single devices, failed or returned."""

    message: str
    up: bool
    count: int | None = None  # of failures since the last such event, if more than one


class SensorLink(
    _LinkReport,
    Event,
    kind="sensor_link",
    sentence="Link to {role}: {message}[ ({count} failures since the last report)]",
    opens=(Topic.LINK,),
    closes=(Topic.LINK,),
    subject="role",
    delay_s=GLITCH_S,
):
    """The link to a sensor on a separate line failed or returned."""

    role: str
    message: str
    up: bool
    count: int | None = None  # of failures since the last such event, if more than one


class InputsNotRecorded(Event, kind="inputs_not_recorded", level=LogLevel.WARNING):
    """Some ticks cannot be replayed."""

    message: str


class SnapshotNotRecorded(Event, kind="snapshot_not_recorded", level=LogLevel.WARNING):
    """No replay can start at this moment; later snapshots may be recorded."""

    message: str


class ShapeUnreadable(Event, kind="shape_unreadable", level=LogLevel.WARNING):
    """A message of the acquisition is unreadable."""

    message: str


class UnreadableEvent(Event, kind="unreadable_event", level=LogLevel.ERROR):
    """A message that is no event."""

    message: str


class LatchFailed(
    Event,
    kind="latch_failed",
    sentence="The latched fault is not on the disk: {message}. Do: mend the disk; until then the next "  # noqa: E501
    "start would "
    "not see the fault",
    level=LogLevel.ERROR,
    opens=(Topic.LATCH,),
    severity="critical",
):
    """The latched fault's file could not be written."""

    message: str


class LatchWritten(
    Event,
    kind="latch_written",
    sentence="The latched fault's file is written again",
    closes=(Topic.LATCH,),
):
    """The latched fault's file is written again."""


class LockNotStored(
    Event,
    kind="lock_not_stored",
    sentence="The lock {word} is not stored: {message}. Do: mend the disk; until then it is "
    "valid in this run only",
    level=LogLevel.ERROR,
    opens=(Topic.LOCK_STORAGE,),
    subject="word",
    severity="critical",
):
    """A lock, or its removal, is not on the disk."""

    word: str
    message: str


class LockStored(
    Event,
    kind="lock_stored",
    sentence="The lock {word} is stored",
    closes=(Topic.LOCK_STORAGE,),
    subject="word",
):
    """A lock, or its removal, that had failed is on the disk."""

    word: str


class Mark(Event, kind="mark", sentence="Mark[ by {who}]: {text}", notable=True):
    """A remark on a moment of the run."""

    text: str
    who: str
    made_utc: str | None = None  # after the run

    @property
    def plot_mark(self) -> str:
        """A line of marks."""
        return "mark"
