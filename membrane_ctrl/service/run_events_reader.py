"""The events of a running hold, each once: those that its file holds, then those of its ring."""

from __future__ import annotations

from collections.abc import Sequence

from membrane_ctrl.model import event_lines
from membrane_ctrl.model.events import EventLine
from membrane_ctrl.processes.ring import RingReader


class RunEventsReader:
    """Reads the events of a run.

    A service may start in the middle of a run. The ring then holds the newest events, and the file
    those before, up to a second ago: some are in both.

    Parameters
    ----------
    recorded : sequence of EventLine
        Of the file, read after the ring was attached.
    ring : RingReader or None
        At its oldest message; None if the run has none that may be read.
    """

    def __init__(self, recorded: Sequence[EventLine], ring: RingReader | None) -> None:
        self._recorded = list(recorded)
        self._known = {_identify(line) for line in recorded}
        self._ring = ring

    def read_new(self) -> list[EventLine]:
        """The events since the last call, oldest first; with the first call, those of the file."""
        messages = [] if self._ring is None else self._ring.drain()
        lines = [event_lines.parse_event(message) for message in messages]
        found = self._recorded + [line for line in lines if _identify(line) not in self._known]
        self._recorded = []
        return found


def _identify(line: EventLine) -> tuple[object, ...]:
    """What an event has in the file and in the ring."""
    return tuple(sorted((key, repr(value)) for key, value in line.items()))
