"""Telemetry rows to Rerun: one block of columns per stream, lanes where a code changed."""

import math
from collections.abc import Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import shape_estimate, telemetry
from membrane_ctrl.model.events import EventLine
from membrane_ctrl.recorder import blueprint, sink
from membrane_ctrl.run_files import shapes, streams

# Events to Rerun: one line of the text log each.


EVENTS_PATH = "/events"

_LEVELS = {"fault": "ERROR", "recorder_error": "ERROR", "unreadable_event": "ERROR", "disk_low": "WARN"}
_TIMES = frozenset({"time_utc", "mono_s", "kind"})


def send_events(recording: sink.Recording, events: Sequence[EventLine]) -> None:
    """Send events in order."""
    if not events:
        return
    time_s = np.array([float(event.get("mono_s") or 0.0) for event in events])
    texts = [event_text(event) for event in events]
    levels = [_LEVELS.get(str(event.get("kind")), "INFO") for event in events]
    recording.columns(EVENTS_PATH, time_s, rr.TextLog.columns(text=texts, level=levels))


def event_text(event: EventLine) -> str:
    """One line: the kind, then the event's fields."""
    details = [
        f"{key} {_short(value)}" for key, value in event.items() if key not in _TIMES and value not in (None, "")
    ]
    return f"{event.get('kind', '?')}: {', '.join(details)}" if details else str(event.get("kind", "?"))


def _short(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


# Fewer rows for the viewer while nothing happens; every tick is in the other files (docs/recording.md).


# Every tick is recorded around a change of these, and while the error is outside the band.
_CODES = ("state", "shape_state", "rung", "fault")
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
        lively = (codes != before).any(axis=1) | (np.abs(telemetry.column(rows, "error_um")) > self._band_um)
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
            part for part in self._held if len(part) and part[-1, telemetry.COLUMN["mono_s"]] > now_s - _BEFORE_S
        ]
        quiet: telemetry.Rows = rows[kept]
        return quiet


class TelemetryStreams:
    """Sends rows to a recording; remembers the codes of the last row."""

    def __init__(self, recording: sink.Recording, config: Config) -> None:
        self._recording = recording
        self._band_um = config.limits.band_um
        self._quiet = QuietFilter(config.loop.rate_hz, config.recording.quiet_hz, self._band_um)
        self._codes: dict[str, float] = {}

    def start_segment(self) -> None:
        """Restart every lane: a new file does not know the last state of the previous one."""
        self._codes.clear()

    def send(self, rows: telemetry.Rows) -> None:
        """Send (n, len(FIELDS)) rows; omit streams without any finite value."""
        if not len(rows):
            return
        self._send_streams(self._quiet.take(rows))
        time_s = telemetry.column(rows, "mono_s")
        ends_s = time_s[[0, -1]] if len(rows) > 1 else time_s
        band = np.tile([self._band_um, -self._band_um], (len(ends_s), 1))
        self._recording.scalars(streams.BAND.path, ends_s, band)
        overview = streams.overview_um(rows)
        if np.isfinite(overview).all():
            self._recording.scalars(streams.OVERVIEW.path, time_s[len(rows) // 2 : len(rows) // 2 + 1], overview)
        self._send_lanes(rows)

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
                    lane.path, time_s[[row for row, _ in found]], rr.StateChange.columns(state=words)
                )
            self._codes[lane.field] = float(codes[-1])


# Shape estimates to Rerun: the numbers of every cycle, and maps now and then.


# A map takes 53 kB on disk: one difference a minute is 76 MB a day. Nothing is lost, as any map can be rebuilt from
# the coefficients of its cycle. In the first minutes somebody is watching.
DIFFERENCE_INTERVAL_S = 60.0
DIFFERENCE_EARLY_S, EARLY_S = 10.0, 300.0
MAP_INTERVAL_S = 600.0
# The difference map's colours span at least this, so that noise does not look like a figure.
_DIFFERENCE_LEAST_UM = 0.5


class ShapeStreams:
    """Sends estimates to a recording. Changes are against the first good one that `rebase` lets be."""

    def __init__(self, recording: sink.Recording) -> None:
        self._recording = recording
        self.reference: shape_estimate.ShapeEstimate | None = None
        self.pictures = True
        self._reference_from_s = -math.inf
        self._next_map_s = -math.inf
        self._next_difference_s = -math.inf
        self._colours: dict[str, tuple[float, float]] = {}
        self._verdict = ""

    def start_segment(self) -> None:
        """Repeat in a new file what holds until it changes."""
        self._next_map_s = -math.inf
        self._next_difference_s = -math.inf
        self._verdict = ""

    def rebase(self, from_s: float) -> None:
        """Take the first estimate from a moment on as the reference, and show the maps against it at once."""
        self._reference_from_s = from_s

    def send(self, estimate: shape_estimate.ShapeEstimate) -> None:
        """Send one estimate at the middle of its exposures; if rejected, only quality and verdict."""
        time_s = np.array([estimate.time_s])
        for stream, values in _quality(estimate).items():
            self._recording.scalars(stream.path, time_s, np.array([values]))
        if estimate.verdict != self._verdict:
            self._verdict = estimate.verdict
            self._recording.columns(blueprint.VERDICT.path, time_s, rr.StateChange.columns(state=[estimate.verdict]))
        if estimate.verdict == "rejected":
            return
        if self.reference is None or self.reference.time_s < self._reference_from_s <= estimate.time_s:
            self.reference, self._next_difference_s = estimate, -math.inf
        for stream, values in _figure(estimate, self.reference).items():
            self._recording.scalars(stream.path, time_s, np.array([values]))
        change_um = (estimate.coeffs_um - self.reference.coeffs_um)[1:]
        bars = rr.BarChart(change_um, abscissa=np.arange(2, 37))
        self._recording.log("/shape/change_bars", estimate.time_s, bars)
        if self.pictures:
            self._send_maps(estimate, self.reference)

    def _send_maps(self, estimate: shape_estimate.ShapeEstimate, reference: shape_estimate.ShapeEstimate) -> None:
        time_s = estimate.time_s
        if time_s >= self._next_map_s:
            self._next_map_s = time_s + MAP_INTERVAL_S
            height_mm = shapes.height_map_mm(estimate)
            sigma_um = shapes.uncertainty_map_um(estimate.covariance_um2)
            self._send_map("height", time_s, height_mm, "mm", _span(height_mm))
            self._send_map("uncertainty", time_s, sigma_um, "um, 1 sigma", (0.0, _span(sigma_um)[1]))
        if time_s >= self._next_difference_s:
            early = time_s - reference.time_s < EARLY_S
            self._next_difference_s = time_s + (DIFFERENCE_EARLY_S if early else DIFFERENCE_INTERVAL_S)
            difference_um = shapes.difference_map_um(estimate, reference)
            most_um = max(_DIFFERENCE_LEAST_UM, *(abs(end) for end in _span(difference_um)))
            self._send_map("difference", time_s, difference_um, "um", (-most_um, most_um))
            legend = _legend(estimate, reference, self._colours)
            self._recording.log("/shape/legend", time_s, rr.TextDocument(legend, media_type="text/markdown"))

    def _send_map(
        self, kind: str, time_s: float, values: NDArray[np.float32], unit: str, span: tuple[float, float]
    ) -> None:
        # NaN is drawn like the lowest value: a mask covers it (`outside`, sent once per file)
        picture = rr.DepthImage(values, colormap="turbo", depth_range=span)
        self._recording.log(f"/shape/map/{kind}", time_s, picture)
        self._colours[f"{kind}, {unit}"] = span


def _span(values: NDArray[np.float32]) -> tuple[float, float]:
    return float(np.nanmin(values)), float(np.nanmax(values))


def _legend(
    estimate: shape_estimate.ShapeEstimate,
    reference: shape_estimate.ShapeEstimate,
    colours: dict[str, tuple[float, float]],
) -> str:
    """Markdown: the meaning of the maps' colours, and one line per cycle."""
    rows = "\n".join(f"| {name} | {low:.4g} | {high:.4g} |" for name, (low, high) in colours.items())
    reason = f" ({estimate.reason})" if estimate.reason else ""
    of_geometry = estimate.geometry_sag_sigma_um
    geometry = f", ± {of_geometry:.3g} um from geometry" if math.isfinite(of_geometry) else ""
    return (
        f"| map | blue | red |\n|---|---|---|\n{rows}\n\n"
        f"- cycle {estimate.cycle}, {estimate.kind}: {estimate.verdict}{reason}\n"
        f"- changes are against cycle {reference.cycle}, at {reference.time_s:.0f} s\n"
        f"- sag {estimate.sag_um / 1e3:.4f} mm ± {estimate.sag_sigma_um:.3f} um from noise{geometry}\n"
        f"- slope residual {estimate.slope_residual_urad:.2f} urad, {100 * estimate.valid_fraction:.1f} % valid\n"
    )


def _quality(estimate: shape_estimate.ShapeEstimate) -> dict[streams.Stream, list[float]]:
    return {
        streams.RESIDUAL: [estimate.slope_residual_urad],
        streams.QUALITY: [estimate.valid_fraction, estimate.saturated_fraction],
        streams.MODULATION: [estimate.modulation_median_adu],
        streams.LATENCY: [estimate.latency_s * 1e3],
    }


def _figure(
    estimate: shape_estimate.ShapeEstimate, reference: shape_estimate.ShapeEstimate
) -> dict[streams.Stream, list[float]]:
    change_um = estimate.coeffs_um - reference.coeffs_um
    sag_um, sigma_um = estimate.sag_um - reference.sag_um, estimate.sag_sigma_um
    laser_um = estimate.displacement_um - reference.displacement_um
    return {
        streams.ZERNIKE: list(estimate.coeffs_um),
        streams.CHANGE: [float(change_um[j - 1]) for j in streams.LOW_ORDERS],
        streams.SAG: [sag_um, sag_um + sigma_um, sag_um - sigma_um, laser_um],
    }
