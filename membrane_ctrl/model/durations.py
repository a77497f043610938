"""Durations as people write them (`90s`, `2h30m`), and the wait after failures."""

from __future__ import annotations

import re

from membrane_ctrl.model.errors import InputError
from membrane_ctrl.model.numbers import parse_number

_SECONDS = {"d": 86400.0, "h": 3600.0, "m": 60.0, "s": 1.0}
_LONGEST_S = 1e9  # 31.7 years
_PART = re.compile(r"([0-9]+(?:\.[0-9]+)?)([dhms])")


def pause_s(failures: int, first_s: float = 1.0, longest_s: float = 60.0) -> float:
    """Return the wait after consecutive failures: `first_s`, doubled with each failure, up to
    `longest_s`.

    Parameters
    ----------
    failures : int
        Their number; 0 gives no wait.
    first_s, longest_s : float
        The wait after the first, and the longest one.
    """
    if failures < 1:
        return 0.0
    return min(longest_s, first_s * 2.0 ** min(failures - 1, 32))


def parse_duration_s(text: str) -> float:
    """Seconds of a positive duration such as `90`, `40s`, `3m`, `2h30m` or `1d`.
    Raises InputError.
    """
    compact = text.strip().lower().replace(" ", "")
    try:
        seconds = parse_number(compact)
    except ValueError:
        parts = _PART.findall(compact)
        if not parts or "".join(number + unit for number, unit in parts) != compact:
            raise InputError(
                f"duration {text!r} is not valid; write it like 90s, 3m or 2h30m"
            ) from None
        seconds = sum(float(number) * _SECONDS[unit] for number, unit in parts)
    if not 0 < seconds < _LONGEST_S:
        raise InputError(f"duration {text!r} must be more than 0 and less than 30 years")
    return seconds
