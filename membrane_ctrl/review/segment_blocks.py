"""A part of a run's telemetry out of its Rerun segments, reading those alone that may hold some of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.review import rrd_reader

Column = NDArray[np.float64]
Block = dict[str, Column]


def segment_blocks(
    folder: Path, names: Sequence[str], start_s: float, end_s: float, notes: list[str]
) -> Iterator[Block]:
    """Telemetry of the segments from `start_s` up to `end_s`, a block each; what is damaged of them is noted."""
    paths = rrd_reader.segments(folder)
    first = _last_begun(paths, start_s) if np.isfinite(start_s) else 0
    last = _last_begun(paths, end_s) if np.isfinite(end_s) else len(paths) - 1
    for path in paths[first : last + 1]:
        block = cut(rrd_reader.read_ticks(path, names, notes), "mono_s", start_s, end_s)
        if block["mono_s"].size:
            yield block


def cut(block: Block, time_name: str, start_s: float, end_s: float) -> Block:
    """Rows of a block from `start_s` up to `end_s`."""
    time_s = block[time_name]
    first, last = np.searchsorted(time_s, [start_s, end_s])
    if first == 0 and last == time_s.size:
        return block
    return {name: values[first:last] for name, values in block.items()}


def _last_begun(paths: Sequence[Path], time_s: float) -> int:
    """Number of the last segment that begins before a time, or the first one: halves what is left at each look."""
    low, high = 0, len(paths)
    while high - low > 1:
        middle = (low + high) // 2
        # a segment that gives no time gives no rows: the next one says where it is
        looks = ((place, _first_s(paths[place])) for place in range(middle, high))
        place, begins_s = next(((place, at_s) for place, at_s in looks if at_s is not None), (middle, np.inf))
        low, high = (place, high) if begins_s <= time_s else (low, middle)
    return low


def _first_s(path: Path) -> float | None:
    """Its first tick. That it is damaged is no note yet: it may be far from the part that is read."""
    times_s = rrd_reader.read_ticks(path, ["mono_s"], [])["mono_s"]
    return float(times_s[0]) if times_s.size else None
