"""Durations, numbers and texts as commands and reports print them."""

import math

# Every hold starts with some seconds that do not count; more means a ramping setpoint.
_MOVING_LEAST_S = 60.0


def format_span(seconds: float) -> str:
    """A duration: `41 s`, `30 min 5 s`, `7 h 59 min`, `30 d 4 h`."""
    if not math.isfinite(seconds):
        return "?"
    whole = round(seconds)
    for large, small, unit, part in (
        (86400, 3600, "d", "h"),
        (3600, 60, "h", "min"),
        (60, 1, "min", "s"),
    ):
        if whole >= large:
            rest = whole % large // small
            return f"{whole // large} {unit}" + (f" {rest} {part}" if rest else "")
    return f"{whole} s"


def format_number(value: float | None, digits: int = 3) -> str:
    """Format a number to its significant digits, without an exponent for large ones.

    Parameters
    ----------
    value : float or None
        None, NaN and infinity give a dash.
    digits : int
        Significant digits; a number with more digits before the point is rounded to an integer.
    """
    if value is None or not math.isfinite(value):
        return "–"
    if _fits_digits(value, digits):
        return f"{value:.{digits}g}"
    return f"{value:.0f}"


def format_signed(value: float, digits: int = 3) -> str:
    """Format a finite number with its sign, without an exponent for large ones.

    Parameters
    ----------
    value : float
        The number.
    digits : int
        Significant digits; a number with more digits before the point is rounded to an integer.
    """
    if _fits_digits(value, digits):
        return f"{value:+.{digits}g}"
    return f"{value:+.0f}"


def _fits_digits(value: float, digits: int) -> bool:
    """Whether a number, rounded to an integer, has so many digits: 999.6 has four, not three."""
    smallest_of_more = 10.0**digits - 0.5
    return abs(value) < smallest_of_more


def one_line(text: str) -> str:
    """A person's text in one line: spaces replace line ends and other unprintable characters."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


def format_time_beside(
    faults_s: float, paused_s: float, moving_s: float, whole_s: float
) -> list[str]:
    """What there was beside the hold, with its share of the whole time.

    Parameters
    ----------
    faults_s, paused_s, moving_s : float
        Time in faults, paused, and moving or settling; NaN where it is not known.
    whole_s : float
        The whole time.
    """
    parts = (
        ("faults", faults_s, 0.0),
        ("paused", paused_s, 0.0),
        ("moving or settling", moving_s, _MOVING_LEAST_S),
    )
    shown = [(name, time_s) for name, time_s, least_s in parts if time_s > least_s]
    return [
        f"{name} {format_span(time_s)} ({100 * time_s / max(whole_s, time_s):.3g} %)"
        for name, time_s in shown
    ]
