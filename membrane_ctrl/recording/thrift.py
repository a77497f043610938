"""What is still recorded when the disk runs low: pictures go first, numbers last."""

from __future__ import annotations

from enum import IntEnum


class Thrift(IntEnum):
    """How much is left out."""

    ALL = 0
    NO_PICTURES = 1  # thumbnails and maps are half of a recording
    ESSENTIAL = 2  # events, inputs of the ticks, summary: some kB/s, from which the run can be replayed


# In units of `recording.min_free_mb`: below it a person has been told, and what is left is for the essential.
PICTURES_FROM, _RERUN_FROM = 2.0, 0.2
# More must be free again than what a level began at, or it would come and go with every file.
_HYSTERESIS = 1.1


def thrift(free_mb: float, min_free_mb: float, before: Thrift) -> Thrift:
    """What to leave out with this much space left.

    Parameters
    ----------
    free_mb : float
        Space left.
    min_free_mb : float
        `recording.min_free_mb`.
    before : Thrift
        As it was.
    """
    level = _level(free_mb, min_free_mb)
    return max(level, min(before, _level(free_mb / _HYSTERESIS, min_free_mb)))


def _level(free_mb: float, min_free_mb: float) -> Thrift:
    if free_mb < _RERUN_FROM * min_free_mb:
        return Thrift.ESSENTIAL
    return Thrift.NO_PICTURES if free_mb < PICTURES_FROM * min_free_mb else Thrift.ALL
