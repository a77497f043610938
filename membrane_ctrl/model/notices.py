"""Notices: conditions that stand from one event to another. Displays list them, and alarms are sent
about them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, NamedTuple

Severity = Literal["warning", "critical"]

# A condition that lasts shorter than this, such as a fault for a few samples, raises no alarm.
GLITCH_S = 5.0
_SHORT_CHARACTERS = 300


class Topic(StrEnum):
    """What a notice is about; the alarms are named by it."""

    FAULT = "fault"  # latched
    GLITCH = "glitch"  # a fault that holds the flow
    LOCK = "lock"
    LOCK_STORAGE = "lock_storage"
    INTERLOCK = "interlock"
    MAINTENANCE = "maintenance"
    PLAUSIBILITY = "plausibility"
    LINK = "link"
    CHILD = "child"
    RECORDING = "recorder"
    PORT = "port"
    LATCH = "latch"
    RUN_END = "run_ended"


# Displays show these with more details than the notice has: the fault with its remedy, locks with
# author and word.
SHOWN_WITH_DETAILS = frozenset({Topic.FAULT, Topic.GLITCH, Topic.LOCK, Topic.LOCK_STORAGE})


class NoticeKey(NamedTuple):
    """Identifies a notice: its topic, and which of several under the topic."""

    topic: Topic
    subject: str = ""

    @property
    def alarm(self) -> str:
        """Name of the alarm about it; several notices may be one alarm, as all files on a full disk
        are.
        """
        if self.topic is Topic.MAINTENANCE:
            return f"maintenance_{self.subject}"
        if self.topic is Topic.CHILD:
            return f"{self.subject}_ended"
        return self.topic.value


@dataclass(frozen=True, slots=True)
class Notice:
    """A condition that stands."""

    key: NoticeKey
    text: str  # one sentence
    severity: Severity = "warning"
    delay_s: float = 0.0  # an alarm is sent once it has stood for so long
    # Once it is over, the next one is a new alarm, however soon; otherwise a condition that soon
    # returns is the same.
    always_new: bool = False

    @property
    def short_text(self) -> str:
        """The text for displays that repeat it all the time; the event has all of it."""
        return self.text[:_SHORT_CHARACTERS]


Notices = Mapping[NoticeKey, Notice]  # those that stand, oldest first


class NoticeChanges(NamedTuple):
    """What an event changes: the notices that it closes, then those that it opens."""

    closed: tuple[NoticeKey, ...] = ()
    opened: tuple[Notice, ...] = ()


def apply_changes(standing: Notices, changes: NoticeChanges) -> Notices:
    """Return the notices that are open after an event.

    Parameters
    ----------
    standing : mapping of NoticeKey to Notice
        Those before the event, oldest first; not changed.
    changes : NoticeChanges
        What the event closes, and then opens. A notice that is opened again keeps its place.
    """
    if not changes.closed and not changes.opened:
        return standing
    closed = frozenset(changes.closed)
    remaining = {key: notice for key, notice in standing.items() if key not in closed}
    return remaining | {notice.key: notice for notice in changes.opened}
