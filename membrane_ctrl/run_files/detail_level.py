"""How much is recorded when the disk runs low: pictures are dropped first, numbers last."""

from enum import IntEnum

# In units of `recording.min_free_mb`, below which an alarm is raised and the rest is reserved for
# the essential.
PICTURES_FROM = 2.0
_RERUN_FROM = 0.2
# Hysteresis, or a level would come and go with every file.
_HYSTERESIS = 1.1


class DetailLevel(IntEnum):
    """How much detail is recorded."""

    ALL = 0
    NO_PICTURES = 1  # thumbnails and maps are half of a recording
    ESSENTIAL = 2  # events, tick inputs, summary: a few kB/s, enough to replay the run


def decide_detail_level(free_mb: float, min_free_mb: float, before: DetailLevel) -> DetailLevel:
    """Decide how much is recorded, with hysteresis.

    Parameters
    ----------
    free_mb : float
        Free space of the disk.
    min_free_mb : float
        The space that must stay free.
    before : DetailLevel
        The previous level.
    """
    level = _level_for_free_space(free_mb, min_free_mb)
    return max(level, min(before, _level_for_free_space(free_mb / _HYSTERESIS, min_free_mb)))


def _level_for_free_space(free_mb: float, min_free_mb: float) -> DetailLevel:
    if free_mb < _RERUN_FROM * min_free_mb:
        return DetailLevel.ESSENTIAL
    if free_mb < PICTURES_FROM * min_free_mb:
        return DetailLevel.NO_PICTURES
    return DetailLevel.ALL
