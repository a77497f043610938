"""Bars made of characters: a level, and a signed history around zero."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.style import Style
from rich.text import Text

_EIGHTHS = " ▁▂▃▄▅▆▇█"


def level_bar(fraction: float, width: int, style: str = "cyan") -> Text:
    """A horizontal bar filled to `fraction` (0..1; NaN is empty) of `width` characters."""
    filled = round(min(max(fraction, 0.0), 1.0) * width) if math.isfinite(fraction) else 0
    return Text("█" * filled, style=style) + Text("░" * (width - filled), style="dim")


def signed_bars(values: Sequence[float], full: float, band: float) -> tuple[Text, Text]:
    """A history as bars that stand on (upper line) and hang from (lower line) a common zero.

    Parameters
    ----------
    values : sequence of float
        One bar each; NaN is a gap. Zero is the thinnest bar upward, so that it differs from a gap.
    full : float
        Value of a bar of full height, to either side.
    band : float
        Bars beyond it are red, the others green.
    """
    upper, lower = Text(), Text()
    for value in values:
        if not math.isfinite(value):
            upper.append(" ")
            lower.append(" ")
            continue
        colour = "green" if abs(value) <= band else "red"
        eighths = min(8, max(1, math.ceil(8 * abs(value) / full)))
        if value >= 0:
            upper.append(_EIGHTHS[eighths], colour)
            lower.append(" ")
        else:
            upper.append(" ")
            # there are no characters that hang: the rest of the cell is drawn in the background's colour instead
            lower.append(_EIGHTHS[8 - eighths], Style(color=colour, reverse=True))
    return upper, lower


def full_scale(values: Sequence[float], least: float) -> float:
    """The smallest of 1, 2, 5 x 10^n that holds all values, and at least `least`."""
    largest = max((abs(value) for value in values if math.isfinite(value)), default=0.0)
    if largest <= least:
        return least
    decade = 10.0 ** math.floor(math.log10(largest))
    return next(step * decade for step in (1.0, 2.0, 5.0, 10.0) if largest <= step * decade * (1 + 1e-9))
