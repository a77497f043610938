"""The Rerun entity of each telemetry field: the signals of one plot share one entity.

One entity of m scalars costs the writer and the viewer far less than m entities of one; `SeriesLines` sets the names
of the lines once.
"""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import FloatArray
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
            Line("displacement_um", "reading um", GREY, 1.0),
            Line("filtered_um", "filtered um", BLUE),
            Line("setpoint_um", "setpoint um", ORANGE),
            Line("target_um", "target um", WHITE, 1.0),
        ),
    ),
    Stream("/truth/displacement", (Line("truth_displacement_um", "true centre um", GREEN, 2.0),)),
    Stream("/truth/laser_bias", (Line("truth_laser_bias_um", "true laser mount drift um", RED),)),
    Stream("/loop/error", (Line("error_um", "error um", BLUE),)),
    Stream(
        "/loop/terms",
        (
            Line("p_um_per_s", "P um/s", BLUE),
            Line("i_um_per_s", "I um/s", ORANGE),
            Line("d_um_per_s", "D um/s", VIOLET),
            Line("feedforward_um_per_s", "feed-forward um/s", GREEN),
        ),
    ),
    Stream(
        "/loop/flow",
        (
            Line("flow_wanted_um_per_s", "flow wanted um/s", GREY),
            Line("flow_um_per_s", "flow um/s", BLUE),
            Line("leak_um_per_s", "leak um/s", RED, 2.0),
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
    Stream("/shape/trim", (Line("trim_um", "trim um", VIOLET, 2.0),)),
    Stream("/gas/pressure", (Line("gauge_pressure_pa", "gauge pressure Pa", BLUE),)),
    Stream("/ambient/pressure", (Line("ambient_pressure_pa", "ambient pressure Pa", ORANGE),)),
    Stream("/ambient/temperature", (Line("air_temperature_c", "air C", ORANGE),)),
    Stream("/gas/temperature", (Line("gas_temperature_c", "gas C", BLUE),)),
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
TRUE_ERROR = Stream("/truth/error", (Line("", "target minus true centre um", GREEN, 2.0),))
BAND = Stream("/loop/band", (Line("", "+band um", GREY, 1.0), Line("", "-band um", GREY, 1.0)))
OVERVIEW = Stream(
    "/overview/error",
    (
        Line("", "error, minimum of a second um", GREY, 1.0),
        Line("", "error, mean of a second um", BLUE),
        Line("", "error, maximum of a second um", GREY, 1.0),
    ),
)
DERIVED: tuple[Stream, ...] = (TRUE_ERROR, BAND, OVERVIEW)

# Low orders that a film shows, each worth a line. Noll index to name.
LOW_ORDERS = {
    4: ("defocus Z4 um", BLUE),
    5: ("astigmatism Z5 um", ORANGE),
    6: ("astigmatism Z6 um", YELLOW),
    7: ("coma Z7 um", GREEN),
    8: ("coma Z8 um", VIOLET),
    11: ("spherical Z11 um", RED),
}

ZERNIKE = Stream("/shape/zernike", tuple(Line("", f"Z{j} um", GREY) for j in range(1, 37)))
CHANGE = Stream("/shape/change", tuple(Line("", name, colour) for name, colour in LOW_ORDERS.values()))
SAG = Stream(
    "/shape/sag_change",
    (
        Line("", "sag change um", BLUE, 2.0),
        Line("", "+1 sigma um", GREY, 1.0),
        Line("", "-1 sigma um", GREY, 1.0),
        Line("", "laser change um", ORANGE),
    ),
)
RESIDUAL = Stream("/shape/residual", (Line("", "slope residual urad", BLUE),))
QUALITY = Stream("/shape/quality", (Line("", "valid fraction", GREEN, 2.0), Line("", "saturated fraction", RED)))
MODULATION = Stream("/shape/modulation", (Line("", "modulation ADU", BLUE),))
LATENCY = Stream("/shape/latency", (Line("", "last frame to result ms", BLUE),))
SHAPE_STREAMS: tuple[Stream, ...] = (ZERNIKE, CHANGE, SAG, RESIDUAL, QUALITY, MODULATION, LATENCY)


def overview_um(rows: Rows) -> FloatArray:
    """(1, 3) minimum, mean and maximum error of the rows; NaN if no row has an error."""
    error = column(rows, "error_um")
    error = error[np.isfinite(error)]
    if not error.size:
        return np.full((1, 3), np.nan)
    return np.array([[error.min(), error.mean(), error.max()]])
