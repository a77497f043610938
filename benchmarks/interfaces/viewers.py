"""The ticks of a hold whose page has fifty viewers, one of which has stopped reading."""

from __future__ import annotations

from tests.studies.viewers import measure_viewers
from tests.support.figures import Figure


def run() -> list[Figure]:
    """Figures of one hold."""
    return measure_viewers()
