"""The recorder: turns ring messages into files, Rerun data and the summary. Nothing here may end it
silently.
"""

from functools import partial
from pathlib import Path

from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.tick_assembler import TickAssembler
from membrane_ctrl.model import (
    event_lines,
    file_checksums,
    files,
    recorder_events,
    run_events,
    shape_estimate,
)
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.events import Event, EventLine
from membrane_ctrl.model.run_status import RunStatus
from membrane_ctrl.processes.ring import RingReader
from membrane_ctrl.recorder import (
    events_file,
    folder_watch,
    housekeeping,
    recorder_errors,
    rerun_output,
    rerun_recording,
    summary_page,
)
from membrane_ctrl.recorder.feed import Feed
from membrane_ctrl.recorder.handover import (
    RecorderState,
    load_state,
    remove_state,
    save_state,
)
from membrane_ctrl.recorder.thumbnails import Thumbnail, Thumbnails
from membrane_ctrl.run_files import event_log
from membrane_ctrl.run_files.detail_level import DetailLevel
from membrane_ctrl.run_files.run_tables import RunTables
from membrane_ctrl.run_files.summary import Summary


class Recorder:
    """Writes everything of a run to disk.

    Parameters
    ----------
    rings : dict
        Readers by name: "inputs" (the ticks), "events", "snapshots" if there are any, and "shapes"
        if the shape is measured.
    recording : Recording
        The Rerun file, without a segment yet.
    report : callable
        Takes an event for the supervisor; never blocks, never raises.
    resumes : int
        Number of earlier recorders of this run that died.

    Attributes
    ----------
    ended : bool
        The run's "end" event has arrived.
    urgent : bool
        A message has arrived for which `write_second` should not wait.
    """

    def __init__(
        self,
        run_dir: Path,
        clock: RunClock,
        config: Config,
        rings: dict[str, RingReader],
        recording: rerun_recording.Recording,
        thumbnails: Thumbnails | None,
        report: recorder_errors.Report,
        resumes: int = 0,
    ) -> None:
        # A recorder that replaces a dead one continues from that one's state file; without it, from
        # the oldest messages in the rings
        handed_on = load_state(run_dir) if resumes else None
        before = handed_on or RecorderState(Summary.for_config(config))
        self._run_dir = run_dir
        self._config = config
        self._folder = folder_watch.FolderWatch(run_dir)
        self._folder_replaced_s = before.folder_replaced_s
        self._clock = clock
        self._feeds = {
            name: Feed(ring, before.positions.get(name, 0), before.dropped.get(name, 0))
            for name, ring in rings.items()
        }
        self._errors = recorder_errors.RecorderErrors(report, before.errors)
        self._housekeeping = housekeeping.Housekeeping(
            run_dir, clock, config.recording, self._errors
        )
        self._rerun = rerun_output.RerunOutput(recording, config, self._errors, self._summary_page)
        self._rerun.shapes.reference = before.reference
        self._rerun.state = before.state
        self._events_file = events_file.EventsFile(run_dir / "events.jsonl", resumed=resumes > 0)
        self._events_lost = before.events_lost
        self._summary = before.summary
        self._status = RunStatus()
        if resumes:
            for logged in event_log.read_events(run_dir, []):
                self._status = self._status.after_event(logged.event, logged.mono_s)
        self._tables = RunTables(run_dir, clock.origin_utc, before.windows if resumes else None)
        self._input_ticks_lost = before.input_ticks_lost
        self._assembler = TickAssembler()
        self._frames = thumbnails
        self._thumbnails: list[Thumbnail] = []  # of this second
        self._resumes = resumes
        self._restarted_without_handover = resumes > 0 and handed_on is None
        self._messages: list[bytes] = []
        self._shapes: list[shape_estimate.ShapeEstimate] = []
        self._events: list[EventLine] = []
        self._rows_lost = before.rows_lost
        # one that replaces another may find the end of the run in the file
        self.ended = self._status.ended
        self.urgent = False

    def drain_rings(self) -> None:
        """Take all ring messages; events go to `events.jsonl` at once."""
        self._messages += self._feeds["inputs"].drain_messages()
        # behind the ticks: then those of all drained ticks are there
        if "snapshots" in self._feeds:
            self._assembler.add_snapshots(self._feeds["snapshots"].drain_messages())
        if "shapes" in self._feeds:
            for message in self._feeds["shapes"].drain_messages():
                self._errors.run_guarded("shape estimate", partial(self._add_shape, message))
        self.add_events(
            [event_lines.parse_event(message) for message in self._feeds["events"].drain_messages()]
        )

    def add_events(self, new: list[EventLine]) -> None:
        """Take events; an "end" among them ends the run."""
        # 1. What this recorder follows by itself: summary, status, the end of the run
        for line in new:
            event = event_lines.from_dict(line)
            self._summary.add_event(line)
            self._errors.run_guarded(
                "status", partial(self._follow_event, event, float(line.get("mono_s") or 0.0))
            )
            self.urgent |= event.urgent
            self.ended |= isinstance(event, run_events.Ended)
        # 2. The files. The table first: `events.jsonl` knows which lines are not written yet
        self._events += new
        self._errors.run_guarded(
            "table of events",
            lambda: self._tables.add_events(self._events_file.select_unwritten(new)),
        )
        self._errors.run_guarded("events.jsonl", lambda: self._events_file.append_events(new))

    def _follow_event(self, event: Event, mono_s: float) -> None:
        self._status = self._status.after_event(event, mono_s)

    def _add_shape(self, message: bytes) -> None:
        estimate = shape_estimate.unpack_estimate(message)
        self._summary.add_shape(estimate)
        self._shapes.append(estimate)
        self._errors.run_guarded("table of shapes", lambda: self._tables.add_shape(estimate))

    def write_second(self) -> None:
        """Write everything since the last call to disk, and sync it."""
        now_s = self._clock.now()
        self._errors.run_guarded("new run folder", lambda: self._watch_folder(now_s))
        # Take what has come; a failure below must not bring it twice.
        batch = self._assembler.add_messages(self._messages)
        rows, shapes, new_events = batch.rows, self._shapes, self._events
        self._messages = []
        self._shapes = []
        self._events = []
        self.urgent = False
        # The exact tables first, then the Rerun recording, which may be omitted.
        guarded = self._errors.run_guarded
        # Each by itself: a full disk or a fault in one of them must not stop the others
        guarded("summary", lambda: self._summary.add_rows(rows))
        guarded("table of ticks", lambda: self._tables.add_ticks(batch))
        guarded("table of thumbnails", lambda: self._add_thumbnails(now_s))
        guarded("tables", self._tables.sync_tables)
        guarded("parts of tables", self._tables.seal_full_journal)
        closed, self._rerun.closed = self._rerun.closed, []
        self._housekeeping.watch_disk(now_s, closed)
        if not self._rerun.send_second(
            now_s, rows, new_events, shapes, self._thumbnails, self._housekeeping.detail
        ):
            self._rows_lost += len(rows)
        # Last: a successor repeats what this second may have written after it, and the tables drop
        # rows that they have
        guarded("state file", self._write_handover)

    def _add_thumbnails(self, now_s: float) -> None:
        self._thumbnails = []
        if self._frames is None or self._housekeeping.detail != DetailLevel.ALL:
            return
        self._thumbnails = self._frames.take_due(now_s)
        for each in self._thumbnails:
            self._tables.add_thumbnail(each.time_s, each.pattern, each.jpeg)

    def _summary_page(self) -> str:
        return summary_page.summary_page(
            self._summary.as_dict(self._report_dropped(), {}), self._status, self._config
        )

    def _watch_folder(self, now_s: float) -> None:
        """Continue in a new folder if the run's was removed: writing to a deleted file raises no
        error.
        """
        if not self._folder.is_gone():
            return
        self._folder.restart(self._config)
        self._folder_replaced_s = now_s
        # never cleared: the lost part stays lost
        what = f"{self._run_dir} was removed or moved; a new one starts at {now_s:.1f} s"
        self._errors.report_error("run folder", f"{what}, without the earlier data")
        self._tables.leave_folder()
        self._rerun.leave_folder()
        self._events_file.restart(self._events)

    def _write_handover(self) -> None:
        """Save the state that a successor would need."""
        state = RecorderState(
            self._summary,
            {name: feed.position for name, feed in self._feeds.items()},
            self._report_dropped(),
            self._rerun.shapes.reference,
            self._rerun.state,
            self._tables.open_windows,
            self._errors.errors,
            self._rows_lost,
            self._events_lost + self._events_file.lost,
            self._input_ticks_lost + self._tables.lost_ticks,
            self._folder_replaced_s,
        )
        save_state(self._run_dir, state)

    def _report_dropped(self) -> dict[str, int]:
        return {name: feed.dropped for name, feed in self._feeds.items()}

    def finish(self, in_haste: bool = False) -> None:
        """Drain once more, close the recording with its footer, write `summary.json`, optimise
        unless `in_haste`.
        """
        # All that is still in the rings; then what a reader needs to trust the run: the footer, the
        # sealed tables, and the account of losses in the summary
        self.drain_rings()
        self.write_second()
        guarded = self._errors.run_guarded
        guarded("recording", self._rerun.close)
        guarded("tables", self._tables.close)
        account = {
            "segments": self._rerun.next_segment,
            "tables": self._tables.part_counts,
            "errors": self._errors.errors,
            "rows_lost": self._rows_lost,
            "table_rows_lost": self._tables.lost_rows,
            "events_lost": self._events_lost + self._events_file.lost,
            "input_ticks_lost": self._input_ticks_lost + self._tables.lost_ticks,
            "restarts": self._resumes,
            "folder_replaced_s": self._folder_replaced_s,  # None: it is still the original
            # without its predecessor's state, the statistics start with the oldest message in the
            # ring
            "partial": self._restarted_without_handover and self._feeds["inputs"].dropped > 0,
        }
        text = (
            file_checksums.dumps_checked(
                self._summary.as_dict(self._report_dropped(), account), indent=2
            )
            + "\n"
        )
        guarded(
            "summary.json", lambda: files.write_text_atomic(self._run_dir / "summary.json", text)
        )
        self._events_file.close()
        self._folder.close()
        remove_state(self._run_dir)
        # last, as it is optional: this process may be killed now
        closed, self._rerun.closed = self._rerun.closed, []
        if not in_haste:
            self._housekeeping.optimise_remaining(closed)
        self._housekeeping.close()
        self._errors.report(recorder_events.RecorderDone(self._report_dropped(), **account))
