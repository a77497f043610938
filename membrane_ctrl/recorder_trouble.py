"""What keeps the run from being recorded, as its events tell: for everyone who shows the state of the run.

A full disk is the one trouble that `events.jsonl` may not be able to tell of.
"""

from __future__ import annotations

from membrane_ctrl.tick import Event

_GONE = "no recorder runs"
# Of one trouble: it goes into one line of a screen and of a log, each second; the event has all of it
_LONGEST = 300


class RecorderTrouble:
    """The trouble that stands.

    Attributes
    ----------
    standing : dict of str to str
        What has trouble, and the newest words about it; empty when all is recorded.
    """

    def __init__(self) -> None:
        self.standing: dict[str, str] = {}

    def take(self, event: Event) -> None:
        """Take in an event of the run; most change nothing."""
        about = str(event.get("what", ""))
        match event.get("kind"):
            case "recorder_error" | "disk_low":
                self.standing[about] = " ".join(str(event.get("message", "")).split())[:_LONGEST]
            case "recorder_recovered":
                self.standing.pop(about, None)
            case "child_ended" | "child_given_up" if event.get("child") == "recorder":
                self.standing["recorder"] = _GONE
            case "child_restarted" if event.get("child") == "recorder":
                self.standing.clear()  # the next one says anew what still stands

    @property
    def words(self) -> str:
        """All of it in one line; empty when all is recorded."""
        return "; ".join(self.standing.values())
