"""How another process finds the shared frames: plain data, free of NumPy (see `threads.py` for why that counts)."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FrameAddress:
    """What another process needs to read the frames (or to become their only writer)."""

    name: str
    slots: int
    height_px: int
    width_px: int
    dtype: str
