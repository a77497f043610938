"""Telemetry rows to Rerun: one block of columns a stream, lanes where a code changed."""

from __future__ import annotations

import math

import numpy as np
import rerun as rr

from membrane_ctrl.config import Config
from membrane_ctrl.recording.lanes import TELEMETRY_LANES
from membrane_ctrl.recording.quiet import QuietFilter
from membrane_ctrl.recording.rows import Rows, changes, column
from membrane_ctrl.recording.sink import Recording
from membrane_ctrl.recording.streams import BAND, OVERVIEW, STREAMS, TRUE_ERROR, overview_um, true_error_um


class TelemetryStreams:
    """Sends rows to a recording; remembers the codes of the last row."""

    def __init__(self, recording: Recording, config: Config) -> None:
        self._recording = recording
        self._band_um = config.limits.band_um
        self._quiet = QuietFilter(config.loop.rate_hz, config.recording.quiet_hz, self._band_um)
        self._codes: dict[str, float] = {}

    def start_segment(self) -> None:
        """Let every lane begin again: a new file does not know the state the last one ended in."""
        self._codes.clear()

    def send(self, rows: Rows) -> None:
        """Send (n, len(FIELDS)) rows; a stream without any finite value is left out."""
        if not len(rows):
            return
        self._send_streams(self._quiet.take(rows))
        time_s = column(rows, "mono_s")
        ends_s = time_s[[0, -1]] if len(rows) > 1 else time_s
        band = np.tile([self._band_um, -self._band_um], (len(ends_s), 1))
        self._recording.scalars(BAND.path, ends_s, band)
        overview = overview_um(rows)
        if np.isfinite(overview).all():
            self._recording.scalars(OVERVIEW.path, time_s[len(rows) // 2 : len(rows) // 2 + 1], overview)
        self._send_lanes(rows)

    def _send_streams(self, rows: Rows) -> None:
        time_s = column(rows, "mono_s")
        blocks = [(stream.path, stream.values(rows)) for stream in STREAMS]
        blocks.append((TRUE_ERROR.path, true_error_um(rows)))
        for path, values in blocks:
            if np.isfinite(values).any():
                self._recording.scalars(path, time_s, values)

    def _send_lanes(self, rows: Rows) -> None:
        time_s = column(rows, "mono_s")
        for lane in TELEMETRY_LANES:
            codes = column(rows, lane.field)
            found = changes(codes, self._codes.get(lane.field, math.nan))
            if found:
                words = [lane.word(code) for _, code in found]
                self._recording.columns(
                    lane.path, time_s[[row for row, _ in found]], rr.StateChange.columns(state=words)
                )
            self._codes[lane.field] = float(codes[-1])
