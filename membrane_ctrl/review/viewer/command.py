"""`membrane-ctrl review RUN...`: the timeline of one or several runs, at the requested time.

`review --all`: all runs of a folder in one viewer, a Rerun catalogue with a row per run, served to
this machine only. The rows come first, from the runs' small files; each run's timeline follows in
the background, newest first.
"""

import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import rerun as rr
from rerun.blueprint.table import Column, SortBy, TableBlueprint, TableLayout
from rerun_bindings import CatalogClientInternal

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import errors, events, job_control, telemetry
from membrane_ctrl.review import catalogue, run_span, run_times
from membrane_ctrl.review.viewer import blueprints, screenshot, viewer
from membrane_ctrl.review.viewer.layer import ALL, APPLICATION, Layer
from membrane_ctrl.run_files.run import Run, open_run

_THIS_MACHINE = "127.0.0.1"
# Time shown around --at or --around.
_AROUND_S = 120.0
_DATASET = "runs"
# Property of a recording to its heading; the properties are an interface
# (docs/reference/interfaces.md).
PROPERTIES = {
    "started_utc": "started, UTC",
    "duration_s": "length, s",
    "held_s": "held, s",
    "std_um": "std, µm",
    "in_band": "in band",
    "faults": "faults",
    "faults_share": "time in faults",
    "kp_per_s": "Kp, 1/s",
    "ti_s": "Ti, s",
    "pump_scale": "pump / curve",
    "pump_sigma": "±",
    "geometry": "geometry",
    "configuration": "configuration",
    "exit": "end",
    "marks": "marks",
}


@dataclass(frozen=True, slots=True)
class ReviewOptions:
    """Options of `review`; see `membrane-ctrl review --help`."""

    runs: Sequence[Path]
    every: bool = False
    logs: Path = Path("logs")
    at: str | None = None
    around: str | None = None
    start: str | None = None
    end: str | None = None
    tab: str = "overview"
    align: str = "hold"
    live: bool = False
    web: bool = False
    bind: str = _THIS_MACHINE
    port: int = 0
    save: Path | None = None
    screenshot: Path | None = None


def review_command(options: ReviewOptions) -> int:
    """Make the review and show it."""
    _require_sense(options)
    if options.every:
        return _show_every_run(options)
    runs = [open_run(catalogue.resolve_run(path)) for path in options.runs]
    with (
        job_control.ends_as_by_ctrl_c(),
        tempfile.TemporaryDirectory(prefix="membrane-review-") as folder,
    ):
        if options.live:
            return viewer.show_live_run(runs[0], options.web, options.port)
        for target in (options.save, options.screenshot):
            if target is not None:
                _require_writable(target, runs)
        file = options.save or Path(folder) / "review.rrd"
        try:
            cursor = make_review(runs, options, file)
        finally:
            for run in runs:
                for note in run.notes:
                    print(f"note: {run.name}: {note}", file=sys.stderr)
        return _show_file(file, options, cursor)


def _show_file(file: Path, options: ReviewOptions, cursor: viewer.CursorTime | None) -> int:
    if options.screenshot is not None:
        return _write_picture(options.screenshot, file, cursor)
    if options.save is not None:
        print(file)
        return 0
    if options.web:
        return viewer.serve_source(file, options.bind, options.port)
    return viewer.show_source(file, cursor)


def _write_picture(
    target: Path, source: Path | str, cursor: viewer.CursorTime | None = None
) -> int:
    try:
        target.write_bytes(screenshot.take_screenshot(source, cursor))
    except RuntimeError as error:
        raise errors.DeviceError(f"no picture: {error}") from None
    return 0


def _show_every_run(options: ReviewOptions) -> int:
    found = catalogue.list_entries(options.logs)
    if not found:
        raise errors.InputError(f"{options.logs}: contains no run")
    with (
        job_control.ends_as_by_ctrl_c(),
        tempfile.TemporaryDirectory(prefix="membrane-review-") as folder,
    ):
        served = RunCatalogue(found, Path(folder))
        print(f"catalogue of {len(found)} runs for Rerun clients: {served.url}", file=sys.stderr)
        try:
            if options.screenshot is not None:
                return _write_picture(options.screenshot, served.page)
            if options.web:
                return viewer.serve_source(
                    served.page, options.bind, options.port, served.add_timelines
                )
            return viewer.show_source(served.page, meanwhile=served.add_timelines)
        finally:
            served.close()


def _require_sense(options: ReviewOptions) -> None:
    """Refuse unknown values, and options that would be silently ignored."""
    # Values that mean nothing.
    if bool(options.runs) == options.every:
        raise errors.InputError("review: name one run or several, or give --all for all of them")
    if options.tab not in blueprints.TABS:
        raise errors.InputError(f"--tab {options.tab}: known: {', '.join(blueprints.TABS)}")
    if options.align not in {"hold", "start", "utc"}:
        raise errors.InputError(f"--align {options.align}: known: hold, start, utc")
    if options.around is not None and not options.around.strip():
        raise errors.InputError("--around: name an event, e.g. --around hold")
    # Options that exclude each other, or go only with another one.
    moments = (options.at, options.around, options.start or options.end)
    if sum(moment is not None for moment in moments) > 1:
        raise errors.InputError("--at, --around, --from with --to: only one of these at a time")
    if not options.web and (options.bind != _THIS_MACHINE or options.port):
        raise errors.InputError("--bind and --port: only with --web")
    if options.every and (
        options.live or options.save or options.bind != _THIS_MACHINE or any(moments)
    ):
        raise errors.InputError(
            "--all serves this machine only, and all of each run: omit --bind, --at and the like"
        )
    if not options.live:
        return
    # The view of a hold in progress follows it alone, with nothing chosen from the past.
    if len(options.runs) != 1:
        raise errors.InputError("--live: one run at a time")
    if any(part is not None for part in (*moments, options.save, options.screenshot)):
        raise errors.InputError(
            "--live follows the run in progress: omit --at, --from, --save and similar options"
        )
    if options.bind != _THIS_MACHINE:
        raise errors.InputError(
            "--live serves this machine only: omit --bind and use the printed ssh line"
        )


def _require_writable(target: Path, runs: Sequence[Run]) -> None:
    """Check the target before the work, not after it."""
    if any(target.resolve().parent == run.folder.resolve() for run in runs):
        raise errors.InputError(f"{target}: is in a folder of the recorder; choose another folder")
    with errors.convert_write_errors(target, errors.DeviceError, "; choose another place"):
        new = not target.exists()
        target.open("ab").close()
        if new:
            target.unlink()


def make_review(
    runs: Sequence[Run], options: ReviewOptions, file: Path
) -> viewer.CursorTime | None:
    """Write the recording that the viewer opens.

    Raises InputError if the first run lacks a requested time or event, or no run has telemetry.

    Parameters
    ----------
    runs : sequence of Run
        One run, or several to overlay.
    options : ReviewOptions
        For the requested part, the cursor, and how several runs are aligned.
    file : Path
        File to write.

    Returns
    -------
    viewer.CursorTime or None
        Where to put the time cursor: the requested moment, or the start of the part.
    """
    runs = _with_telemetry(runs)
    # Which part of the first run is asked for, and which second of each run is zero.
    span_s = _requested_part(runs[0], options)
    zeros_s = _find_zero_seconds(runs, options.align)
    labels = blueprints.labels_of([run.name for run in runs])
    layer = Layer(file, runs[0].name if len(runs) == 1 else " and ".join(labels))
    # Each run with its own origin: the part is shifted from the first run's clock to its own.
    for run, label, zero_s in zip(runs, labels, zeros_s, strict=True):
        if span_s is None:
            part_s = ALL
        else:
            part_s = (span_s[0] - zeros_s[0] + zero_s, span_s[1] - zeros_s[0] + zero_s)
        layer.add_run(run, label, zero_s, part_s)
    # One run, or runs aligned by the clock, share a timeline of dates; else seconds from the zeros.
    by_clock = len(runs) == 1 or options.align == "utc"
    timeline = "utc" if by_clock else "run_time"
    if by_clock:
        zero_ns = round(1e9 * runs[0].origin_utc.timestamp())
    else:
        zero_ns = -round(1e9 * zeros_s[0])
    # The viewer opens on the requested part, with the cursor at the moment that was asked for.
    shown_ns = None
    if span_s is not None:
        shown_ns = (zero_ns + round(1e9 * span_s[0]), zero_ns + round(1e9 * span_s[1]))
    blueprint = blueprints.ReviewBlueprint(labels, timeline, shown_ns, runs[0].config)
    layer.send_blueprint(blueprint.make_blueprint(options.tab))
    layer.close()
    if shown_ns is None:
        return None
    return viewer.CursorTime(
        timeline, shown_ns[0] if options.start or options.end else sum(shown_ns) // 2
    )


def _with_telemetry(runs: Sequence[Run]) -> list[Run]:
    """The runs that can be shown; adds a note to the others."""
    there = [run for run in runs if run_span.end_s(run)]
    if not there:
        raise errors.InputError(
            f"{', '.join(str(run.folder) for run in runs)}: no readable telemetry"
        )
    for run in runs:
        if run not in there:
            run.notes.append("not shown: no readable telemetry")
    return there


def _requested_part(run: Run, options: ReviewOptions) -> tuple[float, float] | None:
    """The requested part of the run, in seconds."""
    if options.start is not None or options.end is not None:
        start_s, end_s = run_times.part_s(run.origin_utc, options.start, options.end)
        if start_s >= run_span.end_s(run):
            raise run_span.make_outside_error(run, f"--from {options.start}")
        if end_s <= 0:
            raise run_span.make_outside_error(run, f"--to {options.end}")
        if options.start is None:
            start_s = 0.0
        if options.end is None:
            end_s = run_span.end_s(run)
        return start_s, end_s
    if options.at is not None:
        at_s = run_times.moment_s(options.at, run.origin_utc)
        if not -_AROUND_S <= at_s <= run_span.end_s(run) + _AROUND_S:
            raise run_span.make_outside_error(run, f"--at {options.at}")
    elif options.around is not None:
        at_s = _find_event_time(run, options.around)
    else:
        return None
    return at_s - _AROUND_S, at_s + _AROUND_S


def _find_event_time(run: Run, what: str) -> float:
    """Time of the first event, recorded or detected, whose kind, name, state, text or command
    contains `what`.
    """
    wanted = what.lower()
    # `hold` means the state, not the command that led to it
    for keys in (("kind", "name", "state", "text"), ("command",)):
        for each in run.log:
            if any(wanted in str(each.line.get(key, "")).lower() for key in keys):
                return each.mono_s
    from membrane_ctrl.review.events.found import LEVEL_COLUMNS, find_events

    found = find_events(
        run.level(1.0, names=LEVEL_COLUMNS), run.shapes(), run.config.limits.band_um
    )
    for item in found:
        if wanted in item.kind:
            return item.time_s
    logged_kinds = {
        str(e.get("name") or e.get("state") or e.get("command") or e.get("kind"))
        for e in run.events
    }
    named = sorted(logged_kinds - {"why"} | {item.kind for item in found})
    raise errors.InputError(
        f"--around {what}: no such event in {run.name}; known: {', '.join(named)}"
    )


def _find_zero_seconds(runs: Sequence[Run], align: str) -> list[float]:
    """The second of each run at 0 on the timeline."""
    if len(runs) == 1 or align == "start":
        return [0.0] * len(runs)
    if align == "utc":
        return [(runs[0].origin_utc - run.origin_utc).total_seconds() for run in runs]
    return [_hold_s(run) for run in runs]


def _hold_s(run: Run) -> float:
    """Second in which a run began to hold: by its events, or to a minute by its tables; 0 if it
    never did.
    """
    for each in run.log:
        if isinstance(each.event, events.StateEntered) and each.event.state == "hold":
            return each.mono_s
    level = run.level(60.0, names=("state",))
    held_s = level["time_s"][level["state"] == telemetry.State.HOLD]
    return float(held_s[0]) if held_s.size else 0.0


class RunCatalogue:
    """A catalogue server, until closed.

    Parameters
    ----------
    entries : sequence of RunEntry
        The runs, at least one.
    folder : Path
        Empty folder for its files, to be deleted afterwards.
    """

    def __init__(self, entries: Sequence[catalogue.RunEntry], folder: Path) -> None:
        self._folder = folder
        self._entries = entries
        rows = [
            _write_properties(entry, folder / f"row-{number}.rrd")
            for number, entry in enumerate(entries)
        ]
        self._server = rr.server.Server(host="127.0.0.1", datasets={_DATASET: rows})
        # the public client would need datafusion, which takes 115 MB
        self._dataset = rr.catalog.DatasetEntry(
            CatalogClientInternal(self._server.url()).datasets(include_hidden=False)[0]
        )
        self._lay_out()
        self.url = self._server.url()  # for clients
        self.page = f"{self.url}/entry/{self._dataset.id}"  # its table, for the viewer

    def close(self) -> None:
        """Stop the server."""
        self._server.shutdown()

    def add_timelines(self, wanted: Callable[[], bool]) -> None:
        """Add the runs' timelines, newest first, while `wanted`; a run that has none is named on
        stderr.
        """
        for number, entry in reversed(list(enumerate(self._entries))):
            if not wanted():
                return
            try:
                self._add_timeline(entry, self._folder / f"timeline-{number}.rrd")
            except (errors.CommandError, OSError) as error:
                print(f"note: {entry.name}: no timeline ({error})", file=sys.stderr)

    def _add_timeline(self, entry: catalogue.RunEntry, file: Path) -> None:
        layer = Layer(file, entry.name, overview_only=True)
        try:
            layer.add_run(open_run(entry.folder))
        finally:
            layer.close()
        self._dataset.register([file.as_uri()], layer_name="timeline").wait()

    def _lay_out(self) -> None:
        """One layout for the table, one for every run."""
        columns = [Column("recording link", name="run")]
        learned = any(entry.pump_scale == entry.pump_scale for entry in self._entries)
        shown = {
            name: words
            for name, words in PROPERTIES.items()
            if learned or not name.startswith("pump_")
        }
        columns += [Column(f"property:run:{name}", name=heading) for name, heading in shown.items()]
        hidden = [
            Column(f"property:RecordingInfo:{name}", visible=False)
            for name in ("name", "start_time")
        ]
        started = SortBy("property:run:started_utc", direction="Descending")
        table = TableBlueprint(table_layout=TableLayout(columns=columns + hidden), sort_by=started)
        coarse = blueprints.ReviewBlueprint(("",), "utc", None, Config())
        runs = coarse.make_blueprint(tabs=blueprints.COARSE_TABS)
        table.save(APPLICATION, self._folder / "table.rbl")
        runs.save(APPLICATION, self._folder / "run.rbl")
        self._dataset.register_blueprint((self._folder / "table.rbl").as_uri(), segment_table=True)
        self._dataset.register_blueprint((self._folder / "run.rbl").as_uri())


def _write_properties(entry: catalogue.RunEntry, file: Path) -> Path:
    """Write a recording that has only the run's properties; unknown ones are omitted."""
    values = catalogue.as_dict(entry) | {"started_utc": f"{entry.started_utc:%Y-%m-%d %H:%M:%S}"}
    values["geometry"] = entry.geometry[:8]
    if entry.duration_s:
        values["faults_share"] = entry.faults_s / entry.duration_s
    else:
        values["faults_share"] = float("nan")
    # more digits would make the table's columns too wide to compare
    values |= {
        name: float(f"{value:.4g}") for name, value in values.items() if isinstance(value, float)
    }
    known = {
        name: values[name]
        for name in PROPERTIES
        if values[name] == values[name] and values[name] != ""
    }
    stream = rr.RecordingStream(APPLICATION, recording_id=entry.name)
    stream.save(file)
    stream.send_recording_name(entry.name)
    stream.send_property("run", rr.AnyValues(**known))
    stream.disconnect()
    return file
