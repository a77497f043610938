"""The report for programs: plain data, units in the names."""

import math
from dataclasses import asdict
from typing import Any, Literal

import numpy as np

from membrane_ctrl.model import events, program
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.review.formatting import format_span, format_time_beside
from membrane_ctrl.review.statistics import (
    climate_review,
    drift,
    held_scalars,
    power_spectrum,
    shape_review,
)
from membrane_ctrl.review.statistics.analysis import Analysis
from membrane_ctrl.review.statistics.error_series import ErrorSeries
from membrane_ctrl.run_files.event_log import LoggedEvent, parse_logged_line
from membrane_ctrl.run_files.held_error import HeldError

Word = Literal["good", "look", "bad"]

# Anomalies that contradict the claim that the mirror was held.
_GRAVE = {"fault", "band left", "never settled"}
# Any laser misses single readings.
_UNREAD_LEAST_S = 1.0
SCHEMA = "membrane-report/1"


def make_verdict(analysis: Analysis) -> tuple[Word, str]:
    """A word that selects the colour, and the verdict as a sentence."""
    run = analysis.run
    ticks = analysis.ticks
    # The simulated bench records the true error; a real one has the readings.
    series = analysis.true or analysis.reading
    whole = format_span(ticks.end_s - ticks.start_s)
    names = [anomaly.name for anomaly in analysis.anomalies]
    word: Word = "good"
    if names:
        word = "look"
    if _GRAVE & set(names):
        word = "bad"
    if series is None or not series.windows[0].count:
        return "bad", f"Not held: no second of {whole} counts as settled{_join_names(names)}."
    seconds = series.windows[0]
    held = HeldError(
        "true" if analysis.true else "reading",
        seconds.count,
        seconds.mean_um,
        seconds.std_um,
        seconds.in_band,
    )
    # What there was besides the hold.
    parts = []
    if ticks.unread_s >= _UNREAD_LEAST_S:
        parts.append(f"{format_span(ticks.unread_s)} of it without a reading")
    parts += format_time_beside(
        ticks.faults_s, ticks.paused_s, ticks.moving_s, ticks.end_s - ticks.start_s
    )
    but = f" ({', '.join(parts)})" if parts else ""
    return word, (
        f"Held for {format_span(ticks.settled_s)} of {whole}{but}; "
        f"{held.in_band_text} of its seconds within ±{run.config.limits.band_um:g} µm "
        f"({held.name}: {held.figures_text})"
        f"{_join_names(names)}."
    )


def _join_names(names: list[str]) -> str:
    if not names:
        return "; nothing unusual"
    return f"; check: {', '.join(dict.fromkeys(names))}"


def report_table(analysis: Analysis) -> dict[str, Any]:
    """All figures of the report (`membrane-report/1`); NaN where there is none."""
    run = analysis.run
    ticks = analysis.ticks
    word, sentence = make_verdict(analysis)
    late = ticks.lateness_ms
    feedforward = None
    if analysis.benefit is not None:
        feedforward = {
            "std_1s_with_um": analysis.benefit.with_um,
            "std_1s_without_um": analysis.benefit.without_um,
        }
    return {
        **program.file_origin(SCHEMA),
        "run": run.name,
        "recorded_by": run.recorded_by,
        "started_utc": run.origin_utc.isoformat(),
        "verdict": word,
        "sentence": sentence,
        "part_s": {"start": ticks.start_s, "end": ticks.end_s},
        "duration_s": ticks.end_s - ticks.start_s,
        "hold_s": ticks.hold_s,
        "settled_s": ticks.settled_s,
        "faults_s": ticks.faults_s,
        "paused_s": ticks.paused_s,
        "moving_s": ticks.moving_s,
        "held_without_reading_s": ticks.unread_s,
        "ticks": ticks.ticks,
        "ticks_settled": ticks.settled,
        "ticks_missed": ticks.missed_ticks,
        "band_um": run.config.limits.band_um,
        "in_band_single_ticks": ticks.raw_in_band,
        "std_single_ticks_um": ticks.raw_reading.std,
        "reading": _make_series(analysis.reading),
        "true": _make_series(analysis.true),
        "histogram": {
            "edges_um": list(ticks.histogram_um),
            "counts": [int(n) for n in ticks.histogram_counts],
        },
        "pump": asdict(ticks.pump),
        "leak_um_per_s": dict(zip(("median", "min", "max"), analysis.leak_um_per_s, strict=True)),
        "feedforward": feedforward,
        "lateness_ms": {
            "p50": late.find_quantile(0.5),
            "p99": late.find_quantile(0.99),
            "max": late.largest,
        },
        "timeline": [each.line for each in make_timeline(analysis)],
        "found": [asdict(event) for event in analysis.found],
        "unjudged": list(analysis.unjudged),
        "shape": None if analysis.shape is None else _make_shape(analysis.shape),
        "held": None if analysis.scalars is None else _make_scalars(analysis.scalars),
        "climate": None if analysis.climate is None else _make_climate(analysis.climate),
        "anomalies": [asdict(anomaly) for anomaly in analysis.anomalies],
        "notes": list(run.notes),
        "exit": None if not run.summary else run.summary.get("exit"),
    }


def make_timeline(analysis: Analysis) -> list[LoggedEvent]:
    """Notable events, in order; without events, states from the telemetry."""
    notable = [each for each in analysis.run.log if each.event.notable]
    if not any(isinstance(each.event, events.StateEntered) for each in notable):
        # A line where the state differs from that of the window before.
        time_s = analysis.level["time_s"]
        codes = analysis.level["state"]
        lines = (
            {
                "mono_s": float(time_s[row]),
                "kind": "state",
                "state": State(int(codes[row])).name.lower(),
            }
            for row in range(codes.size)
            if math.isfinite(codes[row]) and (row == 0 or codes[row] != codes[row - 1])
        )
        notable = sorted([*notable, *map(parse_logged_line, lines)], key=lambda each: each.mono_s)
    return [each for each in notable if analysis.part_s[0] <= each.mono_s < analysis.part_s[1]]


def _make_series(series: ErrorSeries | None) -> dict[str, Any] | None:
    if series is None:
        return None
    return {
        "windows": [asdict(window) for window in series.windows],
        "drift_um_per_hour": _make_slope(series.drift),
        "allan": {
            "tau_s": list(series.allan.tau_s),
            "deviation_um": list(series.allan.deviation),
            "windows": [int(n) for n in series.allan.windows],
        },
        "bands_rms_um": [
            asdict(band) for band in power_spectrum.band_rms(series.spectrum, series.slow)
        ],
        "spectrum_segments": series.spectrum.segments,
        "slow_spectrum_segments": series.slow.segments,
    }


def _make_slope(slope: drift.FittedSlope) -> dict[str, float | bool]:
    return asdict(slope) | {"significant": slope.is_significant}


def _make_climate(climate: climate_review.ClimateReview) -> dict[str, Any]:
    """Ranges of temperature and humidity, and what they predict at the end of the run."""
    ranges = {}
    for name, values in (
        ("film_c", climate.film_c),
        ("ring_c", climate.ring_c),
        ("humidity_percent", climate.humidity_percent),
    ):
        known = values[np.isfinite(values)]
        ranges[name] = [float(known.min()), float(known.max())] if known.size else None
    figures_um = climate.figure_um[np.isfinite(climate.figure_um)]
    return {
        **ranges,
        "film_ppm": climate.film_ppm,
        "ring_ppm": climate.ring_ppm,
        "figure_um": float(figures_um[-1]) if figures_um.size else None,
        "figure_sigma_um": climate.last_sigma_um,
        "figure_max_um": float(figures_um.max()) if figures_um.size else None,
        "spherical_um": climate.spherical_um,
    }


def _make_scalars(series: held_scalars.HeldSeries) -> dict[str, Any]:
    """What was held: the scalars of the last figure, and the image of a star."""
    focus_mm = series.values_of("focus_mm")
    image = None
    if series.image is not None:
        image = {
            "focus_mm": series.image.focus_mm,
            "path_rms_um": series.image.path_rms_um,
            "resolved": series.image.resolved,
            "strehl": series.image.strehl,
            "strehl_sigma": series.strehl_sigma,
            "radius_50_um": series.image.radius_50_um,
            "radius_80_um": series.image.radius_80_um,
            "radius_80_sigma_um": series.radius_80_sigma_um,
        }
    return {
        "holds": series.holds,
        "stored_reference": series.stored_reference,
        "last": asdict(series.scalars[-1]),
        "focus_change_um": 1e3 * float(focus_mm[-1] - focus_mm[0]),
        "focus_span_um": 1e3 * float(np.ptp(focus_mm)),
        "wavelength_um": series.wavelength_um,
        "star_image": image,
        "strehl_of_change": series.change_strehl,
    }


def _make_shape(shape: shape_review.ShapeReview) -> dict[str, Any]:
    return {
        "cycles": shape.cycles,
        "rejected": shape.rejected,
        "used": int(shape.time_s.size),
        "reference_s": float(shape.time_s[0]),
        "mean_sd_um": shape.mean_sd_um,
        "points_sd_um": {name: float(values.std()) for name, values in shape.points_um.items()},
        "drift_um_per_hour": {
            f"Z{j}": _make_slope(term) for j, term in enumerate(shape.drift_um_per_hour, 2)
        },
        "sag_minus_laser_um_per_hour": _make_slope(shape.disagreement),
        "sag_std_um": float(shape.sag_um.std()),
        "laser_std_um": float(shape.laser_um.std()),
        "pairs": [
            {
                name: getattr(pair, name)
                for name in ("first_s", "lag_s", "rms_um", "mean_sigma_um", "pairs")
            }
            | {"all_pairs_rms_um": pair.all_rms_um}
            for pair in shape.pairs
        ],
    }
