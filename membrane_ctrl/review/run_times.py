"""Times of a run as people write them: `03:12`, ISO 8601, `+90m`."""

import contextlib
import math
import re
from datetime import datetime, timedelta

from membrane_ctrl.model import errors
from membrane_ctrl.model.durations import parse_duration_s

_START = re.compile(r"\+? *0+[dhms]?")
_CLOCK = re.compile(r"(\d{1,2}):(\d{2})(?::([0-5]\d(?:\.\d+)?))?")


def moment_s(text: str, origin_utc: datetime) -> float:
    """Return the seconds of the run of a written time: `03:12[:30]` (UTC), ISO 8601, or `+90s`,
    `+1h5m` from its start.

    A time of day means its first occurrence after the start of the run. The plus sign may be
    omitted.

    Raises InputError if it is none of these.

    Parameters
    ----------
    text : str
        As a person wrote it.
    origin_utc : datetime
        Start of the run.
    """
    # Counted from the start; 0 is no valid duration.
    text = text.strip()
    if _START.fullmatch(text):
        return 0.0
    if text.startswith("+"):
        return parse_duration_s(text[1:])

    # A time of day, or ISO 8601; what is neither may be a duration without its sign.
    clock = _CLOCK.fullmatch(text)
    try:
        if clock:
            day = origin_utc.replace(
                hour=int(clock[1]), minute=int(clock[2]), second=0, microsecond=0
            )
            moment = day + timedelta(seconds=float(clock[3] or 0))
            # this means the minute in which the run began, not the one of the next day
            if moment < origin_utc - timedelta(seconds=60):
                moment += timedelta(days=1)
        else:
            moment = datetime.fromisoformat(text)
            if moment.tzinfo is None:
                moment = moment.replace(tzinfo=origin_utc.tzinfo)
    except ValueError:
        with contextlib.suppress(errors.InputError):
            return parse_duration_s(text)
        raise errors.InputError(
            f"time {text!r}: write 03:12, 2026-11-21T03:12:00 or +90m from the start (UTC)"
        ) from None
    return (moment - origin_utc).total_seconds()


def is_from_start(text: str) -> bool:
    """Whether a time that `moment_s` accepts is counted from the start of the run."""
    text = text.strip()
    if _START.fullmatch(text) or text.startswith("+"):
        return True
    if _CLOCK.fullmatch(text):
        return False
    try:
        datetime.fromisoformat(text)
    except ValueError:
        return True
    return False


def part_s(origin_utc: datetime, start: str | None, end: str | None) -> tuple[float, float]:
    """Return the part of a run between two written times.

    Parameters
    ----------
    origin_utc : datetime
        Start of the run.
    start, end : str or None
        As a person wrote them; None is unlimited.

    Returns
    -------
    tuple[float, float]
        First and last second; infinite if unlimited.

    Raises
    ------
    InputError
        A text is no time, or the first is not before the last.
    """
    start_s = -math.inf if start is None else moment_s(start, origin_utc)
    until_s = math.inf if end is None else moment_s(end, origin_utc)
    if not start_s < until_s:
        raise errors.InputError(f"--from {start} is not before --to {end}")
    return start_s, until_s
