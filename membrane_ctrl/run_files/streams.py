"""The Rerun entity of each telemetry field: the signals of one plot share one entity.

One entity of m scalars costs the writer and the viewer far less than m entities of one; `SeriesLines` sets the names
of the lines once.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.model.arrays import Column, FloatArray
from membrane_ctrl.model.events import EventLine
from membrane_ctrl.model.telemetry import Rows, column

Colour = tuple[int, int, int]

# One colour per quantity in every plot (Okabe and Ito's palette, safe for colour-blind readers).
BLUE: Colour = (86, 180, 233)
ORANGE: Colour = (230, 159, 0)
GREEN: Colour = (0, 158, 115)
RED: Colour = (213, 94, 0)
VIOLET: Colour = (204, 121, 167)
YELLOW: Colour = (240, 228, 66)
GREY: Colour = (140, 140, 140)
WHITE: Colour = (235, 235, 235)


@dataclass(frozen=True, slots=True)
class Line:
    """One signal of a stream: the telemetry field, its name in the legend, its colour and width in points."""

    field: str
    name: str
    colour: Colour
    width: float = 1.5


@dataclass(frozen=True, slots=True)
class Stream:
    """One Rerun entity of several signals."""

    path: str
    lines: tuple[Line, ...]

    def values(self, rows: Rows) -> FloatArray:
        """(n, lines) block of the stream."""
        return np.stack([column(rows, line.field) for line in self.lines], axis=1)


# Every field of a row except `mono_s`, the time axis, is in exactly one stream.
STREAMS: tuple[Stream, ...] = (
    Stream(
        "/loop/position",
        (
            Line("displacement_um", "reading µm", GREY, 1.0),
            Line("filtered_um", "filtered µm", BLUE),
            Line("setpoint_um", "setpoint µm", ORANGE),
            Line("target_um", "target µm", WHITE, 1.0),
        ),
    ),
    Stream("/truth/displacement", (Line("truth_displacement_um", "true centre µm", GREEN, 2.0),)),
    Stream("/truth/laser_bias", (Line("truth_laser_bias_um", "true laser mount drift µm", RED),)),
    Stream("/loop/error", (Line("error_um", "error µm", BLUE),)),
    Stream(
        "/loop/terms",
        (
            Line("p_um_per_s", "P µm/s", BLUE),
            Line("i_um_per_s", "I µm/s", ORANGE),
            Line("d_um_per_s", "D µm/s", VIOLET),
            Line("feedforward_um_per_s", "feed-forward µm/s", GREEN),
        ),
    ),
    Stream(
        "/loop/flow",
        (
            Line("flow_wanted_um_per_s", "flow wanted µm/s", GREY),
            Line("flow_um_per_s", "flow µm/s", BLUE),
            Line("leak_um_per_s", "leak µm/s", RED, 2.0),
        ),
    ),
    Stream(
        "/pump/drive",
        (
            Line("pump_fraction", "pump", BLUE),
            Line("pump_readback_fraction", "pump read-back", GREY, 1.0),
            Line("vent_fraction", "vent", RED),
            Line("vent_readback_fraction", "vent read-back", VIOLET, 1.0),
        ),
    ),
    Stream("/shape/trim", (Line("trim_um", "trim µm", VIOLET, 2.0),)),
    Stream("/gas/pressure", (Line("gauge_pressure_pa", "gauge pressure Pa", BLUE),)),
    Stream("/ambient/pressure", (Line("ambient_pressure_pa", "ambient pressure Pa", ORANGE),)),
    Stream("/ambient/temperature", (Line("air_temperature_c", "air °C", ORANGE),)),
    Stream("/gas/temperature", (Line("gas_temperature_c", "gas °C", BLUE),)),
    Stream("/tick/lateness", (Line("lateness_ms", "lateness ms", BLUE),)),
    Stream("/tick/dt", (Line("dt_s", "time between ticks s", BLUE),)),
    Stream("/tick/missed", (Line("missed_ticks", "ticks missed so far", RED, 2.0),)),
    # for programs rather than people: one entity, as each costs 32 bytes per row for its times and row id
    Stream(
        "/tick/record",
        (
            Line("tick", "tick", GREY),
            Line("sample_counter", "sample counter", BLUE),
            Line("device_time_s", "device time s", ORANGE),
            Line("displacement_quality", "displacement quality", RED),
            Line("state", "state", GREEN),
            Line("shape_state", "shape state", VIOLET),
            Line("rung", "rung", YELLOW),
            Line("fault", "fault", RED),
        ),
    ),
)

# Computed here from the rows, so that plots need no arithmetic.
TRUE_ERROR = Stream("/truth/error", (Line("", "target minus true centre µm", GREEN, 2.0),))
OVERVIEW = Stream(
    "/overview/error",
    (
        Line("", "error, least of a second µm", GREY, 1.0),
        Line("", "error, mean of a second µm", BLUE, 2.0),
        Line("", "error, greatest of a second µm", GREY, 1.0),
    ),
)
# A point per second all over the run: the others have every tick around events and one per second in quiet times, and
# a line that changes its density looks as if the mirror had changed.
_MEANS = {"/loop/position", "/truth/displacement", "/loop/flow", "/pump/drive", "/ambient/pressure"}
MEANS = tuple(replace(stream, path=f"/overview{stream.path}") for stream in STREAMS if stream.path in _MEANS)
TRUE_MEAN = replace(TRUE_ERROR, path="/overview/truth/error")
DERIVED: tuple[Stream, ...] = (TRUE_ERROR, OVERVIEW, *MEANS, TRUE_MEAN)


def band(band_um: float) -> Stream:
    """The area in which the error is to stay, drawn as the deviation of a line without width."""
    return Stream("/loop/band", (Line("", f"band ±{band_um:g} µm", GREEN, 0.0),))


# Low orders that a film shows, each worth a line. Noll index to name.
LOW_ORDERS = {
    4: ("defocus Z4 µm", BLUE),
    5: ("astigmatism Z5 µm", ORANGE),
    6: ("astigmatism Z6 µm", YELLOW),
    7: ("coma Z7 µm", GREEN),
    8: ("coma Z8 µm", VIOLET),
    9: ("trefoil Z9 µm", GREY),
    10: ("trefoil Z10 µm", WHITE),
    11: ("spherical Z11 µm", RED),
}

ZERNIKE = Stream("/shape/zernike", tuple(Line("", f"Z{j} µm", GREY) for j in range(1, 37)))
CHANGE = Stream("/shape/change", tuple(Line("", name, colour) for name, colour in LOW_ORDERS.values()))
SAG = Stream("/shape/sag_change", (Line("", "sag change ± 1σ µm", BLUE, 2.0), Line("", "laser change µm", ORANGE)))
RESIDUAL = Stream("/shape/residual", (Line("", "slope residual µrad", BLUE),))
QUALITY = Stream("/shape/quality", (Line("", "valid fraction", GREEN, 2.0), Line("", "saturated fraction", RED)))
MODULATION = Stream("/shape/modulation", (Line("", "modulation ADU", BLUE),))
LATENCY = Stream("/shape/latency", (Line("", "last frame to result ms", BLUE),))
SHAPE_STREAMS: tuple[Stream, ...] = (ZERNIKE, RESIDUAL, QUALITY, MODULATION, LATENCY)


# Vertical lines across plots of a fixed height, interrupted by NaN; an entity each, as a legend lists only those with
# data.
MARKS: tuple[Stream, ...] = (
    Stream("/marks/fault", (Line("fault", "fault", RED, 2.0),)),
    Stream("/marks/pause", (Line("pause", "pause, resume", YELLOW),)),
    Stream("/marks/setpoint", (Line("setpoint", "setpoint", ORANGE),)),
    Stream("/marks/command", (Line("command", "command", VIOLET),)),
    Stream("/marks/mark", (Line("mark", "mark", WHITE),)),
)
_MARK_HALF_HEIGHT = 1e3  # in the units of any plot that has them


def mark_lines(events: Sequence[EventLine]) -> Iterator[tuple[Stream, Column, FloatArray]]:
    """Each stream of `MARKS` with events, times (3 n,) and values (3 n, 1) that draw a vertical line for each."""
    for stream in MARKS:
        found = [float(event.get("mono_s") or 0.0) for event in events if _mark_kind(event) == stream.lines[0].field]
        time_s = np.array(found)[:, np.newaxis] + [0.0, 0.0, 1e-9]
        values = np.tile([-_MARK_HALF_HEIGHT, _MARK_HALF_HEIGHT, np.nan], len(found))
        if found:
            yield stream, time_s.ravel(), values[:, np.newaxis]


def _mark_kind(event: EventLine) -> str:
    if event.get("kind") != "command":
        return str(event["kind"]) if event.get("kind") in ("fault", "mark") else ""
    command = str(event.get("command"))
    if event.get("refused"):
        return ""
    return {"setpoint": "setpoint", "pause": "pause", "resume": "pause", "mark": "mark"}.get(command, "command")


def overview_um(rows: Rows) -> FloatArray:
    """(1, 3) least, mean and greatest error of the rows; NaN if no row has an error."""
    error = column(rows, "error_um")
    error = error[np.isfinite(error)]
    if not error.size:
        return np.full((1, 3), np.nan)
    return np.array([[error.min(), error.mean(), error.max()]])


def mean_row(rows: Rows) -> Rows:
    """(1, fields) mean of each field over the rows that have it; NaN where none has."""
    there = np.isfinite(rows)
    with np.errstate(invalid="ignore"):
        mean: Rows = np.where(there, rows, 0.0).sum(axis=0, keepdims=True) / there.sum(axis=0, keepdims=True)
    return mean
