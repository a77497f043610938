"""Times and numbers as people read and write them."""

import contextlib
import math
import re
from datetime import datetime, timedelta

from membrane_ctrl.model.clock import parse_duration_s
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.run_files.run import Run

_LEVEL_S = 60.0


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
    """A number to the given digits; a dash for none."""
    if value is None or not math.isfinite(value):
        return "–"
    return f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:.0f}"


def one_line(text: str) -> str:
    """A person's text in one line: spaces replace line ends and other unprintable characters."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


def moment_s(text: str, origin_utc: datetime) -> float:
    """Seconds of the run for a written time: `03:12[:30]` (UTC), ISO 8601, or `+90s`, `+1h5m` from its start.

    A time of day means its first occurrence after the start of the run. The plus sign may be omitted.

    Raises InputError if it is none of these.
    """
    text = text.strip()
    if re.fullmatch(r"\+? *0+[dhms]?", text):  # the start, which is not a valid duration
        return 0.0
    if text.startswith("+"):
        return parse_duration_s(text[1:])
    clock = re.fullmatch(r"(\d{1,2}):(\d{2})(?::([0-5]\d(?:\.\d+)?))?", text)
    try:
        if clock:
            day = origin_utc.replace(hour=int(clock[1]), minute=int(clock[2]), second=0, microsecond=0)
            moment = day + timedelta(seconds=float(clock[3] or 0))
            # this means the minute in which the run began, not the one of the next day
            if moment < origin_utc - timedelta(seconds=60):
                moment += timedelta(days=1)
        else:
            moment = datetime.fromisoformat(text)
            moment = moment if moment.tzinfo else moment.replace(tzinfo=origin_utc.tzinfo)
    except ValueError:
        with contextlib.suppress(InputError):
            return parse_duration_s(text)
        raise InputError(f"time {text!r}: write 03:12, 2026-11-21T03:12:00 or +90m from the start (UTC)") from None
    return (moment - origin_utc).total_seconds()


def part_s(origin_utc: datetime, start: str | None, end: str | None) -> tuple[float, float]:
    """The part of a run between two written times; None: unlimited. Raises InputError."""
    start_s = -math.inf if start is None else moment_s(start, origin_utc)
    until_s = math.inf if end is None else moment_s(end, origin_utc)
    if not start_s < until_s:
        raise InputError(f"--from {start} is not before --to {end}")
    return start_s, until_s


def end_s(run: Run) -> float:
    """End of a run's data, in seconds from its start, rounded up to whole minutes; 0 without data."""
    time_s = run.level(_LEVEL_S, names=("rows",))["time_s"]
    return float(time_s[-1]) + _LEVEL_S if time_s.size else 0.0


def not_in(run: Run, asked: str) -> InputError:
    """The error for a time outside a run."""
    went = f"{run.utc(0):%Y-%m-%d %H:%M} to {run.utc(end_s(run)):%Y-%m-%d %H:%M} UTC"
    return InputError(f"{asked}: not in the run, which lasted from {went}")


# Every hold starts with some seconds that do not count; more means a ramping setpoint.
_MOVING_LEAST_S = 60.0


def beside(faults_s: float, paused_s: float, moving_s: float, whole_s: float) -> list[str]:
    """What there was beside the hold, with its share of the whole time; NaN where that is not known."""
    parts = (("faults", faults_s, 0.0), ("paused", paused_s, 0.0), ("moving or settling", moving_s, _MOVING_LEAST_S))
    told = [(name, time_s) for name, time_s, least_s in parts if time_s > least_s]
    return [f"{name} {span(time_s)} ({100 * time_s / max(whole_s, time_s):.3g} %)" for name, time_s in told]
