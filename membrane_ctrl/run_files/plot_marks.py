"""Vertical lines that mark faults, commands and remarks in plots.

Each kind is one Rerun entity, as a legend lists only entities with data. The lines have a fixed
height and are interrupted by NaN.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from membrane_ctrl.model.arrays import Column, FloatArray
from membrane_ctrl.model.colours import (
    ORANGE,
    RED,
    VIOLET,
    WHITE,
    YELLOW,
)
from membrane_ctrl.model.events import Event
from membrane_ctrl.run_files.stream import Line, Stream

# Vertical lines across plots of a fixed height, interrupted by NaN; an entity each, as a legend
# lists only those with data.
MARKS: tuple[Stream, ...] = (
    Stream("/marks/fault", (Line("fault", "fault", RED, 2.0),)),
    Stream("/marks/pause", (Line("pause", "pause, resume", YELLOW),)),
    Stream("/marks/setpoint", (Line("setpoint", "setpoint", ORANGE),)),
    Stream("/marks/command", (Line("command", "command", VIOLET),)),
    Stream("/marks/mark", (Line("mark", "mark", WHITE),)),
)
_MARK_HALF_HEIGHT = 1e3  # in the units of any plot that has them


def mark_lines(
    events: Sequence[tuple[float, Event]],
) -> Iterator[tuple[Stream, Column, FloatArray]]:
    """Each stream of `MARKS` with events, times (3 n,) and values (3 n, 1) that draw a vertical
    line for each.

    `events` are those of a run with their times.
    """
    for stream in MARKS:
        found = [mono_s for mono_s, event in events if event.plot_mark == stream.lines[0].field]
        if found:
            yield stream, *make_vertical_lines(np.array(found))


def make_vertical_lines(time_s: Column) -> tuple[Column, FloatArray]:
    """Times (3 n,) and values (3 n, 1) that draw a vertical line at each of n times."""
    values = np.tile([-_MARK_HALF_HEIGHT, _MARK_HALF_HEIGHT, np.nan], time_s.size)
    return (time_s[:, np.newaxis] + [0.0, 0.0, 1e-9]).ravel(), values[:, np.newaxis]
