"""`membrane-ctrl review RUN...`: the timeline of one or several runs, at the requested time."""

import re
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from membrane_ctrl.model import errors, events, telemetry, terminal
from membrane_ctrl.review import catalogue, words
from membrane_ctrl.review.viewer import blueprints, viewer
from membrane_ctrl.review.viewer.layer import ALL, Layer
from membrane_ctrl.run_files.run import Run, open_run

_THIS_MACHINE = "127.0.0.1"
# Time shown around --at or --around.
_AROUND_S = 120.0


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
    runs = [open_run(catalogue.resolve(path)) for path in options.runs]
    with terminal.ends_as_by_ctrl_c(), tempfile.TemporaryDirectory(prefix="membrane-review-") as folder:
        if options.live:
            return viewer.live(runs[0].folder, options.web, options.port)
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
        return _show(file, options, cursor)


def _show(file: Path, options: ReviewOptions, cursor: viewer.CursorTime | None) -> int:
    if options.screenshot is not None:
        return _picture(options.screenshot, file, cursor)
    if options.save is not None:
        print(file)
        return 0
    return viewer.serve(file, options.bind, options.port) if options.web else viewer.show(file, cursor)


def _picture(target: Path, source: Path | str, cursor: viewer.CursorTime | None = None) -> int:
    try:
        target.write_bytes(viewer.screenshot_of(source, cursor))
    except RuntimeError as error:
        raise errors.DeviceError(f"no picture: {error}") from None
    return 0


def _show_every_run(options: ReviewOptions) -> int:
    from membrane_ctrl.review.viewer.all_runs import RunCatalogue

    found = catalogue.entries(options.logs)
    if not found:
        raise errors.InputError(f"{options.logs}: contains no run")
    with terminal.ends_as_by_ctrl_c(), tempfile.TemporaryDirectory(prefix="membrane-review-") as folder:
        served = RunCatalogue(found, Path(folder))
        print(f"catalogue of {len(found)} runs for Rerun clients: {served.url}", file=sys.stderr)
        try:
            if options.screenshot is not None:
                return _picture(options.screenshot, served.page)
            if options.web:
                return viewer.serve(served.page, options.bind, options.port, served.add_timelines)
            return viewer.show(served.page, meanwhile=served.add_timelines)
        finally:
            served.close()


def _require_sense(options: ReviewOptions) -> None:
    """Refuse unknown values, and options that would be silently ignored."""
    if bool(options.runs) == options.every:
        raise errors.InputError("review: name one run or several, or give --all for all of them")
    if options.tab not in blueprints.TABS:
        raise errors.InputError(f"--tab {options.tab}: known: {', '.join(blueprints.TABS)}")
    if options.align not in {"hold", "start", "utc"}:
        raise errors.InputError(f"--align {options.align}: known: hold, start, utc")
    if options.around is not None and not options.around.strip():
        raise errors.InputError("--around: name an event, e.g. --around hold")
    moments = (options.at, options.around, options.start or options.end)
    if sum(moment is not None for moment in moments) > 1:
        raise errors.InputError("--at, --around, --from with --to: only one of these at a time")
    if not options.web and (options.bind != _THIS_MACHINE or options.port):
        raise errors.InputError("--bind and --port: only with --web")
    if options.every and (options.live or options.save or options.bind != _THIS_MACHINE or any(moments)):
        raise errors.InputError("--all serves this machine only, and all of each run: omit --bind, --at and the like")
    if not options.live:
        return
    if len(options.runs) != 1:
        raise errors.InputError("--live: one run at a time")
    if any(part is not None for part in (*moments, options.save, options.screenshot)):
        raise errors.InputError("--live follows the run in progress: omit --at, --from, --save and similar options")
    if options.bind != _THIS_MACHINE:
        raise errors.InputError("--live serves this machine only: omit --bind and use the printed ssh line")


def _require_writable(target: Path, runs: Sequence[Run]) -> None:
    """Check the target before the work, not after it."""
    if any(target.resolve().parent == run.folder.resolve() for run in runs):
        raise errors.InputError(f"{target}: is in a folder of the recorder; choose another folder")
    with errors.writing(target, errors.DeviceError, "; choose another place"):
        new = not target.exists()
        target.open("ab").close()
        if new:
            target.unlink()


def make_review(runs: Sequence[Run], options: ReviewOptions, file: Path) -> viewer.CursorTime | None:
    """Write the recording that the viewer opens.

    Raises InputError if the first run lacks a requested time or event, or no run has telemetry.

    Parameters
    ----------
    runs : sequence of Run
        One run, or several to overlay.
    file : Path
        File to write.

    Returns
    -------
    viewer.CursorTime or None
        Where to put the time cursor: the requested moment, or the start of the part.
    """
    runs = _with_telemetry(runs)
    span_s = _span(runs[0], options)
    zeros_s = _zeros(runs, options.align)
    labels = labels_of([run.name for run in runs])
    layer = Layer(file, runs[0].name if len(runs) == 1 else " and ".join(labels))
    for run, label, zero_s in zip(runs, labels, zeros_s, strict=True):
        part_s = ALL if span_s is None else (span_s[0] - zeros_s[0] + zero_s, span_s[1] - zeros_s[0] + zero_s)
        layer.add(run, label, zero_s, part_s)
    by_clock = len(runs) == 1 or options.align == "utc"
    timeline = "utc" if by_clock else "run_time"
    zero_ns = round(1e9 * runs[0].origin_utc.timestamp()) if by_clock else -round(1e9 * zeros_s[0])
    shown_ns = None if span_s is None else (zero_ns + round(1e9 * span_s[0]), zero_ns + round(1e9 * span_s[1]))
    blueprint = blueprints.ReviewBlueprint(labels, timeline, shown_ns, runs[0].config.limits.band_um)
    layer.blueprint(blueprint.made(options.tab))
    layer.close()
    if shown_ns is None:
        return None
    return viewer.CursorTime(timeline, shown_ns[0] if options.start or options.end else sum(shown_ns) // 2)


def labels_of(names: Sequence[str]) -> list[str]:
    """Names of overlaid runs, without the times of their starts if they differ even so; empty for a single run."""
    if len(names) == 1:
        return [""]
    short = [re.sub(r"^\d{8}T\d{6}Z-(?=.)", "", name) for name in names]
    names = short if len(set(short)) == len(names) else names
    return [name if names.count(name) == 1 else f"{name} ({place})" for place, name in enumerate(names, 1)]


def _with_telemetry(runs: Sequence[Run]) -> list[Run]:
    """The runs that can be shown; adds a note to the others."""
    there = [run for run in runs if words.end_s(run)]
    if not there:
        raise errors.InputError(f"{', '.join(str(run.folder) for run in runs)}: no readable telemetry")
    for run in runs:
        if run not in there:
            run.notes.append("not shown: no readable telemetry")
    return there


def _span(run: Run, options: ReviewOptions) -> tuple[float, float] | None:
    """The requested part of the run, in seconds."""
    if options.start is not None or options.end is not None:
        start_s, end_s = words.part_s(run.origin_utc, options.start, options.end)
        if start_s >= words.end_s(run):
            raise words.not_in(run, f"--from {options.start}")
        if end_s <= 0:
            raise words.not_in(run, f"--to {options.end}")
        return (0.0 if options.start is None else start_s), (words.end_s(run) if options.end is None else end_s)
    if options.at is not None:
        at_s = words.moment_s(options.at, run.origin_utc)
        if not -_AROUND_S <= at_s <= words.end_s(run) + _AROUND_S:
            raise words.not_in(run, f"--at {options.at}")
    elif options.around is not None:
        at_s = _around(run, options.around)
    else:
        return None
    return at_s - _AROUND_S, at_s + _AROUND_S


def _around(run: Run, what: str) -> float:
    """Time of the first event, recorded or detected, whose kind, name, state, text or command contains `what`."""
    wanted = what.lower()
    # `hold` means the state, not the command that led to it
    for keys in (("kind", "name", "state", "text"), ("command",)):
        for each in run.log:
            if any(wanted in str(each.line.get(key, "")).lower() for key in keys):
                return each.mono_s
    from membrane_ctrl.review.events.found import LEVEL_COLUMNS, find_events

    found = find_events(run.level(1.0, names=LEVEL_COLUMNS), run.shapes(), run.config.limits.band_um)
    for item in found:
        if wanted in item.kind:
            return item.time_s
    told = {str(e.get("name") or e.get("state") or e.get("command") or e.get("kind")) for e in run.events}
    named = sorted(told - {"why"} | {item.kind for item in found})
    raise errors.InputError(f"--around {what}: no such event in {run.name}; known: {', '.join(named)}")


def _zeros(runs: Sequence[Run], align: str) -> list[float]:
    """The second of each run at 0 on the timeline."""
    if len(runs) == 1 or align == "start":
        return [0.0] * len(runs)
    if align == "utc":
        return [(runs[0].origin_utc - run.origin_utc).total_seconds() for run in runs]
    return [_hold_s(run) for run in runs]


def _hold_s(run: Run) -> float:
    level = run.level(60.0, names=("state",))
    for each in run.log:
        if isinstance(each.event, events.StateEntered) and each.event.state == "hold":
            return each.mono_s
    held_s = level["time_s"][level["state"] == telemetry.State.HOLD]
    return float(held_s[0]) if held_s.size else 0.0
