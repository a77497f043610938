"""The viewer's input: a separate recording, made from the tables in a second; the run is only read.

It has the overview levels of the whole run; every tick of the requested part, unless that is too
much to draw; the figure with maps; states; events, marks and detected events.
"""

from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import events
from membrane_ctrl.model.arrays import AnyArray, BoolArray, Column
from membrane_ctrl.model.colours import BLUE, GREEN, GREY, ORANGE, RED, VIOLET, Colour
from membrane_ctrl.model.columns import DRAWN, Plot, aggregated_of, plots_of
from membrane_ctrl.model.figure_columns import LOW_ORDER_COLUMNS
from membrane_ctrl.model.prose import for_people
from membrane_ctrl.model.run_status import RunStatus
from membrane_ctrl.model.telemetry import FIELDS, find_changes
from membrane_ctrl.recorder import rerun_shapes
from membrane_ctrl.recorder.state_lanes import TELEMETRY_LANES
from membrane_ctrl.recorder.summary_page import SUMMARY_PATH, summary_page
from membrane_ctrl.review.events.found import LEVEL_COLUMNS, find_events
from membrane_ctrl.review.events.found_event import FoundEvent
from membrane_ctrl.review.report.figures import broken_at_gaps
from membrane_ctrl.review.run_span import end_s
from membrane_ctrl.review.statistics.held_scalars import HeldSeries, review_scalars
from membrane_ctrl.run_files import hold_parts, plot_marks, shapes, streams
from membrane_ctrl.run_files.run import Block, Run
from membrane_ctrl.run_files.stream import Line, Stream, mean_path

APPLICATION = "membrane_review"
# The viewer draws about this many rows of a dozen signals without stutter in software.
RAW_ROWS_MOST = 400_000
LEVEL_ROWS_MOST = 50_000
OVERVIEW_ROWS_MOST = 5_000
SHAPES_MOST = 20_000
MAPS_MOST = 40
SCALARS_MOST = 300  # a millisecond each
THUMBNAILS_MOST = 40  # of each pattern
_RUN_COLOURS: tuple[Colour, ...] = (BLUE, ORANGE, GREEN, VIOLET, RED)
_EXTREMES = {"min": "minimum", "max": "maximum"}
_COLOUR_WORDS = (
    "Change: cyan below, dark 0, yellow above. Others: violet to yellow. 99 % of the maps are in "
    "their range."
)
_SIGNED = {"Pa", "µm", "%"}
_OTHER_FOUND: Colour = (255, 150, 150)  # a lost laser's line must differ from that of its fault
_FOUND_COLOURS = {
    "pressure step": VIOLET,
    "flow step": ORANGE,
    "noise change": ORANGE,
    "shape jump": BLUE,
}
ALL = (-np.inf, np.inf)


def overview_streams(plot: Plot) -> tuple[Stream, ...]:
    """Return the streams of a plot of an overview level; the field of a line is a column of the
    level.

    Each column of the plot that levels keep gives a line of its means; a single one gives minimum
    and maximum, too.
    """
    kept = aggregated_of(plot)
    alone = sum(not each.twin_only for each in kept) == 1
    by_entity: dict[str, list[Line]] = {}
    for each in kept:
        lines = by_entity.setdefault(mean_path(each.entity), [])
        if alone and not each.twin_only:
            for kind, name in _EXTREMES.items():
                label = f"{each.label}, {name} {each.unit}"
                lines.append(Line(f"{kind}_{each.name}", label, GREY, 1.0))
        label = f"{each.label}, mean {each.unit}"
        lines.append(Line(f"mean_{each.name}", label, each.colour, each.width))
    return tuple(Stream(path, tuple(lines)) for path, lines in by_entity.items())


@cache
def _list_overviews() -> tuple[Stream, ...]:
    """Return the streams of a level of all plots."""
    return tuple(stream for plot in plots_of(*DRAWN) for stream in overview_streams(plot))


class Layer:
    """Writes runs into one recording.

    Parameters
    ----------
    path : Path
        The `.rrd` file, replaced if it exists.
    name : str
        Name of the recording, and its id: the viewer keeps one recording of an id.
    overview_only : bool
        Coarse levels without ticks.
    """

    def __init__(self, path: Path, name: str, overview_only: bool = False) -> None:
        self._overview_only = overview_only
        self._stream = rr.RecordingStream(APPLICATION, recording_id=name)
        self._stream.save(path)
        self._stream.send_recording_name(name)
        self._prefix = self._label = ""
        self._number = -1
        self._shift_s = 0.0
        self._origin = np.datetime64(0, "ns")

    def send_blueprint(self, blueprint: rr.blueprint.Blueprint) -> None:
        """The layout in which the file opens."""
        self._stream.send_blueprint(blueprint)

    def close(self) -> None:
        """Write everything to the file."""
        self._stream.flush()
        self._stream.disconnect()

    def add_run(
        self, run: Run, label: str = "", zero_s: float = 0.0, part_s: tuple[float, float] = ALL
    ) -> None:
        """Add a run.

        Parameters
        ----------
        run : Run
            The run.
        label : str
            Name among several runs; empty for a single one.
        zero_s : float
            Second of the run at 0 on the timeline.
        part_s : tuple
            Requested part: shown tick by tick unless too long; logs and maps hold only this part,
            as otherwise a cursor at the end of the recording would show those of the end.
        """
        self._prefix = prefix_of(label)
        self._shift_s = zero_s
        self._label = f"{label}: " if label else ""
        self._number += 1
        self._origin = np.datetime64(run.origin_utc.replace(tzinfo=None), "ns")
        span_s = _end_s(run)
        if self._overview_only:
            rows_most = OVERVIEW_ROWS_MOST
        else:
            rows_most = LEVEL_ROWS_MOST
        level_s = next((w for w in (1.0, 10.0) if span_s / w <= rows_most), 60.0)
        level = run.level(level_s)
        if level_s == 1.0:
            seconds = level
        else:
            seconds = run.level(1.0, names=LEVEL_COLUMNS)
        cycles = run.shapes()
        found = find_events(seconds, cycles, run.config.limits.band_um)
        self._send_page(SUMMARY_PATH, _summary_page(run))
        self._send_overviews(level, run.config.limits.band_um)
        if not self._overview_only:
            self._send_ticks(run, part_s)
        self._send_lanes(level)
        self._send_events(run, found, part_s)
        held = cycles.select_cycles(hold_parts.held_at(level, cycles.time_s))
        self._send_figure(held, part_s, run.config)
        if not self._overview_only:
            self._send_thumbnails(run, part_s)

    def _send_overviews(self, level: Block, band_um: float) -> None:
        for stream in _list_overviews():
            values = np.column_stack([level[line.field] for line in stream.lines])
            if np.isfinite(values).any():
                self._send_style(stream.path, _names_and_colours(stream))
                self._send_scalars(stream.path, level["time_s"], values)
        if level["time_s"].size:
            ends = level["time_s"][[0, -1]]
        else:
            ends = np.empty(0)
        band = streams.make_band(band_um)
        square = np.full((ends.size, 1), band_um**2)
        self._send_measured(
            band.path, [(band.lines[0].name, GREEN)], ends, np.zeros_like(square), square, 0.0
        )

    def _send_ticks(self, run: Run, part_s: tuple[float, float]) -> None:
        rows_expected = run.config.loop.rate_hz * (
            min(part_s[1], _end_s(run)) - max(part_s[0], 0.0)
        )
        if rows_expected > RAW_ROWS_MOST:
            return
        for block in run.tick_blocks(FIELDS, *part_s):
            for stream in streams.STREAMS:
                values = np.column_stack([block[line.field] for line in stream.lines])
                if np.isfinite(values).any():
                    self._send_style(stream.path, _names_and_colours(stream))
                    self._send_scalars(stream.path, block["mono_s"], values)

    def _send_lanes(self, level: Block) -> None:
        for lane in TELEMETRY_LANES:
            path = self._prefix + lane.path
            words = list(lane.colours)
            colours = np.array([lane.colours[word] for word in words], dtype=np.uint32)
            self._stream.log(
                path, rr.StateConfiguration(values=words, labels=words, colors=colours), static=True
            )
            found = find_changes(level[lane.field], np.nan)
            if found:
                times = np.append(
                    level["time_s"][[row for row, _ in found]], level["time_s"][-1] + 1.0
                )
                # the lane ends with the run
                states = pa.array([*(lane.name_code(code) for _, code in found), None])
                self._send_columns(lane.path, times, rr.StateChange.columns(state=states))

    def _send_events(
        self, run: Run, found: Sequence[FoundEvent], part_s: tuple[float, float]
    ) -> None:
        """Send the reported events, the marks in the plots, and the detected events."""
        start_s, end_s = part_s
        # Events that the run reported, but not each change of the reason for the state.
        logged = [
            each
            for each in run.log
            if not isinstance(each.event, events.Why) and start_s <= each.mono_s <= end_s
        ]
        if logged:
            time_s = np.array([each.mono_s for each in logged])
            levels = [each.event.level.value for each in logged]
            texts = [each.event.sentence for each in logged]
            self._send_log(run, "/events", time_s, texts, levels)
        # Vertical lines in the plots at commands, faults and the like.
        timed = [(each.mono_s, each.event) for each in run.log]
        for stream, time_s, values in plot_marks.mark_lines(timed):
            self._send_style(stream.path, _names_and_colours(stream), 2.0, vertical=True)
            self._send_columns(stream.path, time_s, rr.Scalars.columns(scalars=values))
        self._send_pump_scale(run)
        # Events that the review itself has found in the record.
        shown = [each for each in found if start_s <= each.time_s <= end_s]
        if shown:
            time_s = np.array([each.time_s for each in shown])
            texts = [
                f"{each.kind}, {_format_size(each.size, each.unit)} "
                f"(confidence {each.confidence:.3f})"
                for each in shown
            ]
            self._send_log(run, "/found", time_s, texts, ["WARN"] * len(shown))
        self._send_found_lines(found)

    def _send_pump_scale(self, run: Run) -> None:
        """Send what the hold has learned of the pump, with its standard deviation."""
        learned = [each for each in run.log if isinstance(each.event, events.PumpLearned)]
        if not learned:
            return
        time_s = np.array([each.mono_s for each in learned])
        scales = [each.event for each in learned if isinstance(each.event, events.PumpLearned)]
        values = np.array([(each.scale, each.correction) for each in scales])
        variances = np.array([(each.sigma**2, 0.0) for each in scales])
        lines = _names_and_colours(streams.PUMP)
        self._send_measured(streams.PUMP.path, lines, time_s, values, variances)

    def _send_found_lines(self, found: Sequence[FoundEvent]) -> None:
        """Send a vertical line at each detected event; those of a kind have one name and colour."""
        for kind in dict.fromkeys(each.kind for each in found):
            # Its name: how many there are, and the range of their sizes.
            of_kind = sorted((f for f in found if f.kind == kind), key=lambda f: f.size)
            smallest, largest = (_format_size(f.size, f.unit) for f in (of_kind[0], of_kind[-1]))
            sizes = smallest
            if largest != smallest:
                sizes = f"{smallest} to {largest}"
            name = f"{kind}, {sizes}"
            if len(of_kind) > 1:
                name = f"{len(of_kind)} of {kind}, {sizes}"

            # One line series for all of them.
            colour = _FOUND_COLOURS.get(kind, _OTHER_FOUND)
            path = f"/found/lines/{kind.replace(' ', '_')}"
            self._send_style(path, [(name, colour)], 1.0, vertical=True)
            times_s = np.array([f.time_s for f in of_kind])
            time_s, values = plot_marks.make_vertical_lines(times_s)
            self._send_columns(path, time_s, rr.Scalars.columns(scalars=values))

    def _send_log(
        self, run: Run, path: str, time_s: Column, texts: list[str], levels: list[str]
    ) -> None:
        """Log lines that begin with the time of day."""
        lines = [
            f"{self._label}{run.utc(at_s):%H:%M:%S} {text}"
            for at_s, text in zip(time_s.tolist(), texts, strict=True)
        ]
        self._send_columns(path, time_s, rr.TextLog.columns(text=lines, level=levels))

    def _send_figure(
        self, cycles: shapes.Shapes, part_s: tuple[float, float], config: Config
    ) -> None:
        """Changes since the first cycle of the hold."""
        # Only cycles that were not rejected, thinned evenly to what a viewer draws quickly.
        good = cycles.select_cycles(
            (cycles.verdict != "rejected") & np.isfinite(cycles.coeffs_um).all(axis=1)
        )
        if not len(good):
            return
        shown = good.select_cycles(_thin_evenly(len(good), SHAPES_MOST))
        # Low orders since the first of them, µm, with their variances, µm².
        parameters = shown.parameters_um() - shown.parameters_um()[0]
        terms = [j - 1 for j in LOW_ORDER_COLUMNS]
        variances = _coefficient_variances(shown)[:, terms]
        self._send_measured(
            streams.CHANGE.path,
            _names_and_colours(streams.CHANGE),
            shown.time_s,
            parameters[:, terms],
            variances,
        )
        # The sag with its uncertainty, and the laser's displacement beside it, which has none here.
        change = np.column_stack(
            (shown.sag_um - shown.sag_um[0], shown.displacement_um - shown.displacement_um[0])
        )
        variances = np.nan_to_num(
            np.column_stack((shown.sag_change_sigma_um**2, np.zeros(len(shown))))
        )
        sag = streams.SAG
        self._send_measured(sag.path, _names_and_colours(sag), shown.time_s, change, variances)
        self._send_scalars_of(shown, config)
        residual_urad = shown.slope_residual_urad[:, np.newaxis]
        self._send_style(streams.RESIDUAL.path, _names_and_colours(streams.RESIDUAL))
        self._send_scalars(streams.RESIDUAL.path, shown.time_s, residual_urad)
        # Maps are large, so only those of the part are sent.
        seen = (shown.time_s >= part_s[0]) & (shown.time_s <= part_s[1])
        seen |= ~seen.any()  # nothing measured there: show all rather than no map
        self._send_maps(shown.time_s[seen], parameters[seen])

    def _send_scalars_of(self, shown: shapes.Shapes, config: Config) -> None:
        """Focus and RMS of some cycles, against the first one."""
        thinned = shown.select_cycles(_thin_evenly(len(shown), SCALARS_MOST))
        series = review_scalars(thinned, np.ones(len(thinned), dtype=bool), config)
        if series is None:
            return
        for stream, names in (
            (streams.FOCUS, ("focus_mm",)),
            (streams.FIGURE_RMS, ("rms_um", "least_rms_um")),
        ):
            values = np.column_stack([series.values_of(name) for name in names])
            sigmas = np.column_stack([_find_sigmas(series, name) for name in names])
            self._send_measured(
                stream.path, _names_and_colours(stream), series.time_s, values, sigmas**2
            )

    def _send_maps(self, time_s: Column, parameters: Column) -> None:
        """Maps of change, each kind on one scale for playback, and of the standard deviation over
        the part.
        """
        context = rr.AnnotationContext([(0, "", (0, 0, 0, 0)), (1, "", (24, 24, 24, 255))])
        self._stream.log(self._prefix + "/shape", context, static=True)
        # The standard deviation over the part
        colours = {}
        if time_s.size > 1:
            deviation = shapes.deviation_map_um(parameters)
            span = rerun_shapes.colour_span(deviation, None)
            self._send_map("scatter", deviation, span)
            colours["scatter"] = f"0 to {span[1]:.2g} µm"
        # Changes at some moments, each kind without its low terms and on one scale
        wanted = np.flatnonzero(_thin_evenly(time_s.size, MAPS_MOST))
        whole = [shapes.change_map_um(parameters[row]) for row in wanted]
        for kind, (terms, least_um) in rerun_shapes.CHANGES.items():
            changes = [shapes.without_terms(change, terms) for change in whole]
            span = rerun_shapes.colour_span(np.stack(changes), least_um)
            colours[kind] = f"±{span[1]:.2g} µm"
            for row, change in zip(wanted, changes, strict=True):
                self._send_map(kind, change, span, float(time_s[row]))
        rows = "".join(
            f"| {shapes.MAPS[kind].replace(' so far', '')} | {words} |\n"
            for kind, words in colours.items()
        )
        self._send_page("/shape/legend", f"| map | colours |\n|---|---|\n{rows}\n{_COLOUR_WORDS}")

    def _send_thumbnails(self, run: Run, part_s: tuple[float, float]) -> None:
        """Pictures of camera frames, each from its moment on."""
        for each in run.thumbnails(THUMBNAILS_MOST, *part_s):
            self._set_time(each["time_s"])
            picture = rr.EncodedImage(contents=each["jpeg"], media_type="image/jpeg")
            name = rr.escape_entity_path_part(each["pattern"])
            self._stream.log(f"{self._prefix}/frames/{name}", picture)

    def _set_time(self, at_s: float) -> None:
        """Set the moment of the run for what is logged next."""
        since = _to_nanoseconds(np.array([at_s - self._shift_s, at_s]))
        self._stream.set_time("run_time", duration=since[0])
        self._stream.set_time("utc", timestamp=self._origin + since[1])

    def _send_map(
        self, kind: str, values: shapes.Map, span: tuple[float, float], at_s: float | None = None
    ) -> None:
        """Log a map at a second of the run, or for all of it."""
        path = f"{self._prefix}/shape/map/{kind}"
        picture = np.nan_to_num(values).astype(np.float16)
        outside = rr.SegmentationImage(shapes.outside_disc(), opacity=1.0, draw_order=1.0)
        self._stream.log(f"{path}/outside", outside, static=True)
        if at_s is not None:
            self._set_time(at_s)
        self._stream.log(path, rerun_shapes.map_picture(picture, span), static=at_s is None)

    def _send_page(self, path: str, text: str) -> None:
        self._stream.log(
            self._prefix + path, rr.TextDocument(text, media_type="text/markdown"), static=True
        )

    def _send_names(self, lines: Iterable[tuple[str, Colour]], width: float) -> dict[str, Any]:
        """Names, colours and widths of the lines of an entity; those of overlaid runs distinguish
        the runs apart.
        """
        names, colours = zip(*lines, strict=True)
        if self._prefix:
            colours = tuple(_of_run(colour, self._number) for colour in colours)
        return {
            "names": [self._label + name for name in names],
            "colors": list(colours),
            "widths": [width] * len(names),
        }

    def _send_style(
        self,
        path: str,
        lines: Iterable[tuple[str, Colour]],
        width: float = 1.5,
        vertical: bool = False,
    ) -> None:
        # the average of the lines in a pixel would be none
        style = rr.SeriesLines(
            **self._send_names(lines, width), aggregation_policy="Off" if vertical else None
        )
        self._stream.log(self._prefix + path, style, static=True)

    def _send_measured(
        self,
        path: str,
        lines: Iterable[tuple[str, Colour]],
        time_s: Column,
        values: Column,
        variances: Column,
        width: float = 1.5,
    ) -> None:
        """Log values with a shaded area of one standard deviation."""
        style = rr.Measurements.from_fields(**self._send_names(lines, width))
        self._stream.log(self._prefix + path, style, static=True)
        drawn = broken_at_gaps({"time_s": time_s, "values": values, "variances": variances})
        columns = rr.Measurements.columns(values=drawn["values"], variances=drawn["variances"])
        self._send_columns(path, drawn["time_s"], columns)

    def _send_scalars(self, path: str, time_s: Column, values: Column) -> None:
        if time_s.size:
            drawn = broken_at_gaps({"time_s": time_s, "values": values})
            self._send_columns(path, drawn["time_s"], rr.Scalars.columns(scalars=drawn["values"]))

    def _send_columns(
        self, path: str, time_s: Column, columns: Iterable[rr.ComponentColumn]
    ) -> None:
        indexes = [
            rr.TimeColumn("run_time", duration=_to_nanoseconds(time_s - self._shift_s)),
            rr.TimeColumn("utc", timestamp=self._origin + _to_nanoseconds(time_s)),
        ]
        self._stream.send_columns(self._prefix + path, indexes=indexes, columns=columns)


def _names_and_colours(stream: Stream) -> list[tuple[str, Colour]]:
    return [(line.name, line.colour) for line in stream.lines]


def prefix_of(label: str) -> str:
    """Before the paths of a run among several."""
    if not label:
        return ""
    return f"/{rr.escape_entity_path_part(label)}"


def _summary_page(run: Run) -> str:
    """The page of figures as the recorder wrote it last, from `summary.json`: what `runs` and
    `report` state.
    """
    status = RunStatus()
    for each in run.log:
        status = status.after_event(each.event, each.mono_s)
    try:
        page = summary_page(run.summary or {}, status, run.config)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError):
        page = "`summary.json` is missing or damaged.\n"
    name = for_people(run.name)
    return f"**{name}**\n\n{page}\nIntervals and spectra: `membrane-ctrl report {name}`\n"


def _format_size(size: float, unit: str) -> str:
    return for_people(f"{size:+.3g} {unit}" if unit in _SIGNED else f"{size:.3g} {unit}")


def _coefficient_variances(cycles: shapes.Shapes) -> Column:
    """(n, terms) variances of the coefficients, of the covariance recorded last before each cycle;
    0 without any.
    """
    if not cycles.covariance_time_s.size:
        return np.zeros_like(cycles.coeffs_um)
    place = np.searchsorted(cycles.covariance_time_s, cycles.time_s, side="right") - 1
    return np.diagonal(cycles.covariance_um2, axis1=1, axis2=2)[np.maximum(place, 0)]


def _find_sigmas(series: HeldSeries, name: str) -> Column:
    """Standard deviations of a scalar; 0 where none is known."""
    sigma_names = {"focus_mm": "focus_sigma_mm", "rms_um": "rms_sigma_um"}
    if name not in sigma_names:
        return np.zeros(len(series.time_s))
    return np.nan_to_num(series.values_of(sigma_names[name]))


def _of_run(colour: Colour, number: int) -> Colour:
    """Colours of overlaid runs; a signal that is grey in a single run gets the dark shade."""
    red, green, blue = _RUN_COLOURS[number % len(_RUN_COLOURS)]
    if colour == GREY:
        return (red // 2, green // 2, blue // 2)
    return (red, green, blue)


def _to_nanoseconds(time_s: Column) -> AnyArray:
    return np.round(np.asarray(time_s, dtype=np.float64) * 1e9).astype("timedelta64[ns]")


def _end_s(run: Run) -> float:
    """End of the run, from its summary or, for a killed run, its levels."""
    duration = (run.summary or {}).get("duration_s")
    if isinstance(duration, (int, float)):
        return float(duration)
    return end_s(run)


def _thin_evenly(count: int, most: int) -> BoolArray:
    """(count,) True at no more than `most` evenly spaced places, including the first."""
    chosen = np.zeros(count, dtype=bool)
    chosen[:: max(1, -(-count // most))] = True
    return chosen
