"""Writes to Rerun every second, in segments; replaces the file of a dead writer."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import rerun as rr

from membrane_ctrl.config.schema import Config
from membrane_ctrl.metrology.figure.held_quantities import find_held_scalars
from membrane_ctrl.model import shape_estimate, telemetry
from membrane_ctrl.model.event_lines import from_dict
from membrane_ctrl.model.events import EventLine
from membrane_ctrl.recorder import (
    recorder_errors,
    rerun_events,
    rerun_recording,
    rerun_shapes,
    rerun_telemetry,
    summary_page,
)
from membrane_ctrl.recorder.thumbnails import Thumbnail
from membrane_ctrl.run_files.detail_level import DetailLevel

# A full disk is retried this often, so that recording continues soon after a person makes room.
RETRY_S = 10.0


class RerunOutput:
    """Streams and segments; the recording has no segment yet. `summary` makes the page of figures
    so far.
    """

    def __init__(
        self,
        recording: rerun_recording.Recording,
        config: Config,
        errors: recorder_errors.RecorderErrors,
        summary: Callable[[], str],
        overview_every_s: float = rerun_telemetry.OVERVIEW_EVERY_S,
    ) -> None:
        self._recording = recording
        self._segment_s = config.recording.segment_s
        self._errors = errors
        self._summary = summary
        self._next_summary_s = -math.inf
        self._telemetry = rerun_telemetry.TelemetryStreams(recording, config, overview_every_s)
        self.shapes = rerun_shapes.ShapeStreams(recording, find_held_scalars(config))
        self.state = math.nan  # the controller's, in the last row
        self.closed: list[Path] = []  # closed segments, until taken from here
        self._alive = False
        self._segment_until_s = 0.0
        self._retry_s = 0.0

    @property
    def next_segment(self) -> int:
        """Number of the next file."""
        return self._recording.segments

    def send_second(
        self,
        now_s: float,
        rows: telemetry.Rows,
        events: list[EventLine],
        shapes: list[shape_estimate.ShapeEstimate],
        thumbnails: Sequence[Thumbnail],
        detail: DetailLevel,
    ) -> bool:
        """Send one second of data and sync it.

        Parameters
        ----------
        now_s : float
            The run's clock.
        rows : Rows
            Telemetry.
        events : list of EventLine
            Of this second, in order.
        shapes : list of ShapeEstimate
            Of this second, in order.
        thumbnails : sequence of Thumbnail
            Of this second; empty if none are due.
        detail : DetailLevel
            What is left out where the disk is nearly full.

        Returns
        -------
        bool
            False if Rerun lost it.
        """
        self._errors.run_guarded("shape reference", lambda: self._watch_hold(rows))
        if detail == DetailLevel.ESSENTIAL:
            self._pause_output()
            return False
        self.shapes.pictures = detail == DetailLevel.ALL
        # Twice: after a failure the second is sent again, into a new segment
        for _ in range(2):
            needs_segment = not self._alive or now_s >= self._segment_until_s
            if needs_segment and not self._begin_segment(now_s):
                return False
            self._errors.run_guarded("telemetry streams", lambda: self._telemetry.send_rows(rows))
            self._errors.run_guarded(
                "event streams", lambda: rerun_events.send_events(self._recording, events)
            )
            self._errors.run_guarded("shape streams", lambda: self._send_shapes(shapes))
            self._errors.run_guarded("thumbnails", lambda: self._send_thumbnails(thumbnails))
            self._errors.run_guarded("summary page", lambda: self._send_summary(now_s, events))
            try:
                self._recording.flush()
            except rerun_recording.RecordingError as error:
                self._alive = False
                self._errors.report_error("recording", str(error))
            else:
                self._errors.report_recovered("recording")
                self._errors.run_guarded("disk sync", self._sync_file)
                return True
        self._retry_s = now_s + RETRY_S
        return False

    def _sync_file(self) -> None:
        try:
            self._recording.sync()
        except FileNotFoundError:  # deleted while in use
            self._alive = False
            raise

    def _send_shapes(self, shapes: list[shape_estimate.ShapeEstimate]) -> None:
        for estimate in shapes:
            self.shapes.send_estimate(estimate)

    def _send_thumbnails(self, thumbnails: Sequence[Thumbnail]) -> None:
        for each in thumbnails:
            picture = rr.EncodedImage(contents=each.jpeg, media_type="image/jpeg")
            self._recording.log_component(f"/frames/{each.pattern}", each.time_s, picture)

    def _send_summary(self, now_s: float, events: list[EventLine]) -> None:
        if now_s < self._next_summary_s and not any(from_dict(event).notable for event in events):
            return
        early = now_s < summary_page.SUMMARY_EARLY_S
        self._next_summary_s = now_s + (
            summary_page.SUMMARY_EARLY_INTERVAL_S if early else summary_page.SUMMARY_INTERVAL_S
        )
        self._recording.send_page(summary_page.SUMMARY_PATH, now_s, self._summary())

    def _begin_segment(self, now_s: float) -> bool:
        """Begin a file; returns whether there is one to write to."""
        # After a failure, not in every second: a full disk stays full for a while
        if now_s < self._retry_s:
            return False
        before = self._recording.path
        try:
            self._recording.next_segment()
        except rerun_recording.RecordingError as error:
            self._alive = False
            self._retry_s = now_s + RETRY_S
            self._errors.report_error("recording", str(error))
            return False
        if self._alive and before is not None:
            self.closed.append(before)
        self._alive = True
        self._segment_until_s = now_s + self._segment_s
        # A viewer may open this file alone: states, reference and summary are sent again
        self._telemetry.start_segment()
        self.shapes.start_segment()
        self._next_summary_s = -math.inf
        return True

    def _pause_output(self) -> None:
        """Close the file while there is room for its footer; a new one starts when there is room
        again.
        """
        if self._alive:
            self._alive = False
            self._errors.run_guarded("recording", self._recording.pause)

    def leave_folder(self) -> None:
        """Continue at once in the folder that replaces the run's removed one."""
        self._alive = False
        self._retry_s = 0.0
        self.closed.clear()
        self._recording.lay_out_again()

    def _watch_hold(self, rows: telemetry.Rows) -> None:
        """Changes of the figure are against the first of the settled hold: before it they only show
        the way there.
        """
        if not len(rows):
            return
        state = telemetry.get_column(rows, "state")
        for row, code in telemetry.find_changes(state, self.state):
            if code == telemetry.State.HOLD:
                self.shapes.set_reference(
                    float(telemetry.get_column(rows, "mono_s")[row]) + telemetry.SETTLED_AFTER_S
                )
        self.state = float(state[-1])

    def close(self) -> None:
        """Write the footer; the last segment is then among `closed`. Raises RecordingError."""
        last = self._recording.path
        self._errors.run_guarded("telemetry streams", self._telemetry.send_waiting)
        self._recording.close()
        if last is not None:
            self.closed.append(last)
