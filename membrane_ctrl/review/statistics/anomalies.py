"""Anomalies of a run, by name and with the figure that shows them."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from membrane_ctrl.model import events
from membrane_ctrl.review.events.found_event import FoundEvent
from membrane_ctrl.review.formatting import format_signed, format_span
from membrane_ctrl.review.statistics import shape_review
from membrane_ctrl.review.statistics.drift import FittedSlope
from membrane_ctrl.review.statistics.error_series import ErrorSeries
from membrane_ctrl.review.statistics.hold_pass import HoldPass
from membrane_ctrl.run_files.run import Run

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


@dataclass(frozen=True, slots=True)
class Anomaly:
    """One anomaly: its name and the observation."""

    name: str
    seen: str


def find_anomalies(
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
    """Return all anomalies of a part of a run, the gravest first.

    Parameters
    ----------
    run : Run
    part_s : (float, float)
        Begin and end of the part.
    ticks : HoldPass
        Statistics of one pass over the settled hold.
    reading, true : ErrorSeries or None
        Of the error in the loop, and of the twin's true error; None without such ticks.
    leak_um_per_s : float
        Mean loss of gas, as speed of the centre.
    tracking_share : float
        Share of the hold in which the shape loop tracked.
    found : sequence of FoundEvent
        Steps, glitches and losses that no rule reported.
    shape : ShapeReview or None
        None without enough figures.
    """
    anomalies = [Anomaly("incomplete recording", note) for note in run.notes]
    anomalies += _list_faults(run, part_s)
    # The hold itself: was it reached, and how large is its error?
    if reading is None:
        anomalies.append(
            Anomaly("never settled", "no tick counts as held: there are no hold statistics")
        )
    series = true or reading
    if series is not None:
        anomalies += _judge_error(series)
    anomalies += _judge_ticks(ticks)
    # The pump: can it lower the mirror, and does it stay off its limits?
    if leak_um_per_s < _LEAK_LEAST_UM_PER_S:
        leak = f"a leak of {leak_um_per_s:.2f} µm/s leaves the pump no way to lower"
        anomalies.append(Anomaly("too tight", leak))
    saturated_share = ticks.pump.saturated_share
    if saturated_share > _SATURATED_MOST:
        saturation = f"{100 * saturated_share:.1f} % of ticks at a limit of the flow"
        anomalies.append(Anomaly("saturation", saturation))
    # The shape loop: a short interruption of a long hold does not count
    untracked_s = (1 - tracking_share) * ticks.hold_s
    has_lost_time = tracking_share < _TRACKING_LEAST and untracked_s > _UNTRACKED_MOST_S
    if run.config.shape.enabled and has_lost_time:
        tracked = (
            f"tracked {100 * tracking_share:.0f} % of the time held; else the centre follows the "
            "laser's mount"
        )
        anomalies.append(Anomaly("shape loop", tracked))
    if shape is not None:
        anomalies += _judge_shape(shape)
    # What the review itself has found, by frequency
    counts = Counter(event.kind for event in found)
    anomalies += [Anomaly(kind, f"{count} found") for kind, count in counts.most_common()]
    return tuple(anomalies)


def _list_faults(run: Run, part_s: tuple[float, float]) -> list[Anomaly]:
    """One anomaly for each fault that occurred, the most frequent first."""
    logged = run.log_between(*part_s)
    names = Counter(each.event.name for each in logged if isinstance(each.event, events.Fault))
    return [
        Anomaly("fault", f"{name}, {count} time{'s' if count > 1 else ''}")
        for name, count in names.most_common()
    ]


def _judge_error(series: ErrorSeries) -> list[Anomaly]:
    """Anomalies of the error of the held mirror."""
    anomalies = []
    seconds = series.windows[0]
    if seconds.count and not seconds.in_band >= _IN_BAND_LEAST:
        in_band = f"{100 * seconds.in_band:.3g} % of 1 s means within the band"
        anomalies.append(Anomaly("band left", in_band))
    if seconds.count and abs(seconds.mean_um) > _BIAS_MOST_UM:
        anomalies.append(Anomaly("bias", f"{seconds.mean_um:+.3f} µm on average"))
    if series.drift.is_significant:
        anomalies.append(Anomaly("drift", _describe_slope(series.drift, "µm/h")))
    return anomalies


def _judge_ticks(ticks: HoldPass) -> list[Anomaly]:
    """Pauses, and ticks that were missed or late."""
    anomalies = []
    if ticks.paused_s:
        paused = (
            f"{format_span(ticks.paused_s)}: the pump gave its mean flow, nothing held the mirror"
        )
        anomalies.append(Anomaly("paused", paused))
    if ticks.missed_ticks:
        all_ticks = ticks.ticks + ticks.missed_ticks
        anomalies.append(Anomaly("missed ticks", f"{ticks.missed_ticks} of {all_ticks}"))
    late_ms = ticks.lateness_ms.find_quantile(0.99)
    if late_ms > _LATE_P99_MOST_MS:
        anomalies.append(Anomaly("late ticks", f"p99 is {late_ms:.1f} ms"))
    return anomalies


def _judge_shape(shape: shape_review.ShapeReview) -> list[Anomaly]:
    """Anomalies of the measured figures."""
    anomalies = []
    if shape.rejected > _REJECTED_MOST * shape.cycles:
        anomalies.append(Anomaly("rejected cycles", f"{shape.rejected} of {shape.cycles}"))
    if shape.disagreement.is_significant:
        diverging = _describe_slope(shape.disagreement, "µm/h")
        anomalies.append(Anomaly("camera and laser diverge", diverging))
    return anomalies


def _describe_slope(drift: FittedSlope, unit: str) -> str:
    rate, low, high = map(format_signed, (drift.per_hour, drift.low, drift.high))
    return f"{rate} {unit} (95 %: {low} to {high})"
