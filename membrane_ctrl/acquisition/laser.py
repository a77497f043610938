"""Which displacement the laser saw while a frame was exposed, from the telemetry of the control process."""

from __future__ import annotations

import math
import struct
from collections import deque

from membrane_ctrl.ipc.ring import RingAddress, RingReader
from membrane_ctrl.telemetry import FIELDS

# One reading has 1 um of noise, which is ten times what the held centre moves between two frames: a frame gets
# the mean of the readings around it. 0.2 s to each side is 20 readings at 50 Hz (0.22 um), symmetric in time so
# that a steady motion cancels; in its 0.4 s the held centre moves less than the noise that is left.
HALF_WINDOW_S = 0.2
HALF_WINDOW_TICKS = 2.0  # below 10 Hz that would be fewer readings than make a mean
LEAST_READINGS = 3
_KEPT_S = 60.0  # longer than any full cycle takes

_ROW = struct.Struct(f"<{len(FIELDS)}d")
_TIME, _DISPLACEMENT, _QUALITY, _COUNTER = (
    FIELDS.index(name) for name in ("mono_s", "displacement_um", "displacement_quality", "sample_counter")
)


class LaserHistory:
    """The last minute of laser readings.

    Parameters
    ----------
    telemetry : RingAddress
        Rows of `membrane_ctrl.telemetry.TelemetryRow`.
    rate_hz : float
        How many of them come in a second.

    Attributes
    ----------
    half_window_s : float
        A frame gets the readings from so long before it to so long after.
    """

    def __init__(self, telemetry: RingAddress, rate_hz: float) -> None:
        self._reader = RingReader(telemetry)
        self.half_window_s = max(HALF_WINDOW_S, HALF_WINDOW_TICKS / rate_hz)
        self._readings: deque[tuple[float, float]] = deque()  # (mono_s, displacement_um)
        self._counter = math.nan

    def at(self, time_s: float) -> float:
        """Mean reading (um) within `half_window_s` of a moment on the run's clock.

        NaN if there are fewer than `LEAST_READINGS` good ones: missing, flagged and repeated samples are none.
        """
        self._update()
        near = [reading for mono_s, reading in self._readings if abs(mono_s - time_s) <= self.half_window_s]
        return math.fsum(near) / len(near) if len(near) >= LEAST_READINGS else math.nan

    def close(self) -> None:
        """Detach from the telemetry."""
        self._reader.close()

    def _update(self) -> None:
        for message in self._reader.drain():
            row = _ROW.unpack(message)
            repeated = row[_COUNTER] == self._counter
            self._counter = row[_COUNTER]
            if math.isfinite(row[_DISPLACEMENT]) and row[_QUALITY] == 0 and not repeated:
                self._readings.append((row[_TIME], row[_DISPLACEMENT]))
        while self._readings and self._readings[0][0] < self._readings[-1][0] - _KEPT_S:
            self._readings.popleft()
