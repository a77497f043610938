"""Numbers and times as a person reads them; a dash where there is none."""

from __future__ import annotations

import math

NONE = "–"


def number(value: float, digits: int, unit: str = "", sign: bool = False) -> str:
    """`value` with its unit."""
    if not math.isfinite(value):
        return NONE
    figure = f"{value:{'+' if sign else ''}.{digits}f}"
    return f"{figure} {unit}" if unit else figure


def percent(fraction: float, digits: int = 0) -> str:
    """A fraction as a percentage."""
    return number(100.0 * fraction, digits, "%")


def duration(seconds_s: float) -> str:
    """A time span: 7 s, 2:05, 3:02:05, 4 d 03:02:05."""
    if not math.isfinite(seconds_s):
        return NONE
    minutes, seconds = divmod(int(seconds_s), 60)
    hours, minutes = divmod(minutes, 60)
    days, hours = divmod(hours, 24)
    if days:
        return f"{days} d {hours:02}:{minutes:02}:{seconds:02}"
    if hours:
        return f"{hours}:{minutes:02}:{seconds:02}"
    return f"{minutes}:{seconds:02}" if minutes else f"{seconds} s"
