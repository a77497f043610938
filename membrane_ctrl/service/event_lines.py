"""The events of a run as lines for people, and which of them a viewer has not seen."""

from datetime import datetime

from membrane_ctrl.model.event_base import Event

SHOWN_MOST = 200


def format_event(utc: datetime, event: Event) -> str:
    """The line of an event: a run may last for weeks, so it has the date.

    Parameters
    ----------
    utc : datetime
        When it happened, in UTC.
    event : Event
        Its sentence is the rest of the line.
    """
    return f"{utc:%m-%d %H:%M:%S} UTC  {event.sentence}"


def find_new_lines(old: tuple[str, ...], new: tuple[str, ...]) -> tuple[str, ...]:
    """The lines of `new` after those of `old`.

    Parameters
    ----------
    old, new : tuple of str
        Lines at two moments. Both are the newest lines of one growing list, at most `SHOWN_MOST`:
        the first of `old` may have been dropped since.

    Returns
    -------
    tuple of str
        All of `new` if the two have nothing in common.
    """
    return next(
        new[len(old) - gone :]
        for gone in range(len(old) + 1)
        if old[gone:] == new[: len(old) - gone]
    )
