"""Events of child processes: alive, ended, silent, restarted."""

from membrane_ctrl.model.event_base import Event, LogLevel
from membrane_ctrl.model.notices import GLITCH_S, NoticeChanges, NoticeKey, Notices, Topic

RECORDER = "recorder"  # its name as a child


class Alive(Event, kind="alive", sentence="Alive for {for_s:g} s"):
    """A child's sign of life; sent only on its pipe."""

    for_s: float


class ChildEnded(
    Event,
    kind="child_ended",
    sentence="The {child} process ended[ with exit code {exit_code}]; the hold continues",
    level=LogLevel.WARNING,
    opens=(Topic.CHILD,),
    subject="child",
    delay_s=GLITCH_S,
):
    """A child process has ended."""

    child: str
    exit_code: int | None


class ChildSilent(
    Event,
    kind="child_silent",
    sentence="The {child} process does not answer; the hold continues",
    level=LogLevel.WARNING,
    opens=(Topic.CHILD,),
    subject="child",
    delay_s=GLITCH_S,
):
    """A child has not reported that it is alive."""

    child: str
    overdue_s: float
    killed: bool


class ChildRestarted(
    Event,
    kind="child_restarted",
    sentence="The {child} process was replaced (replacement {restarts})",
    closes=(Topic.CHILD, Topic.RECORDING),
    subject="child",
):
    """A child was replaced."""

    child: str
    restarts: int

    def notice_changes(self, standing: Notices) -> NoticeChanges:
        """End the notice of the child; a new recorder reports again what fails, so end those of the
        former one.
        """
        closed = [NoticeKey(Topic.CHILD, self.child)]
        if self.child == RECORDER:
            closed += [key for key in standing if key.topic is Topic.RECORDING]
        return NoticeChanges(closed=tuple(closed))


class ChildGivenUp(
    Event,
    kind="child_given_up",
    sentence="The {child} process ended too often and is not replaced for an hour. Do: check the run",  # noqa: E501
    level=LogLevel.ERROR,
    opens=(Topic.CHILD,),
    subject="child",
):
    """A child has ended too often in an hour."""

    child: str
    restarts: int
