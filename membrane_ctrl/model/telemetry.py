"""One row of telemetry per tick, which the recorder stores and the console shows.

A row crosses to the other processes as plain doubles, so that writing it costs the tick a few microseconds.
Codes (state, shape state, fault, safe level) are small integers; their names are in `states.py`.
"""

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from operator import attrgetter

import numpy as np

from membrane_ctrl.model.arrays import Column, FloatArray


@dataclass(frozen=True, slots=True)
class TelemetryRow:
    """What one tick read, decided and wrote; NaN for missing values."""

    mono_s: float  # the run's clock at the start of the tick
    tick: float
    dt_s: float
    lateness_ms: float
    missed_ticks: float  # running count
    state: float
    shape_state: float
    safe_level: float
    fault: float  # 0: none
    target_um: float  # end of the setpoint ramp
    setpoint_um: float  # setpoint given to the loop, including the trim
    displacement_um: float
    filtered_um: float
    error_um: float
    p_um_per_s: float
    i_um_per_s: float
    d_um_per_s: float
    feedforward_um_per_s: float
    flow_wanted_um_per_s: float  # before the limits
    flow_um_per_s: float  # after them
    pump_fraction: float
    vent_fraction: float
    pump_readback_fraction: float
    vent_readback_fraction: float
    gauge_pressure_pa: float
    ambient_pressure_pa: float
    air_temperature_c: float
    gas_temperature_c: float
    displacement_quality: float
    sample_counter: float
    device_time_s: float
    leak_um_per_s: float
    trim_um: float
    truth_displacement_um: float  # twin only: the centre's true displacement
    truth_laser_bias_um: float  # twin only
    # the estimate of the centre (docs/estimator.md), which `filtered_um` then is; NaN if the laser is held
    estimate_sigma_um: float = math.nan
    optics_share: float = math.nan  # of the corrections of the estimate; the laser has the rest
    laser_innovation: float = math.nan  # reading less expectation, in standard deviations; NaN while it is not used
    optics_innovation: float = math.nan
    barometer_innovation: float = math.nan
    thermometer_innovation: float = math.nan

    def pack(self) -> bytes:
        """The row as doubles in field order."""
        return _STRUCT.pack(*_values(self))

    @classmethod
    def unpack(cls, message: bytes) -> "TelemetryRow":
        """Decode the row of `pack`. Raises struct.error."""
        return cls(*_STRUCT.unpack(message))


# By its name in tables, events, checksums and memories of earlier versions: a field.
TODAY: dict[str, str] = {"rung": "safe_level"}
FIELDS: tuple[str, ...] = tuple(field.name for field in fields(TelemetryRow))
_values = attrgetter(*FIELDS)  # astuple would copy deeply: 15 us per tick
_STRUCT = struct.Struct(f"<{len(FIELDS)}d")
ROW_BYTES = _STRUCT.size
FIRST_BYTES = 8 * FIELDS.index("estimate_sigma_um")  # of a row of the first version, which had no estimate


# A mirror counts as settled this long after hold began and after each setpoint ramp: three closed-loop time constants
# of 1.45 s (docs/physics.md, inner loop) leave 5 % of a step, of which the `settle` state has already taken most.
SETTLED_AFTER_S = 5.0

Rows = FloatArray
COLUMN: dict[str, int] = {name: place for place, name in enumerate(FIELDS)}


def unpack(messages: Sequence[bytes]) -> Rows:
    """Packed `TelemetryRow`s as a table (n, len(FIELDS))."""
    return np.frombuffer(b"".join(messages), dtype="<f8").reshape(-1, len(FIELDS))


def column(rows: Rows, name: str) -> FloatArray:
    """One field of all rows, (n,)."""
    return rows[:, COLUMN[name]]


def columns(rows: Rows) -> dict[str, Column]:
    """All fields of rows by name, (n,) each."""
    return dict(zip(FIELDS, rows.T, strict=True))


def true_error_um(ticks: Mapping[str, Column]) -> Column:
    """Target minus true centre, with the sign of `error_um` (setpoint minus value); NaN on a real bench."""
    return ticks["target_um"] - ticks["truth_displacement_um"]


def changes(codes: FloatArray, before: float) -> list[tuple[int, int]]:
    """Changes of a code: (row, new code) for each, comparing the first row with `before` (NaN: none)."""
    previous = np.concatenate(([before], codes[:-1]))
    return [(int(row), int(codes[row])) for row in np.flatnonzero((codes != previous) & np.isfinite(codes))]
