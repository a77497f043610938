"""Where a run's frames are in shared memory.

Imports nothing heavy: specifications of processes name it.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FrameAddress:
    """What another process needs to read the frames (or become their only writer)."""

    name: str
    slots: int
    height_px: int
    width_px: int
    dtype: str
