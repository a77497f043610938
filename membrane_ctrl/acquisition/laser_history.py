"""The laser's readings around each frame.

One reading has 1 µm of noise, ten times the held centre's motion between frames: a frame gets the
mean of the readings around it. 0.2 s to each side are 20 readings at 50 Hz (0.22 µm), symmetric in
time so that a steady motion cancels; in these 0.4 s the held centre moves less than the remaining
noise.
"""

import math
from collections import deque

from membrane_ctrl.model.telemetry import TelemetryRow
from membrane_ctrl.processes.ring import RingAddress, RingReader

HALF_WINDOW_S = 0.2
HALF_WINDOW_TICKS = 2.0  # below 10 Hz there would be too few readings for a mean
LEAST_READINGS = 3
_KEPT_S = 60.0  # longer than any full cycle takes


class LaserHistory:
    """The last minute of laser readings, from rows of telemetry.

    A frame gets the readings within `half_window_s` before and after it.

    Parameters
    ----------
    telemetry : RingAddress
        Ring of `TelemetryRow`s.
    rate_hz : float
        Rows a second.
    """

    def __init__(self, telemetry: RingAddress, rate_hz: float) -> None:
        self._reader = RingReader(telemetry)
        self.half_window_s = max(HALF_WINDOW_S, HALF_WINDOW_TICKS / rate_hz)
        self._readings: deque[tuple[float, float]] = deque()  # (mono_s, displacement_um)
        self._counter = math.nan

    def at(self, time_s: float) -> float:
        """Mean reading (µm) within `half_window_s` of a time on the run's clock.

        NaN with fewer than `LEAST_READINGS` good ones; missing, flagged and repeated samples do not
        count.
        """
        self._update()
        near = [
            reading
            for mono_s, reading in self._readings
            if abs(mono_s - time_s) <= self.half_window_s
        ]
        if len(near) >= LEAST_READINGS:
            return math.fsum(near) / len(near)
        return math.nan

    def close(self) -> None:
        """Detach from the telemetry."""
        self._reader.close()

    def _update(self) -> None:
        for message in self._reader.drain():
            row = TelemetryRow.unpack(message)
            repeated = row.sample_counter == self._counter
            self._counter = row.sample_counter
            if (
                math.isfinite(row.displacement_um)
                and row.displacement_quality == 0
                and not repeated
            ):
                self._readings.append((row.mono_s, row.displacement_um))
        while self._readings and self._readings[0][0] < self._readings[-1][0] - _KEPT_S:
            self._readings.popleft()
