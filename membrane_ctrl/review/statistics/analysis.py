"""All figures of a run's report, computed once; `review/report/json.py` and `html.py` only write
them.
"""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model import errors, telemetry
from membrane_ctrl.model.arrays import Column
from membrane_ctrl.review.events.found import LEVEL_COLUMNS, find_events, list_unjudged
from membrane_ctrl.review.events.found_event import FoundEvent
from membrane_ctrl.review.statistics import climate_review, held_scalars, shape_review
from membrane_ctrl.review.statistics.anomalies import Anomaly, find_anomalies
from membrane_ctrl.review.statistics.error_series import ErrorSeries, describe_error
from membrane_ctrl.review.statistics.hold_pass import (
    ERROR,
    KEPT_AWAY,
    READING,
    TRUE,
    HoldPass,
    hold_pass,
)
from membrane_ctrl.review.statistics.window_means import window_means
from membrane_ctrl.run_files.hold_parts import held_at
from membrane_ctrl.run_files.run import Block, Run

# Pictures use a level with about this many rows.
_PICTURE_ROWS = 9000


@dataclass(frozen=True, slots=True)
class Benefit:
    """Feed-forward: std of the 1 s means as held, and as they would have been without it (µm)."""

    with_um: float
    without_um: float
    without_seconds_um: Column  # (2, n): times and 1 s means without it


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
    unjudged : tuple of str
        Kinds of events that the run is too short to show.
    shape : ShapeReview or None
    scalars : HeldSeries or None
        What was held: vertex, focus and distance from the reference.
    climate : ClimateReview or None
        Temperature and humidity of film and ring; None without a sensor.
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
    unjudged: tuple[str, ...]
    shape: shape_review.ShapeReview | None
    scalars: held_scalars.HeldSeries | None
    climate: climate_review.ClimateReview | None
    anomalies: tuple[Anomaly, ...]

    @property
    def is_part(self) -> bool:
        """Whether only a part of the run was requested."""
        return any(map(math.isfinite, self.part_s))


def analyse_run(run: Run, start_s: float = -math.inf, end_s: float = math.inf) -> Analysis:
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
    # The 1 s level shows events, the figure, and what could not be judged.
    seconds = run.level(1.0, start_s, end_s, LEVEL_COLUMNS)
    if not seconds["time_s"].size:
        known = "".join(f"; {note}" for note in run.notes)
        raise errors.InputError(
            f"{run.folder}: nothing to report: no telemetry in this part of the run{known}"
        )
    span_s = (float(seconds["time_s"][0]), float(seconds["time_s"][-1]) + 1.0)
    found, shape, scalars = _find_events_and_shape(run, seconds, start_s, end_s)
    unjudged = list_unjudged(seconds)
    del seconds  # a month takes a quarter of a GB, and the next steps need more
    # One pass over the ticks; a coarser level for the pictures of a long run.
    ticks = hold_pass(run, span_s, (start_s, end_s))
    level_s = next((w for w in (1.0, 10.0) if (span_s[1] - span_s[0]) / w <= _PICTURE_ROWS), 60.0)
    level = run.level(level_s, start_s, end_s)
    # The figures of the error, and what is unusual in them.
    reading = describe_error(run, ticks, READING)
    true = describe_error(run, ticks, TRUE)
    benefit = _compute_benefit(run, ticks, true is not None)
    leak = _compute_leak(level)
    anomalies = find_anomalies(
        run, (start_s, end_s), ticks, reading, true, leak[0], _tracking_share(level), found, shape
    )
    return Analysis(
        run=run,
        part_s=(start_s, end_s),
        ticks=ticks,
        level=level,
        level_s=level_s,
        reading=reading,
        true=true,
        benefit=benefit,
        leak_um_per_s=leak,
        found=found,
        unjudged=unjudged,
        shape=shape,
        scalars=scalars,
        climate=climate_review.review_climate(run, level),
        anomalies=anomalies,
    )


def _find_events_and_shape(
    run: Run, seconds: Block, start_s: float, end_s: float
) -> tuple[tuple[FoundEvent, ...], shape_review.ShapeReview | None, held_scalars.HeldSeries | None]:
    """Run the analyses that need the cycles, which are released before the ticks are read."""
    shapes = run.shapes()
    shapes = shapes.select_cycles((shapes.time_s >= start_s) & (shapes.time_s < end_s))
    mirror = run.config.optics.mirror
    held = held_at(seconds, shapes.time_s)
    shape = shape_review.review_shapes(shapes, held, mirror.analysis_radius_mm / mirror.radius_mm)
    scalars = held_scalars.review_scalars(shapes, held, run.config)
    return tuple(find_events(seconds, shapes, run.config.limits.band_um)), shape, scalars


def _compute_benefit(run: Run, ticks: HoldPass, true: bool) -> Benefit | None:
    # Sums of each second: the error, and what the feed-forward has kept away from it.
    signal = READING
    if true:
        signal = TRUE
    second, counts, sums = ticks.seconds[signal]
    if not np.isfinite(sums[KEPT_AWAY]).any():
        return None

    # 1 s means of the error as it was, and as it would have been without.
    error = sums[ERROR]
    _, held = window_means(second, counts, error, 1, run.config.loop.rate_hz)
    without = np.stack(
        window_means(second, counts, error + sums[KEPT_AWAY], 1, run.config.loop.rate_hz)
    )
    if not held.size:
        return None
    return Benefit(float(held.std()), float(without[1].std()), without)


def _compute_leak(level: Block) -> tuple[float, float, float]:
    leak = level["mean_leak_um_per_s"][level["state"] == telemetry.State.HOLD]
    leak = leak[np.isfinite(leak)]
    if not leak.size:
        return (math.nan, math.nan, math.nan)
    return float(np.median(leak)), float(leak.min()), float(leak.max())


def _tracking_share(level: Block) -> float:
    """Share of the held time in which the shape loop moved the setpoint."""
    state = level["shape_state"][level["state"] == telemetry.State.HOLD]
    state = state[np.isfinite(state)]
    if not state.size:
        return math.nan
    return float((state == telemetry.ShapeState.TRACKING).mean())
