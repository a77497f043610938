"""Measured data that are not part of the product: where they are, and the note where they are not.

Tests of real frames run wherever the folder `shared/data` stands beside the checkout or a folder
that contains it, or where `MEMBRANE_REAL_DATA` names it. Elsewhere they are skipped, and the test
run ends with a line about it.
"""

import os
from collections.abc import Sequence
from pathlib import Path

MISSING = "no measured frames"
_CHECKOUT = Path(__file__).parents[2]
_VARIABLE = "MEMBRANE_REAL_DATA"


def find_real_data(checkout: Path = _CHECKOUT) -> Path:
    """Return the folder of measured data; the place beside the checkout if there is none."""
    named = os.environ.get(_VARIABLE)
    if named:
        return Path(named)
    places = [folder / "shared" / "data" for folder in checkout.parents]
    return next((place for place in places if place.is_dir()), places[0])


SOFAST = find_real_data() / "sofast"
WHY_SKIPPED = f"{MISSING} in {SOFAST}; {_VARIABLE} names another folder"


def describe_skipped_frames(reasons: Sequence[str]) -> str:
    """How many of the tests with these reasons lack measured frames, in a line; empty for none."""
    missing = [reason for reason in reasons if MISSING in reason]
    if not missing:
        return ""
    return f"{len(missing)} tests of real frames were skipped: {WHY_SKIPPED}"
