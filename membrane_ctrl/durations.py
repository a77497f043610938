"""Durations as people write them: `90`, `40s`, `3m`, `2h30m`, `1d`."""

from __future__ import annotations

import re

from membrane_ctrl.errors import InputError

_SECONDS = {"d": 86400.0, "h": 3600.0, "m": 60.0, "s": 1.0}
_PART = re.compile(r"(\d+(?:\.\d+)?)([dhms])")


def parse_duration_s(text: str) -> float:
    """Seconds of a duration; a bare number is seconds.

    Raises
    ------
    InputError
        If the text is not a positive duration.
    """
    compact = text.strip().lower().replace(" ", "")
    try:
        seconds = float(compact)
    except ValueError:
        parts = _PART.findall(compact)
        if not parts or "".join(number + unit for number, unit in parts) != compact:
            raise InputError(f"duration {text!r} is not understood; write it like 90s, 3m or 2h30m") from None
        seconds = sum(float(number) * _SECONDS[unit] for number, unit in parts)
    if not 0 < seconds < 1e9:
        raise InputError(f"duration {text!r} must be more than 0")
    return seconds
