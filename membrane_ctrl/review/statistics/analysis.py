"""All figures of a run's report, computed once; `review/report/json.py` and `html.py` only write
them.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft

from membrane_ctrl.model import errors, events, telemetry
from membrane_ctrl.model.arrays import Column, Singles
from membrane_ctrl.review.catalogue import span
from membrane_ctrl.review.events.found import LEVEL_COLUMNS, find_events
from membrane_ctrl.review.events.steps import FoundEvent
from membrane_ctrl.review.statistics import shape_review, spectra
from membrane_ctrl.review.statistics.drift import FittedSlope, slope
from membrane_ctrl.review.statistics.hold_pass import (
    ERROR,
    KEPT_AWAY,
    READING,
    TRUE,
    HoldPass,
    hold_pass,
)
from membrane_ctrl.review.statistics.spectra import WindowStatistics, describe, window_means
from membrane_ctrl.run_files.hold_parts import held_at
from membrane_ctrl.run_files.run import Block, Run

WINDOWS_S = (1, 4, 60)
# Pictures use a level with about this many rows.
_PICTURE_ROWS = 9000
# The slope is fitted to minutes or, in a short run, to seconds.
_SLOPE_MINUTES_FROM_S = 3600.0
# A straight line bridges a missed tick or a glitch; otherwise no segment of a spectrum would be
# complete.
FILLED_S = 0.5
# Of the 1 s means, whose spectrum is used below 0.1 Hz: gaps left by a laser without light for a
# moment.
_FILLED_SECONDS = 5
# A day has slower and larger motions than any hold; longer means add nothing to the slope.
_ALLAN_LONGEST_S = 1e5


@dataclass(frozen=True, slots=True)
class ErrorSeries:
    """Statistics of one error: `reading` (in the loop) or `true` (the twin's centre)."""

    windows: tuple[WindowStatistics, ...]  # at `WINDOWS_S`
    seconds_um: Column  # (2, n): times and means of the 1 s windows
    allan: spectra.Allan
    spectrum: spectra.Spectrum  # of the ticks
    # Of the 1 s means, in segments of half the hold: for motion slower than the segments of
    # `spectrum`
    slow: spectra.Spectrum
    drift: FittedSlope  # µm per hour


@dataclass(frozen=True, slots=True)
class Benefit:
    """Feed-forward: std of the 1 s means as held, and as they would have been without it (µm)."""

    with_um: float
    without_um: float
    without_seconds_um: Column  # (2, n): times and 1 s means without it


@dataclass(frozen=True, slots=True)
class Anomaly:
    """One anomaly: its name and the observation."""

    name: str
    seen: str


@dataclass(frozen=True, slots=True)
class Analysis:
    """Results of the analysis of a run.

    Attributes
    ----------
    run : Run
    part_s : tuple
        Requested part of the run.
    ticks : HoldPass
    level : dict
        Overview for the pictures; its windows are `level_s` long.
    level_s : float
    reading, true : ErrorSeries or None
        None if nothing is settled (or, for `true`, on a real bench).
    benefit : Benefit or None
    leak_um_per_s : tuple
        Median, minimum and maximum of the leak estimate's minutes while held.
    found : tuple of FoundEvent
    shape : ShapeReview or None
    anomalies : tuple of Anomaly
    """

    run: Run
    part_s: tuple[float, float]
    ticks: HoldPass
    level: Block
    level_s: float
    reading: ErrorSeries | None
    true: ErrorSeries | None
    benefit: Benefit | None
    leak_um_per_s: tuple[float, float, float]
    found: tuple[FoundEvent, ...]
    shape: shape_review.ShapeReview | None
    anomalies: tuple[Anomaly, ...]

    @property
    def is_part(self) -> bool:
        """Whether only a part of the run was requested."""
        return any(map(math.isfinite, self.part_s))


def analyse(run: Run, start_s: float = -math.inf, end_s: float = math.inf) -> Analysis:
    """Analyse a run or a part of it.

    Parameters
    ----------
    run : Run
    start_s, end_s : float
        Seconds of the run.

    Raises
    ------
    InputError
        If the part has no ticks.
    """
    seconds = run.level(1.0, start_s, end_s, LEVEL_COLUMNS)
    if not seconds["time_s"].size:
        known = "".join(f"; {note}" for note in run.notes)
        raise errors.InputError(
            f"{run.folder}: nothing to report: no telemetry in this part of the run{known}"
        )
    span_s = (float(seconds["time_s"][0]), float(seconds["time_s"][-1]) + 1.0)
    found, shape = _found_and_shape(run, seconds, start_s, end_s)
    del seconds  # a month takes a quarter of a GB, and the next steps need more
    ticks = hold_pass(run, span_s, (start_s, end_s))
    level_s = next((w for w in (1.0, 10.0) if (span_s[1] - span_s[0]) / w <= _PICTURE_ROWS), 60.0)
    level = run.level(level_s, start_s, end_s)
    reading = _series(run, ticks, READING)
    true = _series(run, ticks, TRUE)
    benefit = _benefit(run, ticks, true is not None)
    leak = _leak(level)
    odd = _anomalies(
        run, (start_s, end_s), ticks, reading, true, leak[0], _tracking(level), found, shape
    )
    return Analysis(
        run,
        (start_s, end_s),
        ticks,
        level,
        level_s,
        reading,
        true,
        benefit,
        leak,
        found,
        shape,
        odd,
    )


def _found_and_shape(
    run: Run, seconds: Block, start_s: float, end_s: float
) -> tuple[tuple[FoundEvent, ...], shape_review.ShapeReview | None]:
    """Run the analyses that need the cycles, which are released before the ticks are read."""
    shapes = run.shapes()
    shapes = shapes.select((shapes.time_s >= start_s) & (shapes.time_s < end_s))
    mirror = run.config.optics.mirror
    held = held_at(seconds, shapes.time_s)
    shape = shape_review.review_shapes(shapes, held, mirror.analysis_radius_mm / mirror.radius_mm)
    return tuple(find_events(seconds, shapes, run.config.limits.band_um)), shape


def _series(run: Run, ticks: HoldPass, which: int) -> ErrorSeries | None:
    rate_hz, band_um = run.config.loop.rate_hz, run.config.limits.band_um
    second, counts, sums = ticks.seconds[which]
    moments = ticks.raw_reading if which == READING else ticks.raw_true
    if not moments.count:
        return None
    means = {w: window_means(second, counts, sums[ERROR], w, rate_hz) for w in WINDOWS_S}
    grid = ticks.reading_um if which == READING else ticks.true_um
    grid = fill_short_gaps(
        grid[_first(grid) : grid.size - _first(grid[::-1])], round(FILLED_S * rate_hz)
    )
    longest = max(1, min(grid.size // 4, round(_ALLAN_LONGEST_S * rate_hz)))
    lengths = 2 ** np.arange(int(np.log2(longest)) + 1)
    minutes = ticks.hold_s >= _SLOPE_MINUTES_FROM_S
    return ErrorSeries(
        windows=tuple(describe(means[w][1], w, band_um) for w in WINDOWS_S),
        seconds_um=np.stack(means[1]),
        allan=spectra.allan_deviation(grid, 1 / rate_hz, lengths),
        spectrum=spectra.power_spectrum(grid, rate_hz),
        slow=slow_spectrum(*means[1]),
        drift=slope(*means[60 if minutes else 1]),
    )


def slow_spectrum(time_s: Column, means: Column) -> spectra.Spectrum:
    """Spectrum of 1 s means in segments half as long as the longest gapless stretch: three in a
    whole hold.

    `time_s` (n,) are the middles of the seconds; gaps up to 5 s are bridged.
    """
    if not time_s.size:
        return spectra.power_spectrum(np.empty(0), 1.0)
    place = np.floor(time_s - time_s[0] + 0.5).astype(np.int64)
    grid = np.full(int(place[-1]) + 1, np.nan, dtype=np.float32)
    grid[place] = means
    grid = fill_short_gaps(grid, _FILLED_SECONDS)
    gaps = np.flatnonzero(~np.isfinite(np.concatenate(([np.nan], grid, [np.nan]))))
    longest = int(np.diff(gaps).max()) - 1
    return spectra.power_spectrum(grid, 1.0, fft.prev_fast_len(max(8, longest // 2), real=True))


def fill_short_gaps(values: Singles, most: int) -> Singles:
    """Gaps of at most `most` values filled with straight lines; longer ones stay NaN."""
    gap = ~np.isfinite(values)
    edges = np.flatnonzero(np.diff(np.concatenate(([False], gap, [False])).astype(np.int8)))
    filled = values.copy()
    for start, end in edges.reshape(-1, 2):
        if end - start <= most and start > 0 and end < values.size:
            filled[start:end] = np.linspace(values[start - 1], values[end], end - start + 2)[1:-1]
    return filled


def _first(grid: Singles) -> int:
    """Places before the first value."""
    return int(np.argmax(np.isfinite(grid)))


def _benefit(run: Run, ticks: HoldPass, true: bool) -> Benefit | None:
    second, counts, sums = ticks.seconds[TRUE if true else READING]
    if not np.isfinite(sums[KEPT_AWAY]).any():
        return None
    error = sums[ERROR]
    _, held = window_means(second, counts, error, 1, run.config.loop.rate_hz)
    without = np.stack(
        window_means(second, counts, error + sums[KEPT_AWAY], 1, run.config.loop.rate_hz)
    )
    return Benefit(float(held.std()), float(without[1].std()), without) if held.size else None


def _leak(level: Block) -> tuple[float, float, float]:
    leak = level["mean_leak_um_per_s"][level["state"] == telemetry.State.HOLD]
    leak = leak[np.isfinite(leak)]
    if not leak.size:
        return (math.nan, math.nan, math.nan)
    return float(np.median(leak)), float(leak.min()), float(leak.max())


def _tracking(level: Block) -> float:
    """Share of the held time in which the shape loop moved the setpoint."""
    state = level["shape_state"][level["state"] == telemetry.State.HOLD]
    state = state[np.isfinite(state)]
    return float((state == telemetry.ShapeState.TRACKING).mean()) if state.size else math.nan


# Anomalies, by name and with the figure that shows them.

# Noise alone leaves 95 % of single ticks in the band; a hold keeps all of its seconds there.
_IN_BAND_LEAST = 0.999
_BIAS_MOST_UM = 0.1
_LATE_P99_MOST_MS = 5.0
_REJECTED_MOST = 0.02
# Every hold waits a few seconds for its first cycles.
_TRACKING_LEAST = 0.8
_UNTRACKED_MOST_S = 60.0
# Below this a one-sided pump loses the band (docs/explanation/physics.md).
_LEAK_LEAST_UM_PER_S = 0.4
# A one-sided pump is at 0 now and then in typical weather (2 % on the twin).
_SATURATED_MOST = 0.05


def _anomalies(
    run: Run,
    part_s: tuple[float, float],
    ticks: HoldPass,
    reading: ErrorSeries | None,
    true: ErrorSeries | None,
    leak_um_per_s: float,
    tracking_share: float,
    found: Sequence[FoundEvent],
    shape: shape_review.ShapeReview | None,
) -> tuple[Anomaly, ...]:
    """All anomalies of a part of a run, the gravest first."""
    odd = [Anomaly("incomplete recording", note) for note in run.notes]
    names = Counter(
        each.event.name for each in run.log_between(*part_s) if isinstance(each.event, events.Fault)
    )
    odd += [
        Anomaly("fault", f"{name}, {count} time{'s' * (count > 1)}")
        for name, count in names.most_common()
    ]
    if reading is None:
        odd.append(Anomaly("never settled", "no tick counts as held: there are no hold statistics"))
    series = true or reading
    if series is not None:
        seconds = series.windows[0]
        if seconds.count and not seconds.in_band >= _IN_BAND_LEAST:
            odd.append(
                Anomaly("band left", f"{100 * seconds.in_band:.3g} % of 1 s means within the band")
            )
        if seconds.count and abs(seconds.mean_um) > _BIAS_MOST_UM:
            odd.append(Anomaly("bias", f"{seconds.mean_um:+.3f} µm on average"))
        if series.drift.significant:
            odd.append(Anomaly("drift", _of(series.drift, "µm/h")))
    if ticks.paused_s:
        odd.append(
            Anomaly(
                "paused",
                f"{span(ticks.paused_s)}: the pump gave its mean flow, nothing held the mirror",
            )
        )
    if ticks.missed_ticks:
        odd.append(
            Anomaly("missed ticks", f"{ticks.missed_ticks} of {ticks.ticks + ticks.missed_ticks}")
        )
    if ticks.lateness_ms.quantile(0.99) > _LATE_P99_MOST_MS:
        odd.append(Anomaly("late ticks", f"p99 is {ticks.lateness_ms.quantile(0.99):.1f} ms"))
    if leak_um_per_s < _LEAK_LEAST_UM_PER_S:
        odd.append(
            Anomaly(
                "too tight", f"a leak of {leak_um_per_s:.2f} µm/s leaves the pump no way to lower"
            )
        )
    if ticks.pump.saturated_share > _SATURATED_MOST:
        odd.append(
            Anomaly(
                "saturation",
                f"{100 * ticks.pump.saturated_share:.1f} % of ticks at a limit of the flow",
            )
        )
    untracked_s = (1 - tracking_share) * ticks.hold_s
    if (
        run.config.shape.enabled
        and tracking_share < _TRACKING_LEAST
        and untracked_s > _UNTRACKED_MOST_S
    ):
        seen = (
            f"tracked {100 * tracking_share:.0f} % of the time held; else the centre follows the "
            "laser's mount"
        )
        odd.append(Anomaly("shape loop", seen))
    if shape is not None:
        if shape.rejected > _REJECTED_MOST * shape.cycles:
            odd.append(Anomaly("rejected cycles", f"{shape.rejected} of {shape.cycles}"))
        if shape.disagreement.significant:
            odd.append(Anomaly("camera and laser diverge", _of(shape.disagreement, "µm/h")))
    counts = Counter(event.kind for event in found)
    odd += [Anomaly(kind, f"{count} found") for kind, count in counts.most_common()]
    return tuple(odd)


def _of(drift: FittedSlope, unit: str) -> str:
    return f"{drift.per_hour:+.3g} {unit} (95 %: {drift.low:+.3g} to {drift.high:+.3g})"
