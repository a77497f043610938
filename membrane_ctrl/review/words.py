"""Times and numbers as people read them."""

import math
import re
from datetime import datetime, timedelta

from membrane_ctrl.model.clock import parse_duration_s
from membrane_ctrl.model.errors import InputError


def span(seconds: float) -> str:
    """A duration: `41 s`, `30 min 5 s`, `7 h 59 min`, `30 d 4 h`."""
    if not math.isfinite(seconds):
        return "?"
    whole = round(seconds)
    for large, small, unit, part in ((86400, 3600, "d", "h"), (3600, 60, "h", "min"), (60, 1, "min", "s")):
        if whole >= large:
            rest = whole % large // small
            return f"{whole // large} {unit}" + (f" {rest} {part}" if rest else "")
    return f"{whole} s"


def number(value: float | None, digits: int = 3) -> str:
    """A number to so many digits; a dash for none."""
    if value is None or not math.isfinite(value):
        return "–"
    return f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:.0f}"


def one_line(text: str) -> str:
    """What people wrote, in one line: a space for line ends and whatever else cannot be printed."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


def moment_s(text: str, origin_utc: datetime) -> float:
    """Seconds of the run for a moment as written: `03:12[:30]` (UTC), ISO 8601, or `+90s`, `+1h5m` from its start.

    A time of the day is the first such after the start of the run.

    Raises InputError if it is none of these.
    """
    text = text.strip()
    if re.fullmatch(r"\+ *0+[dhms]?", text):  # the start: no duration, but a moment
        return 0.0
    if text.startswith("+"):
        return parse_duration_s(text[1:])
    clock = re.fullmatch(r"(\d{1,2}):(\d{2})(?::([0-5]\d(?:\.\d+)?))?", text)
    try:
        if clock:
            day = origin_utc.replace(hour=int(clock[1]), minute=int(clock[2]), second=0, microsecond=0)
            moment = day + timedelta(seconds=float(clock[3] or 0))
            # the minute in which the run began is meant, not the one of the next day
            if moment < origin_utc - timedelta(seconds=60):
                moment += timedelta(days=1)
        else:
            moment = datetime.fromisoformat(text)
            moment = moment if moment.tzinfo else moment.replace(tzinfo=origin_utc.tzinfo)
    except ValueError:
        raise InputError(f"time {text!r}: write 03:12, 2026-11-21T03:12:00 or +90m from the start (UTC)") from None
    return (moment - origin_utc).total_seconds()
