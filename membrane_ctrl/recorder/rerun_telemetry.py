"""Telemetry rows to Rerun: one block of columns per stream, lanes where a code changed."""

import math

import numpy as np
import rerun as rr

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import telemetry
from membrane_ctrl.recorder import rerun_recording, state_lanes
from membrane_ctrl.recorder.quiet_filter import QuietFilter
from membrane_ctrl.run_files import streams

# In a file, a chunk costs more than a row.
OVERVIEW_EVERY_S = 5.0


class TelemetryStreams:
    """Sends rows to a recording; remembers the codes of the last row.

    Parameters
    ----------
    recording : Recording
        The present segment is written.
    config : Config
        Tick rate, band, and how many rows quiet times keep.
    overview_every_s : float
        Seconds whose means are sent together.
    """

    def __init__(
        self,
        recording: rerun_recording.Recording,
        config: Config,
        overview_every_s: float = OVERVIEW_EVERY_S,
    ) -> None:
        self._recording = recording
        self._overview_every_s = overview_every_s
        self._band_um = config.limits.band_um
        self._band = streams.make_band(self._band_um)
        self._quiet = QuietFilter(config.loop.rate_hz, config.recording.quiet_hz, self._band_um)
        self._codes: dict[str, float] = {}
        self._rest = np.empty((0, len(telemetry.FIELDS)))  # not in the overview yet

    def start_segment(self) -> None:
        """Restart every lane: a new file does not have the last state of the previous one."""
        self._codes.clear()

    def send_rows(self, rows: telemetry.Rows) -> None:
        """Send (n, len(FIELDS)) rows; omit streams without any finite value."""
        if not len(rows):
            return
        self._send_streams(self._quiet.select_rows(rows))
        self._send_overview(rows)
        self._send_lanes(rows)

    def send_waiting(self) -> None:
        """Send what waits for its time."""
        if len(self._rest):
            self._send_overview(self._rest[:0], last=True)

    def _send_overview(self, rows: telemetry.Rows, last: bool = False) -> None:
        """Send a row for each second, some seconds at a time, and the band."""
        waiting_s = telemetry.get_column(self._rest, "mono_s")
        # not if sent again after a failure
        fresh = telemetry.get_column(rows, "mono_s") > waiting_s.max(initial=-math.inf)
        self._rest = rows = np.concatenate((self._rest, rows[fresh]))
        # Whole seconds only, several at a time; the last one may be incomplete, and waits
        time_s = telemetry.get_column(rows, "mono_s")
        second = np.floor(time_s)
        if second[-1] - second[0] < self._overview_every_s and not last:
            return
        whole = np.split(rows, np.flatnonzero(np.diff(second)) + 1)
        self._rest = rows[:0] if last else whole.pop()
        square = np.full((2, 1), self._band_um**2)
        self._recording.send_measurements(
            self._band.path, time_s[[0, -1]], np.zeros_like(square), square
        )
        # A row of means for each second, and of its error also the extremes
        means = np.concatenate([streams.mean_row(part) for part in whole])
        errors_um = np.concatenate([streams.overview_um(part) for part in whole])
        true_um = telemetry.true_error_um(telemetry.get_columns(means))[:, np.newaxis]
        blocks = [(stream.path, stream.select_values(means)) for stream in streams.MEANS]
        blocks += [(streams.OVERVIEW.path, errors_um), (streams.TRUE_MEAN.path, true_um)]
        mean_time_s = telemetry.get_column(means, "mono_s")
        for path, values in blocks:
            finite = np.isfinite(values).any(axis=1)
            if finite.any():
                self._recording.send_scalars(path, mean_time_s[finite], values[finite])

    def _send_streams(self, rows: telemetry.Rows) -> None:
        time_s = telemetry.get_column(rows, "mono_s")
        blocks = [(stream.path, stream.select_values(rows)) for stream in streams.STREAMS]
        true_um = telemetry.true_error_um(telemetry.get_columns(rows))
        blocks.append((streams.TRUE_ERROR.path, true_um[:, np.newaxis]))
        for path, values in blocks:
            if np.isfinite(values).any():
                self._recording.send_scalars(path, time_s, values)

    def _send_lanes(self, rows: telemetry.Rows) -> None:
        time_s = telemetry.get_column(rows, "mono_s")
        for lane in state_lanes.TELEMETRY_LANES:
            codes = telemetry.get_column(rows, lane.field)
            found = telemetry.find_changes(codes, self._codes.get(lane.field, math.nan))
            if found:
                words = [lane.name_code(code) for _, code in found]
                self._recording.send_columns(
                    lane.path,
                    time_s[[row for row, _ in found]],
                    rr.StateChange.columns(state=words),
                )
            self._codes[lane.field] = float(codes[-1])
