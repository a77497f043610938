"""Numbers that a person or another program gives as text.

Python's own `float` also accepts underscores, digits of every script, `nan` and `inf`. A value that
moves gas must have one reading only, so every text interface (page, `ctl`, bridges, durations) uses
the stricter rule below.
"""

from __future__ import annotations

import math
import re

TEXT_LENGTH_MAX = 64  # the longest exact double in plain notation with 17 digits needs fewer
_PLAIN = re.compile(r"[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]+)?")


def parse_number(text: str) -> float:
    """Parse a decimal number.

    Parameters
    ----------
    text
        Optional sign, ASCII digits with at most one decimal point, optional exponent: `-1.5`, `.5`,
        `2e-3`. No blanks, no underscores, no separators of thousands, no decimal comma, no `nan` or
        `inf`.

    Returns
    -------
    float
        A finite number.

    Raises
    ------
    ValueError
        With one line that names the text and the reason.
    """
    if len(text) > TEXT_LENGTH_MAX:
        raise ValueError(
            f"{text[:16]!r}... is not a number: {len(text)} characters, at most {TEXT_LENGTH_MAX}"
        )
    if "," in text:
        raise ValueError(
            f"{text!r} has a comma; write a point before the decimals, and nothing between "
            "thousands"
        )
    if _PLAIN.fullmatch(text) is None:
        raise ValueError(f"{text!r} is not a plain decimal number such as -1.5 or 2e-3")
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text!r} is too large")
    return value
