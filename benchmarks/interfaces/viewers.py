"""A hold with its page, fifty viewers and one that has stopped reading: do its ticks notice?"""

from __future__ import annotations

from tests.studies.viewers import measure_viewers
from tests.support.figures import Figure


def run() -> list[Figure]:
    """Figures of one hold."""
    return measure_viewers()
