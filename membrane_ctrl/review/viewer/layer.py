"""The viewer's input: a separate recording, made from the tables in a second; the run is only read.

It has the overview levels of the whole run; every tick of the requested part, unless that is too much to draw; the
figure with maps; states; events, marks and detected events.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import rerun as rr

from membrane_ctrl.model.arrays import AnyArray, BoolArray, Column
from membrane_ctrl.model.event_words import level, sentence
from membrane_ctrl.model.events import Why
from membrane_ctrl.model.telemetry import FIELDS, changes
from membrane_ctrl.recorder.blueprint import TELEMETRY_LANES
from membrane_ctrl.review.events.found import LEVEL_COLUMNS, find_events
from membrane_ctrl.review.events.steps import FoundEvent
from membrane_ctrl.review.report.figures import broken_at_gaps
from membrane_ctrl.review.words import end_s
from membrane_ctrl.run_files import streams, summary
from membrane_ctrl.run_files.run import Block, Run
from membrane_ctrl.run_files.shapes import Shapes, height_basis

APPLICATION = "membrane_review"
# The viewer draws about this many rows of a dozen signals without stutter in software.
RAW_ROWS_MOST = 400_000
LEVEL_ROWS_MOST = 50_000
OVERVIEW_ROWS_MOST = 5_000
SHAPES_MOST = 20_000
MAPS_MOST = 40
_MAP_PX = 96
_RUN_COLOURS: tuple[streams.Colour, ...] = (streams.BLUE, streams.ORANGE, streams.GREEN, streams.VIOLET, streams.RED)


# Plots of a level: signals (column, name, colour) by path.
OVERVIEWS: dict[str, tuple[tuple[str, str, streams.Colour], ...]] = {
    "/overview/error": (
        ("min_error_um", "error, minimum um", streams.GREY),
        ("mean_error_um", "error, mean um", streams.BLUE),
        ("max_error_um", "error, maximum um", streams.GREY),
    ),
    "/overview/true": (("mean_true_error_um", "true error, mean um", streams.GREEN),),
    "/overview/flow": (
        ("mean_flow_um_per_s", "flow um/s", streams.BLUE),
        ("mean_leak_um_per_s", "leak um/s", streams.RED),
    ),
    "/overview/pump": (("mean_pump_fraction", "pump", streams.BLUE),),
    "/overview/trim": (("mean_trim_um", "trim um", streams.VIOLET),),
    "/overview/ambient": (("mean_ambient_pressure_pa", "air pressure Pa", streams.BLUE),),
    "/overview/gauge": (("mean_gauge_pressure_pa", "gauge pressure Pa", streams.BLUE),),
    "/overview/temperature": (("mean_air_temperature_c", "air C", streams.ORANGE),),
    "/overview/lateness": (
        ("mean_lateness_ms", "lateness, mean ms", streams.BLUE),
        ("max_lateness_ms", "lateness, maximum ms", streams.GREY),
    ),
    "/overview/missed": (("max_missed_ticks", "ticks missed so far", streams.RED),),
}


ALL = (-np.inf, np.inf)


class Layer:
    """Writes runs into one recording, the `.rrd` file `path`; with `overview_only` coarse levels without ticks."""

    def __init__(self, path: Path, name: str, overview_only: bool = False) -> None:
        self._overview_only = overview_only
        self._stream = rr.RecordingStream(APPLICATION, recording_id=name)
        self._stream.save(path)
        self._stream.send_recording_name(name)
        self._prefix = self._label = ""
        self._number = -1
        self._shift_s = 0.0
        self._origin = np.datetime64(0, "ns")

    def blueprint(self, blueprint: rr.blueprint.Blueprint) -> None:
        """The layout in which the file opens."""
        self._stream.send_blueprint(blueprint)

    def close(self) -> None:
        """Write everything to the file."""
        self._stream.flush()
        self._stream.disconnect()

    def add(self, run: Run, prefix: str = "", zero_s: float = 0.0, part_s: tuple[float, float] = ALL) -> float:
        """Add a run; returns the scale of its maps: their largest change of height, um; NaN without maps.

        Parameters
        ----------
        prefix : str
            Before its paths; empty for a single run.
        zero_s : float
            Second of the run at 0 on the timeline.
        part_s : tuple
            Requested part: shown tick by tick unless too long; logs and maps hold only this part, as otherwise a
            cursor at the end of the recording would show those of the end.
        """
        self._prefix, self._shift_s = prefix, zero_s
        self._label = f"{prefix.strip('/')} " if prefix else ""
        self._number += 1
        self._origin = np.datetime64(run.origin_utc.replace(tzinfo=None), "ns")
        span_s = _end_s(run)
        rows_most = OVERVIEW_ROWS_MOST if self._overview_only else LEVEL_ROWS_MOST
        level_s = next((w for w in (1.0, 10.0) if span_s / w <= rows_most), 60.0)
        level = run.level(level_s)
        seconds = level if level_s == 1.0 else run.level(1.0, names=LEVEL_COLUMNS)
        shapes = run.shapes()
        found = find_events(seconds, shapes, run.config.limits.band_um)
        self._overviews(level, run.config.limits.band_um)
        if not self._overview_only:
            self._ticks(run, part_s)
        self._lanes(level)
        self._events(run, found, part_s)
        return self._figure(shapes.select(summary.held_at(level, shapes.time_s)), part_s)

    def _overviews(self, level: Block, band_um: float) -> None:
        for path, lines in OVERVIEWS.items():
            values = np.column_stack([level[name] for name, _, _ in lines])
            if np.isfinite(values).any():
                self._style(path, [(name, colour) for _, name, colour in lines])
                self._scalars(path, level["time_s"], values)
        ends = level["time_s"][[0, -1]] if level["time_s"].size else np.empty(0)
        self._style("/loop/band", [("+band um", streams.GREY), ("-band um", streams.GREY)])
        self._scalars("/loop/band", ends, np.tile([band_um, -band_um], (ends.size, 1)))

    def _ticks(self, run: Run, part_s: tuple[float, float]) -> None:
        rows_expected = run.config.loop.rate_hz * (min(part_s[1], _end_s(run)) - max(part_s[0], 0.0))
        if rows_expected > RAW_ROWS_MOST:
            return
        for block in run.tick_blocks(FIELDS, *part_s):
            for stream in streams.STREAMS:
                values = np.column_stack([block[line.field] for line in stream.lines])
                if np.isfinite(values).any():
                    self._style(stream.path, [(line.name, line.colour) for line in stream.lines])
                    self._scalars(stream.path, block["mono_s"], values)

    def _lanes(self, level: Block) -> None:
        for lane in TELEMETRY_LANES:
            path = self._prefix + lane.path
            words = list(lane.colours)
            colours = np.array([lane.colours[word] for word in words], dtype=np.uint32)
            self._stream.log(path, rr.StateConfiguration(values=words, labels=words, colors=colours), static=True)
            found = changes(level[lane.field], np.nan)
            if found:
                times = level["time_s"][[row for row, _ in found]]
                states = [lane.word(code) for _, code in found]
                self._columns(lane.path, times, rr.StateChange.columns(state=states))

    def _events(self, run: Run, found: Sequence[FoundEvent], part_s: tuple[float, float]) -> None:
        told = [e for e in run.log if not isinstance(e.event, Why) and part_s[0] <= e.mono_s <= part_s[1]]
        if told:
            times = np.array([each.mono_s for each in told])
            self._log(run, "/events", times, [sentence(e.line) for e in told], [level(e.line) for e in told])
        seen = [f for f in found if part_s[0] <= f.time_s <= part_s[1]]
        if seen:
            texts = [f"{f.kind}: {f.size:.3g} {f.unit} (confidence {f.confidence:.3f})" for f in seen]
            self._log(run, "/found", np.array([f.time_s for f in seen]), texts, ["WARN"] * len(seen))
        if found:
            times = np.array([f.time_s for f in found])
            self._style("/found/marks", [("detected", streams.RED)], points=True)
            self._scalars("/found/marks", times, np.zeros((len(found), 1)))

    def _log(self, run: Run, path: str, time_s: Column, texts: list[str], levels: list[str]) -> None:
        """Log lines that begin with the time of day."""
        lines = [
            f"{self._label}{run.utc(at_s):%H:%M:%S} {text}" for at_s, text in zip(time_s.tolist(), texts, strict=True)
        ]
        self._columns(path, time_s, rr.TextLog.columns(text=lines, level=levels))

    def _figure(self, shapes: Shapes, part_s: tuple[float, float]) -> float:
        good = shapes.select((shapes.verdict != "rejected") & np.isfinite(shapes.coeffs_um).all(axis=1))
        if not len(good):
            return float("nan")
        shown = good.select(_some(len(good), SHAPES_MOST))
        parameters = shown.parameters_um() - shown.parameters_um()[0]
        terms = list(streams.LOW_ORDERS)
        self._style("/shape/change", [streams.LOW_ORDERS[j] for j in terms])
        self._scalars("/shape/change", shown.time_s, parameters[:, [j - 1 for j in terms]])
        self._style("/shape/sag_change", [("sag by the camera um", streams.BLUE), ("laser um", streams.ORANGE)])
        change = np.column_stack((shown.sag_um - shown.sag_um[0], shown.displacement_um - shown.displacement_um[0]))
        self._scalars("/shape/sag_change", shown.time_s, change)
        self._style("/shape/residual", [("slope residual urad", streams.BLUE)])
        self._scalars("/shape/residual", shown.time_s, shown.slope_residual_urad[:, np.newaxis])
        seen = (shown.time_s >= part_s[0]) & (shown.time_s <= part_s[1])
        seen |= ~seen.any()  # nothing measured there: show all rather than no map
        return self._maps(shown.time_s[seen], parameters[seen])

    def _maps(self, time_s: Column, parameters: Column) -> float:
        """Height changes since the first cycle of the hold, on a common scale for playback."""
        axis = (np.arange(_MAP_PX) + 0.5) * 2 / _MAP_PX - 1
        x, y = np.meshgrid(axis, -axis)
        inside = np.hypot(x, y) <= 1.0
        wanted = np.flatnonzero(_some(time_s.size, MAPS_MOST))
        heights = parameters[wanted] @ height_basis(x[inside], y[inside])
        most = max(0.5, float(np.abs(heights).max()))
        context = rr.AnnotationContext([(0, "", (0, 0, 0, 0)), (1, "", (24, 24, 24, 255))])
        self._stream.log(self._prefix + "/shape", context, static=True)
        outside = rr.SegmentationImage((~inside).astype(np.uint8), opacity=1.0, draw_order=1.0)
        self._stream.log(self._prefix + "/shape/map/outside", outside, static=True)
        for row, height in zip(wanted, heights, strict=True):
            picture = np.zeros((_MAP_PX, _MAP_PX), dtype=np.float32)
            picture[inside] = height
            image = rr.DepthImage(picture, colormap="turbo", depth_range=(-most, most))
            at_s = np.array([time_s[row]])
            self._stream.set_time("run_time", duration=_nanoseconds(at_s - self._shift_s)[0])
            self._stream.set_time("utc", timestamp=self._origin + _nanoseconds(at_s)[0])
            self._stream.log(self._prefix + "/shape/map", image)
        return most

    def _style(self, path: str, lines: Iterable[tuple[str, streams.Colour]], points: bool = False) -> None:
        names, colours = zip(*lines, strict=True)
        style = rr.SeriesPoints if points else rr.SeriesLines
        if self._prefix:
            colours = tuple(_of_run(colour, self._number) for colour in colours)
        archetype = style(names=[self._label + name for name in names], colors=list(colours))
        self._stream.log(self._prefix + path, archetype, static=True)

    def _scalars(self, path: str, time_s: Column, values: Column) -> None:
        if time_s.size:
            drawn = broken_at_gaps({"time_s": time_s, "values": values})
            self._columns(path, drawn["time_s"], rr.Scalars.columns(scalars=drawn["values"]))

    def _columns(self, path: str, time_s: Column, columns: Iterable[rr.ComponentColumn]) -> None:
        indexes = [
            rr.TimeColumn("run_time", duration=_nanoseconds(time_s - self._shift_s)),
            rr.TimeColumn("utc", timestamp=self._origin + _nanoseconds(time_s)),
        ]
        self._stream.send_columns(self._prefix + path, indexes=indexes, columns=columns)


def _of_run(colour: streams.Colour, number: int) -> streams.Colour:
    """Colours of overlaid runs; a signal that is grey in a single run gets the dark shade."""
    red, green, blue = _RUN_COLOURS[number % len(_RUN_COLOURS)]
    return (red // 2, green // 2, blue // 2) if colour == streams.GREY else (red, green, blue)


def _nanoseconds(time_s: Column) -> AnyArray:
    return np.round(np.asarray(time_s, dtype=np.float64) * 1e9).astype("timedelta64[ns]")


def _end_s(run: Run) -> float:
    """End of the run, from its summary or, for a killed run, its levels."""
    duration = (run.summary or {}).get("duration_s")
    return float(duration) if isinstance(duration, (int, float)) else end_s(run)


def _some(count: int, most: int) -> BoolArray:
    """(count,) True at no more than `most` evenly spaced places, including the first."""
    chosen = np.zeros(count, dtype=bool)
    chosen[:: max(1, -(-count // most))] = True
    return chosen
