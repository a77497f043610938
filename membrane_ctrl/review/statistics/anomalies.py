"""What is not as it should be, by name and with the figure that says so."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from membrane_ctrl.review.events.steps import FoundEvent
from membrane_ctrl.review.statistics import hold_pass, shape_review
from membrane_ctrl.review.statistics.drift import FittedSlope
from membrane_ctrl.review.statistics.windows import WindowStatistics
from membrane_ctrl.review.words import span
from membrane_ctrl.run_files.run import Run
from membrane_ctrl.run_files.run_folder import event_s

# 95 % in band is what noise alone leaves of single ticks; of seconds a hold keeps all.
_IN_BAND_LEAST = 0.999
_BIAS_MOST_UM = 0.1
_LATE_P99_MOST_MS = 5.0
_REJECTED_MOST = 0.02
_THIN = (
    "without every tick: means are those of the 1 s level; single readings, their histogram, spectrum, Allan "
    "deviation and pump are those of the ticks that are there, and what the feed-forward was worth is not known"
)
# Every hold waits some seconds for its first cycles.
_TRACKING_LEAST = 0.8
_UNTRACKED_MOST_S = 60.0
# Below this a one-sided pump loses the band (PHYSICS: a mirror that is too tight).
_LEAK_LEAST_UM_PER_S = 0.4
# A one-sided pump is at 0 now and then in typical weather (2 % on the twin).
_SATURATED_MOST = 0.05


@dataclass(frozen=True, slots=True)
class Anomaly:
    """One thing: its name, and what was seen."""

    name: str
    seen: str


class _Series(Protocol):
    @property
    def windows(self) -> tuple[WindowStatistics, ...]: ...
    @property
    def drift(self) -> FittedSlope: ...


def anomalies(
    run: Run,
    part_s: tuple[float, float],
    ticks: hold_pass.HoldPass,
    reading: _Series | None,
    true: _Series | None,
    leak_um_per_s: float,
    tracking_share: float,
    found: Sequence[FoundEvent],
    shape: shape_review.ShapeReview | None,
) -> tuple[Anomaly, ...]:
    """All of a part of a run, the gravest first."""
    odd = [Anomaly("incomplete recording", note) for note in run.notes]
    faults = [event for event in run.events_between(*part_s) if event.get("kind") == "fault"]
    names = Counter(str(event.get("name", "?")) for event in faults)
    odd += [Anomaly("fault", f"{name}, {count} time{'s' * (count > 1)}") for name, count in names.most_common()]
    if reading is None:
        odd.append(Anomaly("never settled", "no tick counts as held: there are no hold statistics"))
    series = true or reading
    if series is not None:
        seconds = series.windows[0]
        if seconds.count and not seconds.in_band >= _IN_BAND_LEAST:
            odd.append(Anomaly("band left", f"{100 * seconds.in_band:.3g} % of 1 s means within the band"))
        if seconds.count and abs(seconds.mean_um) > _BIAS_MOST_UM:
            odd.append(Anomaly("bias", f"{seconds.mean_um:+.3f} um on average"))
        if series.drift.significant:
            odd.append(Anomaly("drift", _of(series.drift, "um/h")))
    if pauses := _pauses_s(run, part_s, ticks.end_s):
        asked = f"{len(pauses)} time{'s' * (len(pauses) > 1)}, {span(sum(pauses))} in all"
        odd.append(Anomaly("paused", f"{asked}: the pump gave its mean flow, and nothing held the mirror"))
    if ticks.missed_ticks:
        odd.append(Anomaly("missed ticks", f"{ticks.missed_ticks} of {ticks.ticks + ticks.missed_ticks}"))
    if ticks.thin_s:
        odd.append(Anomaly("thinned ticks", f"{span(ticks.thin_s)} held {_THIN}"))
    if ticks.uncovered_s:
        odd.append(Anomaly("thinned ticks", f"{span(ticks.uncovered_s)} held are in no figure: few ticks, no level"))
    if ticks.lateness_ms.quantile(0.99) > _LATE_P99_MOST_MS:
        odd.append(Anomaly("late ticks", f"p99 is {ticks.lateness_ms.quantile(0.99):.1f} ms"))
    if leak_um_per_s < _LEAK_LEAST_UM_PER_S:
        odd.append(Anomaly("too tight", f"a leak of {leak_um_per_s:.2f} um/s leaves the pump no way to lower"))
    if ticks.pump.saturated_share > _SATURATED_MOST:
        odd.append(Anomaly("saturation", f"{100 * ticks.pump.saturated_share:.1f} % of ticks at a limit of the flow"))
    untracked_s = (1 - tracking_share) * ticks.hold_s
    if run.config.shape.enabled and tracking_share < _TRACKING_LEAST and untracked_s > _UNTRACKED_MOST_S:
        seen = f"tracked {100 * tracking_share:.0f} % of the time held; else the centre follows the laser's mount"
        odd.append(Anomaly("shape loop", seen))
    if shape is not None:
        if shape.rejected > _REJECTED_MOST * shape.cycles:
            odd.append(Anomaly("rejected cycles", f"{shape.rejected} of {shape.cycles}"))
        if shape.disagreement.significant:
            odd.append(Anomaly("camera and laser part", _of(shape.disagreement, "um/h")))
    counts = Counter(event.kind for event in found)
    odd += [Anomaly(kind, f"{count} found") for kind, count in counts.most_common()]
    return tuple(odd)


def _pauses_s(run: Run, part_s: tuple[float, float], end_s: float) -> list[float]:
    """Lengths of the pauses asked for within a part: to `resume`, another state, the longest allowed, or the end."""
    lengths_s: list[float] = []
    since_s = math.nan
    for event in (*run.events, {"kind": "end", "mono_s": end_s}):
        command = event.get("command") if not event.get("refused") else None
        if command == "pause" and math.isnan(since_s):
            since_s = event_s(event)
        elif not math.isnan(since_s) and (command == "resume" or event.get("kind") in {"state", "end"}):
            over_s = min(event_s(event), since_s + run.config.states.pause_max_s, part_s[1])
            lengths_s.append(over_s - max(since_s, part_s[0]))
            since_s = math.nan
    return [length_s for length_s in lengths_s if length_s > 0]


def _of(drift: FittedSlope, unit: str) -> str:
    return f"{drift.per_hour:+.3g} {unit} (95 %: {drift.low:+.3g} to {drift.high:+.3g})"
