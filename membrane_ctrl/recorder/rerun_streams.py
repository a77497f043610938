"""Telemetry rows to Rerun: one block of columns per stream, lanes where a code changed."""

import math
from collections import deque
from collections.abc import Sequence

import numpy as np
import rerun as rr

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import shape_estimate, telemetry
from membrane_ctrl.model.arrays import AnyArray, FloatArray
from membrane_ctrl.model.columns import COLUMNS, Kind
from membrane_ctrl.model.events import EventLine, PumpLearned
from membrane_ctrl.model.figure_columns import LOW_ORDER_COLUMNS, VIBRATIONS_MOST
from membrane_ctrl.model.prose import for_people
from membrane_ctrl.model.run_events import Vibrations, from_dict
from membrane_ctrl.recorder import blueprint, sink
from membrane_ctrl.run_files import shapes, streams

# Events to Rerun: the text log, and lines across plots.


EVENTS_PATH = "/events"


def send_events(recording: sink.Recording, events: Sequence[EventLine]) -> None:
    """Send events in order: a sentence each, and vertical lines across plots."""
    if not events:
        return
    timed = [(float(line.get("mono_s") or 0.0), from_dict(line)) for line in events]
    time_s = np.array([at_s for at_s, _ in timed])
    # the log's own column of times is too narrow to read
    clock_times = [str(line.get("time_utc", ""))[11:19] for line in events]
    texts = [
        f"{clock} {event.sentence}".strip()
        for clock, (_, event) in zip(clock_times, timed, strict=True)
    ]
    levels = [event.level.value for _, event in timed]
    recording.columns(EVENTS_PATH, time_s, rr.TextLog.columns(text=texts, level=levels))
    for stream, marks_s, values in streams.mark_lines(timed):
        recording.scalars(stream.path, marks_s, values)
    of_pump = [(at_s, event) for at_s, event in timed if isinstance(event, PumpLearned)]
    if of_pump:
        values = np.array([[event.scale, event.correction] for _, event in of_pump])
        squares = np.array([[event.sigma**2, 0.0] for _, event in of_pump])
        recording.measurements(
            streams.PUMP.path, np.array([at_s for at_s, _ in of_pump]), values, squares
        )
    for at_s, event in timed:
        if isinstance(event, Vibrations):
            heard = [math.nan if value is None else value for value in event.frequency_hz]
            padded = [*heard, *VIBRATIONS_MOST * [math.nan]]
            values = np.array([padded[:VIBRATIONS_MOST]])
            recording.scalars(streams.VIBRATIONS.path, np.array([at_s]), values)


# Fewer rows for the viewer while nothing happens; every tick is in the other files
# (docs/reference/recording.md).


# Every tick is recorded around a change of these, and while the error is outside the band.
_CODES = tuple(each.name for each in COLUMNS.values() if each.kind is Kind.CODE)
_AFTER_S = 60.0
_BEFORE_S = 10.0


class QuietFilter:
    """Every tick for a minute after a change and ten seconds before it; otherwise `quiet_hz`.

    An error beyond `band_um` is not quiet.
    """

    def __init__(self, rate_hz: float, quiet_hz: float, band_um: float) -> None:
        self._every = max(1, round(rate_hz / quiet_hz))
        self._band_um = band_um
        self._codes = np.full(len(_CODES), math.nan)
        self._lively_until_s = math.inf
        self._held: list[telemetry.Rows] = []

    def take(self, rows: telemetry.Rows) -> telemetry.Rows:
        """The rows to send now, in order of time; rows held back follow when something happens."""
        if self._every == 1 or not len(rows):
            return rows
        codes = rows[:, [telemetry.COLUMN[name] for name in _CODES]]
        before = np.vstack((self._codes, codes[:-1]))
        lively = (codes != before).any(axis=1) | (
            np.abs(telemetry.column(rows, "error_um")) > self._band_um
        )
        self._codes = codes[-1]
        if lively.any():
            self._lively_until_s = float(telemetry.column(rows, "mono_s")[lively][-1]) + _AFTER_S
            held, self._held = self._held, []
            return np.concatenate((*held, rows))
        now_s = float(rows[-1, telemetry.COLUMN["mono_s"]])
        if now_s < self._lively_until_s:
            return rows
        kept = telemetry.column(rows, "tick") % self._every == 0
        self._held.append(rows[~kept])
        self._held = [
            part
            for part in self._held
            if len(part) and part[-1, telemetry.COLUMN["mono_s"]] > now_s - _BEFORE_S
        ]
        quiet: telemetry.Rows = rows[kept]
        return quiet


# In a file, a chunk costs more than a row.
OVERVIEW_EVERY_S = 5.0


class TelemetryStreams:
    """Sends rows to a recording; remembers the codes of the last row.

    Parameters
    ----------
    recording : Recording
    config : Config
    overview_every_s : float
        Seconds whose means are sent together.
    """

    def __init__(
        self,
        recording: sink.Recording,
        config: Config,
        overview_every_s: float = OVERVIEW_EVERY_S,
    ) -> None:
        self._recording = recording
        self._overview_every_s = overview_every_s
        self._band_um = config.limits.band_um
        self._band = streams.band(self._band_um)
        self._quiet = QuietFilter(config.loop.rate_hz, config.recording.quiet_hz, self._band_um)
        self._codes: dict[str, float] = {}
        self._rest = np.empty((0, len(telemetry.FIELDS)))  # not in the overview yet

    def start_segment(self) -> None:
        """Restart every lane: a new file does not know the last state of the previous one."""
        self._codes.clear()

    def send(self, rows: telemetry.Rows) -> None:
        """Send (n, len(FIELDS)) rows; omit streams without any finite value."""
        if not len(rows):
            return
        self._send_streams(self._quiet.take(rows))
        self._send_overview(rows)
        self._send_lanes(rows)

    def finish(self) -> None:
        """Send what waits for its time."""
        if len(self._rest):
            self._send_overview(self._rest[:0], last=True)

    def _send_overview(self, rows: telemetry.Rows, last: bool = False) -> None:
        """Send a row for each second, some seconds at a time, and the band."""
        waiting_s = telemetry.column(self._rest, "mono_s")
        fresh = telemetry.column(rows, "mono_s") > waiting_s.max(
            initial=-math.inf
        )  # not if sent again after a failure
        self._rest = rows = np.concatenate((self._rest, rows[fresh]))
        time_s = telemetry.column(rows, "mono_s")
        second = np.floor(time_s)
        if second[-1] - second[0] < self._overview_every_s and not last:
            return
        whole = np.split(rows, np.flatnonzero(np.diff(second)) + 1)
        self._rest = rows[:0] if last else whole.pop()
        square = np.full((2, 1), self._band_um**2)
        self._recording.measurements(
            self._band.path, time_s[[0, -1]], np.zeros_like(square), square
        )
        means = np.concatenate([streams.mean_row(part) for part in whole])
        errors_um = np.concatenate([streams.overview_um(part) for part in whole])
        true_um = telemetry.true_error_um(telemetry.columns(means))[:, np.newaxis]
        blocks = [(stream.path, stream.values(means)) for stream in streams.MEANS]
        blocks += [(streams.OVERVIEW.path, errors_um), (streams.TRUE_MEAN.path, true_um)]
        for path, values in blocks:
            there = np.isfinite(values).any(axis=1)
            if there.any():
                self._recording.scalars(
                    path, telemetry.column(means, "mono_s")[there], values[there]
                )

    def _send_streams(self, rows: telemetry.Rows) -> None:
        time_s = telemetry.column(rows, "mono_s")
        blocks = [(stream.path, stream.values(rows)) for stream in streams.STREAMS]
        true_um = telemetry.true_error_um(telemetry.columns(rows))
        blocks.append((streams.TRUE_ERROR.path, true_um[:, np.newaxis]))
        for path, values in blocks:
            if np.isfinite(values).any():
                self._recording.scalars(path, time_s, values)

    def _send_lanes(self, rows: telemetry.Rows) -> None:
        time_s = telemetry.column(rows, "mono_s")
        for lane in blueprint.TELEMETRY_LANES:
            codes = telemetry.column(rows, lane.field)
            found = telemetry.changes(codes, self._codes.get(lane.field, math.nan))
            if found:
                words = [lane.word(code) for _, code in found]
                self._recording.columns(
                    lane.path,
                    time_s[[row for row, _ in found]],
                    rr.StateChange.columns(state=words),
                )
            self._codes[lane.field] = float(codes[-1])


# Three maps of the change a minute are 60 MB a day. Nothing is lost, as any map can be rebuilt from
# the coefficients of its cycle. In the first minutes somebody is watching.
DIFFERENCE_INTERVAL_S = 60.0
DIFFERENCE_EARLY_S, EARLY_S = 10.0, 300.0
MAP_INTERVAL_S = 600.0
# Of the figures of single frames the timeline has one a second; the table has all.
FRAME_INTERVAL_S = 1.0
# The water-fall: a column for each of these, 8 kB.
WATERFALL_COLUMNS = 120
WATERFALL_INTERVAL_S, WATERFALL_EARLY_S = 20.0, 2.0
WATERFALL_LEAST_UM = 0.05
# Colours span nearly all of a map: a few pixels at the edge must not hide the rest.
_NEARLY_ALL = 0.99
# Zernike terms removed from the maps of change (the mount tilts, the loop holds the bowl's depth),
# and the least span of their colours, µm: noise must not look like a figure.
CHANGES = {
    "difference": (0, 0.5),
    "difference_no_tilt": (3, 0.5),
    "difference_no_defocus": (4, 0.1),
}


def colour_span(values: AnyArray, least_um: float | None) -> tuple[float, float]:
    """Range of colours for nearly all of some maps: from 0, or around it if `least_um` is given."""
    most = float(np.nanquantile(np.abs(values), _NEARLY_ALL))
    return (0.0, most) if least_um is None else (-max(least_um, most), max(least_um, most))


def map_picture(values: AnyArray, span: tuple[float, float]) -> rr.DepthImage:
    """A map, in diverging colours for a range around 0. NaN is drawn as the lowest value: a mask
    must cover it.
    """
    return rr.DepthImage(
        values, colormap="CyanToYellow" if span[0] < 0 else "Viridis", depth_range=span
    )


class ShapeStreams:
    """Sends estimates to a recording. Changes are against the first
    good one that `rebase` lets be.
    """

    def __init__(self, recording: sink.Recording) -> None:
        self._recording = recording
        self.reference: shape_estimate.ShapeEstimate | None = None
        self.pictures = True
        self._reference_from_s = -math.inf
        self._next_map_s = -math.inf
        self._next_difference_s = -math.inf
        self._next_frame_s = self._next_fall_s = -math.inf
        self._fall: deque[FloatArray] = deque(maxlen=WATERFALL_COLUMNS)
        self._scatter = shapes.Scatter()
        self._colours: dict[str, str] = {}
        self._verdict = ""

    def start_segment(self) -> None:
        """Repeat in a new file what holds until it changes."""
        self._next_map_s = -math.inf
        self._next_difference_s = -math.inf
        self._verdict = ""

    def rebase(self, from_s: float) -> None:
        """Take the first estimate from a moment on as the reference, and show the maps against it
        at once.
        """
        self._reference_from_s = from_s

    def send(self, estimate: shape_estimate.ShapeEstimate) -> None:
        """Send one estimate at the middle of its exposures; if rejected, only quality and verdict.

        Of single frames of one verdict, one a second is sent.
        """
        if (
            estimate.kind == "track"
            and estimate.verdict == self._verdict
            and estimate.time_s < self._next_frame_s
        ):
            return
        self._next_frame_s = estimate.time_s + FRAME_INTERVAL_S
        time_s = np.array([estimate.time_s])
        for stream, values in _quality(estimate).items():
            self._recording.scalars(stream.path, time_s, np.array([values]))
        if estimate.verdict != self._verdict:
            self._verdict = estimate.verdict
            self._recording.columns(
                blueprint.VERDICT.path, time_s, rr.StateChange.columns(state=[estimate.verdict])
            )
        if estimate.verdict == "rejected":
            return
        if (
            self.reference is None
            or self.reference.time_s < self._reference_from_s <= estimate.time_s
        ):
            self.reference, self._next_difference_s = estimate, -math.inf
            self._next_map_s, self._scatter = -math.inf, shapes.Scatter()
        self._scatter.add(estimate.coeffs_um)
        self._recording.scalars(streams.ZERNIKE.path, time_s, estimate.coeffs_um[np.newaxis])
        for stream, (values, variances) in _changes(estimate, self.reference).items():
            self._recording.measurements(
                stream.path, time_s, np.array([values]), np.array([variances])
            )
        if estimate.kind == "track":
            self._fall.append(
                (estimate.coeffs_um - self.reference.coeffs_um)[shapes.WATERFALL_TERMS]
            )
        if self.pictures:
            self._send_maps(estimate, self.reference)
            self._send_fall(estimate.time_s, estimate.time_s - self.reference.time_s < EARLY_S)

    def _send_fall(self, time_s: float, early: bool) -> None:
        """Send the terms of the last two minutes as a picture: a row for each, the newest on the
        right.
        """
        if not self._fall or time_s < self._next_fall_s:
            return
        self._next_fall_s = time_s + (WATERFALL_EARLY_S if early else WATERFALL_INTERVAL_S)
        terms = np.zeros((self._fall[0].size, WATERFALL_COLUMNS), np.float16)
        terms[:, -len(self._fall) :] = np.array(self._fall).T
        most_um = max(WATERFALL_LEAST_UM, float(np.abs(terms).max()))
        self._recording.log(shapes.WATERFALL_PATH, time_s, map_picture(terms, (-most_um, most_um)))
        self._colours["waterfall"] = f"±{most_um:.3g} µm"

    def _send_maps(
        self, estimate: shape_estimate.ShapeEstimate, reference: shape_estimate.ShapeEstimate
    ) -> None:
        time_s = estimate.time_s
        early = time_s - reference.time_s < EARLY_S
        if time_s >= self._next_map_s:
            self._next_map_s = time_s + (DIFFERENCE_INTERVAL_S if early else MAP_INTERVAL_S)
            self._send_map("height", "mm", time_s, shapes.height_map_mm(estimate))
            self._send_map(
                "uncertainty", "µm", time_s, shapes.uncertainty_map_um(estimate.covariance_um2)
            )
            self._send_map("scatter", "µm", time_s, self._scatter.map_um())
        if time_s >= self._next_difference_s:
            self._next_difference_s = time_s + (
                DIFFERENCE_EARLY_S if early else DIFFERENCE_INTERVAL_S
            )
            difference_um = shapes.difference_map_um(estimate, reference)
            for kind, (terms, least_um) in CHANGES.items():
                self._send_map(
                    kind, "µm", time_s, shapes.without_terms(difference_um, terms), least_um
                )
            terms_um = (estimate.coeffs_um - reference.coeffs_um)[1:]
            self._recording.log(shapes.BARS_PATH, time_s, rr.BarChart.from_fields(values=terms_um))
            self._recording.page(
                "/shape/legend", time_s, _legend(estimate, reference, self._colours)
            )

    def _send_map(
        self, kind: str, unit: str, time_s: float, values: shapes.Map, least_um: float | None = None
    ) -> None:
        """Send a map; with `least_um` in diverging colours, which span at least that, around 0."""
        span = colour_span(values, least_um)
        # millimetres need more than three digits
        picture = map_picture(values if unit == "mm" else values.astype(np.float16), span)
        self._recording.log(f"/shape/map/{kind}", time_s, picture)
        self._colours[kind] = f"{'0 to ' if least_um is None else '±'}{span[1]:.3g} {unit}"


def _legend(
    estimate: shape_estimate.ShapeEstimate,
    reference: shape_estimate.ShapeEstimate,
    colours: dict[str, str],
) -> str:
    """Markdown: the ranges of the maps' colours, and one line per cycle."""
    names = {**shapes.MAPS, "waterfall": "terms over time"}
    rows = "\n".join(
        f"| {name} | {colours[kind]} |" for kind, name in names.items() if kind in colours
    )
    reason = f" ({estimate.reason})" if estimate.reason else ""
    shared_um = estimate.geometry_sag_sigma_um
    shared = f", ± {shared_um:.3g} µm shared by all cycles" if math.isfinite(shared_um) else ""
    return (
        f"| map | colours |\n|---|---|\n{rows}\n\n"
        "Change: cyan below, dark 0, yellow above. Others: violet to yellow. 99 % of a map "
        "is in its range.\n\n"
        f"- cycle {estimate.cycle}, {estimate.kind}: {estimate.verdict}{for_people(reason)}\n"
        f"- changes are against cycle {reference.cycle}, at {reference.time_s:.0f} s\n"
        f"- sag {estimate.sag_um / 1e3:.4f} mm ± {estimate.sag_sigma_um:.3f} µm in a "
        f"change{shared}\n"
        f"- slope residual {estimate.slope_residual_urad:.2f} µrad, "
        f"{100 * estimate.valid_fraction:.1f} % valid\n"
    )


def _quality(estimate: shape_estimate.ShapeEstimate) -> dict[streams.Stream, list[float]]:
    return {
        streams.RESIDUAL: [estimate.slope_residual_urad],
        streams.QUALITY: [estimate.valid_fraction, estimate.saturated_fraction],
        streams.MODULATION: [estimate.modulation_median_adu],
        streams.LATENCY: [estimate.latency_s * 1e3],
    }


def _changes(
    estimate: shape_estimate.ShapeEstimate, reference: shape_estimate.ShapeEstimate
) -> dict[streams.Stream, tuple[list[float], list[float]]]:
    """Values and variances; these are this cycle's own,
    as those of the reference shift all alike.
    """
    change_um, variances_um2 = (
        estimate.coeffs_um - reference.coeffs_um,
        np.diag(estimate.covariance_um2),
    )
    sag_um = [
        estimate.sag_um - reference.sag_um,
        estimate.displacement_um - reference.displacement_um,
    ]
    terms = [j - 1 for j in LOW_ORDER_COLUMNS]
    return {
        streams.CHANGE: (change_um[terms].tolist(), variances_um2[terms].tolist()),
        streams.SAG: (sag_um, [estimate.sag_sigma_um**2, 0.0]),
    }
