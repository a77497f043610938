"""Events to Rerun: the text log, and lines across plots."""

import math
from collections.abc import Sequence

import numpy as np
import rerun as rr

from membrane_ctrl.model.acquisition_events import Vibrations
from membrane_ctrl.model.event_lines import from_dict
from membrane_ctrl.model.events import EventLine, PumpLearned
from membrane_ctrl.model.figure_columns import VIBRATIONS_MOST
from membrane_ctrl.recorder import rerun_recording
from membrane_ctrl.run_files import plot_marks, streams

EVENTS_PATH = "/events"


def send_events(recording: rerun_recording.Recording, events: Sequence[EventLine]) -> None:
    """Send events: a sentence each, and vertical lines across plots.

    Parameters
    ----------
    recording : Recording
        The present segment.
    events : sequence of EventLine
        Lines of the event log, in order of time. What an event means for plots is read from its
        class (`from_dict`), not from the text.
    """
    if not events:
        return
    # 1. The log: a sentence and a level each
    timed = [(float(line.get("mono_s") or 0.0), from_dict(line)) for line in events]
    time_s = np.array([at_s for at_s, _ in timed])
    # the log's own column of times is too narrow to read
    clock_times = [str(line.get("time_utc", ""))[11:19] for line in events]
    texts = [
        f"{clock} {event.sentence}".strip()
        for clock, (_, event) in zip(clock_times, timed, strict=True)
    ]
    levels = [event.level.value for _, event in timed]
    recording.send_columns(EVENTS_PATH, time_s, rr.TextLog.columns(text=texts, level=levels))
    # 2. Lines across the plots, and the events that are values of a plot
    for stream, marks_s, values in plot_marks.mark_lines(timed):
        recording.send_scalars(stream.path, marks_s, values)
    of_pump = [(at_s, event) for at_s, event in timed if isinstance(event, PumpLearned)]
    if of_pump:
        values = np.array([[event.scale, event.correction] for _, event in of_pump])
        squares = np.array([[event.sigma**2, 0.0] for _, event in of_pump])
        recording.send_measurements(
            streams.PUMP.path, np.array([at_s for at_s, _ in of_pump]), values, squares
        )
    for at_s, event in timed:
        if isinstance(event, Vibrations):
            frequencies_hz = [math.nan if value is None else value for value in event.frequency_hz]
            padded = [*frequencies_hz, *VIBRATIONS_MOST * [math.nan]]
            values = np.array([padded[:VIBRATIONS_MOST]])
            recording.send_scalars(streams.VIBRATIONS.path, np.array([at_s]), values)
