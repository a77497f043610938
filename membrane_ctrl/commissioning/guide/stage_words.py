"""Numbers for people."""

import math


def format_duration(seconds: float) -> str:
    """A duration in a fitting unit: `45 s`, `12 min`, `2.1 h`; `never` for infinity."""
    if not math.isfinite(seconds):
        return "never"
    if seconds < 120:
        return f"{seconds:.0f} s"
    if seconds < 7200:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
