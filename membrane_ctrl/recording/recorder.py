"""What the recorder does with what the rings bring: files, Rerun, summary. Nothing here may end it silently."""

from __future__ import annotations

import math
import pickle
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from membrane_ctrl import __version__
from membrane_ctrl.clock import RunClock
from membrane_ctrl.config import Config
from membrane_ctrl.estimate import ShapeEstimate
from membrane_ctrl.ipc.ring import RingReader
from membrane_ctrl.names import State
from membrane_ctrl.recording import events, plain_json
from membrane_ctrl.recording.atomic import write_text_atomic
from membrane_ctrl.recording.column_tables import ColumnTables
from membrane_ctrl.recording.event_streams import send_events
from membrane_ctrl.recording.events import Event, EventsFile
from membrane_ctrl.recording.inputs_file import InputsFile
from membrane_ctrl.recording.rows import Rows, changes, column, unpack
from membrane_ctrl.recording.run_folder import free_mb
from membrane_ctrl.recording.shape_streams import ShapeStreams
from membrane_ctrl.recording.sink import SEGMENT_S, Recording, RecordingError
from membrane_ctrl.recording.summary import Summary
from membrane_ctrl.recording.telemetry_streams import TelemetryStreams
from membrane_ctrl.tick_record import TickAssembler

# A full disk is tried again this often: a person who made room sees the recording go on.
RETRY_S = 10.0

Report = Callable[[dict[str, Any]], None]


class FrameSource(Protocol):
    """Sends thumbnails when they are due (`thumbnails.Thumbnails`)."""

    def send(self, now_s: float) -> None:
        """Send a set if one is due."""


class Recorder:
    """Everything of a run that goes to the disk.

    Parameters
    ----------
    run_dir : Path
        Folder of the run.
    clock : RunClock
        The run's clock.
    config : Config
        The run's configuration.
    rings : dict
        Readers by name: "telemetry", "events", "inputs" and, if the shape is measured, "shapes".
    recording : Recording
        The Rerun file, no segment begun yet.
    thumbnails : FrameSource or None
        Thumbnails of frames.
    report : callable
        Takes a small dict for the supervisor; never blocks, never raises.
    """

    def __init__(
        self,
        run_dir: Path,
        clock: RunClock,
        config: Config,
        rings: dict[str, RingReader],
        recording: Recording,
        thumbnails: FrameSource | None,
        report: Report,
    ) -> None:
        self._run_dir = run_dir
        self._clock = clock
        self._least_free_mb = config.recording.min_free_mb
        self._rings = rings
        self._recording = recording
        self._thumbnails = thumbnails
        self._report = report
        self._events_file = EventsFile(run_dir / "events.jsonl")
        self._telemetry_streams = TelemetryStreams(recording, config.limits.band_um)
        self._shape_streams = ShapeStreams(recording)
        self._summary = Summary(config)
        self._columns = ColumnTables(run_dir)
        self._inputs_file = InputsFile(run_dir, __version__)
        self._assembler = TickAssembler()
        self._messages: list[bytes] = []
        self._input_messages: list[bytes] = []
        self._shapes: list[ShapeEstimate] = []
        self._events: list[Event] = []
        self._alive = False
        self._state = math.nan
        self._segment_until_s = 0.0
        self._retry_s = 0.0
        self._trouble: dict[str, str] = {}
        self._errors = 0
        self._rows_lost = 0
        self.ended = False

    def drain(self) -> None:
        """Take in what the rings hold; events go to `events.jsonl` at once."""
        self._messages += self._rings["telemetry"].drain()
        if "inputs" in self._rings:
            self._input_messages += self._rings["inputs"].drain()
        if "shapes" in self._rings:
            for message in self._rings["shapes"].drain():
                self._guarded("shape estimate", partial(self._take_shape, message))
        self.take_events([events.parse(message) for message in self._rings["events"].drain()])

    def take_events(self, new: list[Event]) -> None:
        """Take in events; an "end" among them ends the run."""
        for event in new:
            self._summary.add_event(event)
            self.ended |= event.get("kind") == "end"
        self._events += new
        self._guarded("events.jsonl", lambda: self._events_file.append(new))

    def _take_shape(self, message: bytes) -> None:
        estimate: ShapeEstimate = pickle.loads(message)
        self._summary.add_shape(estimate)
        self._shapes.append(estimate)
        self._guarded("shape columns", lambda: self._columns.add_shape(estimate))

    def write(self) -> None:
        """Send to Rerun what came since the last call, and see that it reached the file."""
        now_s = self._clock.now()
        rows = unpack(self._messages)
        self._messages = []
        self._guarded("summary", lambda: self._summary.add_rows(rows))
        self._guarded("tick columns", lambda: self._columns.add_rows(rows))
        self._guarded("disk check", self._watch_disk)
        self._guarded("shape reference", lambda: self._watch_hold(rows))
        sent = self._send(now_s, rows)
        if not sent:
            self._rows_lost += len(rows)
        self._guarded("inputs file", self._write_inputs)
        self._shapes, self._events = [], []

    def _write_inputs(self) -> None:
        batch = self._assembler.take(self._input_messages)
        self._input_messages = []
        self._inputs_file.append(batch, self._shapes)

    def _send(self, now_s: float, rows: Rows) -> bool:
        """One second's worth; a writer that died is given a new file once, at once, then every `RETRY_S`."""
        for _ in range(2):
            if (not self._alive or now_s >= self._segment_until_s) and not self._begin_segment(now_s):
                return False
            self._guarded("telemetry streams", lambda: self._telemetry_streams.send(rows))
            self._guarded("event streams", lambda: send_events(self._recording, self._events))
            self._guarded("shape streams", self._send_shapes)
            try:
                self._recording.flush()
            except RecordingError as error:
                self._alive = False
                self._complain("recording", str(error))
            else:
                self._recovered("recording")
                return True
        self._retry_s = now_s + RETRY_S
        return False

    def _send_shapes(self) -> None:
        for estimate in self._shapes:
            self._shape_streams.send(estimate)
        if self._thumbnails is not None:
            self._thumbnails.send(self._clock.now())

    def _begin_segment(self, now_s: float) -> bool:
        if now_s < self._retry_s:
            return False
        try:
            self._recording.next_segment()
        except RecordingError as error:
            self._alive = False
            self._retry_s = now_s + RETRY_S
            self._complain("recording", str(error))
            return False
        self._alive = True
        self._segment_until_s = now_s + SEGMENT_S
        self._guarded("inputs file", lambda: self._inputs_file.next_segment(self._recording.segments - 1))
        self._telemetry_streams.start_segment()
        self._shape_streams.start_segment()
        return True

    def _watch_hold(self, rows: Rows) -> None:
        """Changes of the figure are against the first of the hold: before it they only show the way there."""
        if not len(rows):
            return
        state = column(rows, "state")
        if any(code == State.HOLD for _, code in changes(state, self._state)):
            self._shape_streams.rebase()
        self._state = float(state[-1])

    def _watch_disk(self) -> None:
        if free_mb(self._run_dir) < self._least_free_mb:
            limit = f"less than recording.min_free_mb = {self._least_free_mb:g} MB free"
            self._complain("disk", f"{self._run_dir}: {limit}; delete old runs", kind="disk_low")
        else:
            self._recovered("disk")

    def finish(self) -> None:
        """Last drain, close the recording with its footer, write `summary.json`."""
        self.drain()
        self.write()
        self._guarded("recording", self._recording.close)
        self._guarded("columns", self._columns.close)
        dropped = {name: ring.dropped for name, ring in self._rings.items()}
        account = {
            "segments": self._recording.segments,
            "errors": self._errors,
            "rows_lost": self._rows_lost,
            "column_rows_lost": self._columns.lost,
            "events_lost": self._events_file.lost,
        }
        text = plain_json.dumps(self._summary.as_dict(dropped, account), indent=2) + "\n"
        self._guarded("summary.json", lambda: write_text_atomic(self._run_dir / "summary.json", text))
        self._events_file.close()
        self._inputs_file.close()
        self._report({"kind": "recorder_done", "dropped": dropped, **account})

    def _guarded(self, what: str, action: Callable[[], None]) -> None:
        """Do it; what goes wrong is reported, and the rest of the recorder goes on."""
        try:
            action()
        except (OSError, RecordingError) as error:
            self._complain(what, f"{what}: {error}")
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            self._complain(
                what, f"{what}: {type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno})"
            )
        else:
            self._recovered(what)

    def _complain(self, what: str, message: str, kind: str = "recorder_error") -> None:
        """Report trouble once for as long as it is the same."""
        if self._trouble.get(what) != message:
            self._trouble[what] = message
            self._errors += kind == "recorder_error"
            self._report({"kind": kind, "message": message})

    def _recovered(self, what: str) -> None:
        if self._trouble.pop(what, None) is not None:
            self._report({"kind": "recorder_recovered", "message": f"{what} works again"})
