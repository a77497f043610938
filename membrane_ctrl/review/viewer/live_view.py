"""The live view of a run in progress, made from its tables as they grow; the run is only read.

It has the recorder's layout and streams. The recorder syncs its tables every second, so the view is
at most two seconds behind.
"""

import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path

import numpy as np
import pyarrow as pa

from membrane_ctrl.model import plain_json, telemetry
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.event_lines import from_dict
from membrane_ctrl.model.events import Event, EventLine
from membrane_ctrl.model.run_status import RunStatus
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.recorder import blueprint, recorder_errors, rerun_recording, summary_page
from membrane_ctrl.recorder.handover import load_state
from membrane_ctrl.recorder.rerun_output import RerunOutput
from membrane_ctrl.recorder.thumbnails import Thumbnail
from membrane_ctrl.run_files import shapes, table_specs
from membrane_ctrl.run_files.detail_level import DetailLevel
from membrane_ctrl.run_files.run import Run
from membrane_ctrl.run_files.table_store.follower import TableFollower
from membrane_ctrl.run_files.table_store.reader import TableReader
from membrane_ctrl.run_files.table_store.spec import TableSpec

LOOK_S = 0.5
# A browser takes in data a few times faster than a run makes them: it would be hours behind after a
# night.
RECENT_S = 600.0
_RECENT_THUMBNAILS = 16


class LiveRecording(rerun_recording.Recording):
    """A recording that goes to a viewer's server instead of files.

    Parameters
    ----------
    run : Run
    url : str
        Of the server.
    """

    def __init__(self, run: Run, url: str) -> None:
        super().__init__(run.folder, run.name, RunClock(0.0, run.origin_utc), run.config)
        self._url = url
        self._layout = blueprint.run_blueprint(run.config)
        self._is_connected = False

    def next_segment(self) -> None:
        """Connect to the server if that has not been done. Raises RecordingError."""
        if self._is_connected:
            return
        self._stream.connect_grpc(self._url, default_blueprint=self._layout)
        self._is_connected = True
        self._send_statics()
        self.flush()

    def _replace_stream(self) -> None:
        super()._replace_stream()
        self._is_connected = False


class LiveView:
    """Sends what a run's tables have got since the last call.

    Parameters
    ----------
    run : Run
    recording : Recording
        Where it is sent.
    """

    def __init__(self, run: Run, recording: rerun_recording.Recording) -> None:
        self._folder = run.folder
        self._config = run.config
        self._status = RunStatus()
        errors = recorder_errors.RecorderErrors(_print_error)
        self._output = RerunOutput(
            recording, run.config, errors, self._summary_page, overview_every_s=1.0
        )
        state = load_state(run.folder)
        if state is not None:
            self._output.shapes.reference = state.reference
            self._output.state = state.state
        self._summary = run.summary or {}
        self._now_s = _open_newest(run.folder, table_specs.TICKS.time_name, table_specs.TICKS)
        after_s = self._now_s - RECENT_S
        self._ticks = TableFollower(run.folder, table_specs.TICKS, after_s)
        self._figures = tuple(
            TableFollower(run.folder, spec, after_s)
            for spec in (table_specs.SHAPES, table_specs.TRACKED)
        )
        self._events = TableFollower(run.folder, table_specs.EVENTS)
        newest = _open_newest(run.folder, "number", table_specs.THUMBNAILS)
        self._thumbnails = TableFollower(
            run.folder, table_specs.THUMBNAILS, newest - _RECENT_THUMBNAILS
        )

    def send_new(self) -> bool:
        """Send the new rows; False if there are none."""
        rows = _read_rows(self._ticks.read_new())
        events = _read_events(self._events.read_new())
        figures = _read_estimates([table for each in self._figures for table in each.read_new()])
        thumbnails = _read_thumbnails(self._thumbnails.read_new())
        for line in events:
            mono_s = float(line.get("mono_s") or 0.0)
            self._status = self._status.after_event(from_dict(line), mono_s)
        if not (len(rows) or events or figures or thumbnails):
            return False
        if len(rows):
            self._now_s = float(telemetry.get_column(rows, "mono_s")[-1])
        self._output.send_second(self._now_s, rows, events, figures, thumbnails, DetailLevel.ALL)
        return True

    def send_waiting(self) -> None:
        """Send what waits for further rows; the run is over."""
        self._output.close()

    def _summary_page(self) -> str:
        """The page of figures so far, as the recorder has handed them on last."""
        state = load_state(self._folder)
        if state is not None:
            self._summary = state.summary.as_dict(state.dropped, {})
        if not self._summary:
            return "The recorder has not stated any figures yet.\n"
        return summary_page.summary_page(self._summary, self._status, self._config)


def follow_run(
    view: LiveView,
    folder: Path,
    wanted: Callable[[], bool],
    sleep: Callable[[float], None] = time.sleep,
) -> None:
    """Keep a view up to date until the run has its summary and all is sent, or while it is wanted.

    Parameters
    ----------
    view : LiveView
    folder : Path
        Of the run.
    wanted : callable
        Whether the viewer is still open.
    sleep : callable
        Waits some seconds.
    """
    while wanted():
        is_over = (folder / "summary.json").exists()
        if view.send_new():
            continue
        if is_over:
            view.send_waiting()
            return
        sleep(LOOK_S)


def _open_newest(folder: Path, name: str, spec: TableSpec) -> float:
    found = TableReader(folder, spec, []).read_newest(name)
    if found is None or found.as_py() is None:
        return 0.0
    return float(found.as_py())


def _read_rows(tables: Sequence[pa.Table]) -> telemetry.Rows:
    if not tables:
        return np.empty((0, len(telemetry.FIELDS)))
    joined = pa.concat_tables(tables)
    columns = [joined.column(name).to_numpy().astype(np.float64) for name in telemetry.FIELDS]
    return np.column_stack(columns)


def _read_events(tables: Sequence[pa.Table]) -> list[EventLine]:
    lines: list[EventLine] = []
    for text in chain.from_iterable(table.column("data").to_pylist() for table in tables):
        with suppress(ValueError, TypeError):  # damaged
            line = plain_json.loads(text)
            if isinstance(line, dict):
                lines.append(line)
    return lines


def _read_estimates(tables: Sequence[pa.Table]) -> list[ShapeEstimate]:
    names = list(shapes.ESTIMATE_COLUMNS)
    estimates: list[ShapeEstimate] = []
    for table in tables:
        with suppress(ValueError, LookupError):  # damaged
            estimates += shapes.read_estimates(table.select(names))
    return estimates


def _read_thumbnails(tables: Sequence[pa.Table]) -> list[Thumbnail]:
    return [
        Thumbnail(row["time_s"], row["pattern"], row["jpeg"])
        for table in tables
        for row in table.to_pylist()
    ]


def _print_error(event: Event) -> None:
    print(f"note: {event.sentence}", file=sys.stderr)
