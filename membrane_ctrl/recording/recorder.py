"""What the recorder does with what the rings bring: files, Rerun, summary. Nothing here may end it silently."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from membrane_ctrl import __version__
from membrane_ctrl.clock import RunClock
from membrane_ctrl.config import Config
from membrane_ctrl.estimate import ShapeEstimate, unpack_estimate
from membrane_ctrl.ipc.ring import RingReader
from membrane_ctrl.recording import events
from membrane_ctrl.recording.atomic import write_text_atomic
from membrane_ctrl.recording.checked_text import dumps_checked
from membrane_ctrl.recording.column_tables import ColumnTables
from membrane_ctrl.recording.complaints import Complaints, Report
from membrane_ctrl.recording.events import Event, EventsFile
from membrane_ctrl.recording.feed import Feed
from membrane_ctrl.recording.folder_watch import FolderWatch
from membrane_ctrl.recording.housekeeping import Housekeeping
from membrane_ctrl.recording.inputs_file import InputsFile
from membrane_ctrl.recording.rerun_output import FrameSource, RerunOutput
from membrane_ctrl.recording.rows import unpack
from membrane_ctrl.recording.sink import Recording
from membrane_ctrl.recording.state_file import RecorderState, load_state, remove_state, save_state
from membrane_ctrl.recording.summary import Summary
from membrane_ctrl.tick_record import TickAssembler

# After these the disk is waited for at once: a power cut may follow.
_URGENT = frozenset({"fault", "end"})


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
    resumes : int
        How many recorders of this run have died before.

    Attributes
    ----------
    ended : bool
        The run's "end" event has come.
    urgent : bool
        Something has come that `write` should not wait for its second with.
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
        resumes: int = 0,
    ) -> None:
        handed_on = load_state(run_dir) if resumes else None
        before = handed_on or RecorderState(Summary(config))
        self._run_dir = run_dir
        self._config = config
        self._folder = FolderWatch(run_dir)
        self._folder_anew_s = before.folder_anew_s
        self._clock = clock
        self._feeds = {
            name: Feed(ring, before.positions.get(name, 0), before.dropped.get(name, 0))
            for name, ring in rings.items()
        }
        self._complaints = Complaints(report, before.errors)
        self._housekeeping = Housekeeping(run_dir, clock, config.recording, self._complaints)
        self._rerun = RerunOutput(recording, config, thumbnails, self._complaints)
        self._rerun.shapes.reference, self._rerun.state = before.reference, before.state
        self._events_file = EventsFile(run_dir / "events.jsonl", resumed=resumes > 0)
        self._events_lost = before.events_lost
        self._summary = before.summary
        self._columns = ColumnTables(run_dir, before.windows if resumes else None)
        self._inputs_file = InputsFile(run_dir, __version__, config.recording.segment_s)
        self._input_ticks_lost = before.input_ticks_lost
        self._assembler = TickAssembler()
        self._resumes = resumes
        self._began_anew = resumes > 0 and handed_on is None
        self._messages: list[bytes] = []
        self._input_messages: list[bytes] = []
        self._shapes: list[ShapeEstimate] = []
        self._events: list[Event] = []
        self._rows_lost = before.rows_lost
        self.ended = self.urgent = False

    def drain(self) -> None:
        """Take in what the rings hold; events go to `events.jsonl` at once."""
        self._messages += self._feeds["telemetry"].drain()
        if "inputs" in self._feeds:
            self._input_messages += self._feeds["inputs"].drain()
        if "shapes" in self._feeds:
            for message in self._feeds["shapes"].drain():
                self._complaints.guarded("shape estimate", partial(self._take_shape, message))
        self.take_events([events.parse(message) for message in self._feeds["events"].drain()])

    def take_events(self, new: list[Event]) -> None:
        """Take in events; an "end" among them ends the run."""
        for event in new:
            self._summary.add_event(event)
            self.urgent |= event.get("kind") in _URGENT
            self.ended |= event.get("kind") == "end"
        self._events += new
        self._complaints.guarded("events.jsonl", lambda: self._events_file.append(new))

    def _take_shape(self, message: bytes) -> None:
        estimate = unpack_estimate(message)
        self._summary.add_shape(estimate)
        self._shapes.append(estimate)
        self._complaints.guarded("shape columns", lambda: self._columns.add_shape(estimate))

    def write(self) -> None:
        """Bring what came since the last call to the disk, and see that it got there."""
        now_s = self._clock.now()
        self._complaints.guarded("new run folder", lambda: self._see_folder(now_s))
        rows = unpack(self._messages)
        shapes, new_events = self._shapes, self._events
        self._messages, self._shapes, self._events = [], [], []
        self.urgent = False
        guarded = self._complaints.guarded
        guarded("inputs file", lambda: self._write_inputs(now_s, shapes))
        guarded("summary", lambda: self._summary.add_rows(rows))
        guarded("tick columns", lambda: self._columns.add_rows(rows))
        guarded("columns", self._columns.sync)
        closed, self._rerun.closed = self._rerun.closed, []
        self._housekeeping.look(now_s, closed)
        if not self._rerun.send(now_s, rows, new_events, shapes, self._housekeeping.thrift):
            self._rows_lost += len(rows)
        guarded("state file", self._hand_on)

    def _see_folder(self, now_s: float) -> None:
        """Go on in a new folder if the run's was taken away: writing to a deleted file goes without an error."""
        if not self._folder.gone():
            return
        self._folder.begin_anew(self._config)
        self._folder_anew_s = now_s
        # never taken back: what is missing stays missing
        what = f"{self._run_dir} was removed or moved, and is begun anew at {now_s:.1f} s"
        self._complaints.complain("run folder", f"{what}; what was recorded before is not in it")
        self._inputs_file.close()
        self._columns.leave_folder()
        self._rerun.leave_folder()
        self._events_file.begin_anew(self._events)

    def _write_inputs(self, now_s: float, shapes: list[ShapeEstimate]) -> None:
        batch = self._assembler.take(self._input_messages)
        self._input_messages = []
        self._inputs_file.append(batch, shapes, now_s)
        self._inputs_file.sync()

    def _hand_on(self) -> None:
        """Leave behind what another recorder would need to go on from here."""
        state = RecorderState(
            self._summary,
            {name: feed.position for name, feed in self._feeds.items()},
            self._dropped(),
            self._rerun.shapes.reference,
            self._rerun.state,
            self._columns.open_windows,
            self._complaints.errors,
            self._rows_lost,
            self._events_lost + self._events_file.lost,
            self._input_ticks_lost + self._inputs_file.lost_ticks,
            self._folder_anew_s,
        )
        save_state(self._run_dir, state)

    def _dropped(self) -> dict[str, int]:
        return {name: feed.dropped for name, feed in self._feeds.items()}

    def finish(self, in_haste: bool = False) -> None:
        """Last drain, close the recording with its footer, write `summary.json`, optimise unless `in_haste`."""
        self.drain()
        self.write()
        guarded = self._complaints.guarded
        guarded("recording", self._rerun.close)
        guarded("columns", self._columns.close)
        account = {
            "segments": self._rerun.segments,
            "tables": self._columns.files,
            "errors": self._complaints.errors,
            "rows_lost": self._rows_lost,
            "column_rows_lost": self._columns.lost,
            "events_lost": self._events_lost + self._events_file.lost,
            "input_ticks_lost": self._input_ticks_lost + self._inputs_file.lost_ticks,
            "restarts": self._resumes,
            "folder_anew_s": self._folder_anew_s,  # None: it is the one that was begun
            # without what the former recorder knew, the statistics begin with what the ring still had
            "partial": self._began_anew and self._feeds["telemetry"].dropped > 0,
        }
        text = dumps_checked(self._summary.as_dict(self._dropped(), account), indent=2) + "\n"
        guarded("summary.json", lambda: write_text_atomic(self._run_dir / "summary.json", text))
        self._events_file.close()
        self._inputs_file.close()
        self._folder.close()
        remove_state(self._run_dir)
        # last, as nobody needs it: whoever is in a hurry may kill this process now
        closed, self._rerun.closed = self._rerun.closed, []
        if not in_haste:
            self._housekeeping.finish(closed)
        self._housekeeping.close()
        done: dict[str, Any] = {"kind": "recorder_done", "dropped": self._dropped(), **account}
        self._complaints.report(done)
