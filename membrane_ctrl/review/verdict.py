"""A run in one sentence."""

from __future__ import annotations

from typing import Literal

from membrane_ctrl.review.analysis import Analysis
from membrane_ctrl.review.words import span

Word = Literal["good", "look", "bad"]

# Anomalies that end the claim that the mirror was held.
_GRAVE = {"fault", "band left", "never settled"}
# Single readings that fail to come are any laser's.
_UNREAD_LEAST_S = 1.0
# Every hold begins with some seconds that do not count; more is a setpoint on its way.
_MOVING_LEAST_S = 60.0


def verdict(analysis: Analysis) -> tuple[Word, str]:
    """One word for a colour, and the sentence."""
    run, ticks = analysis.run, analysis.ticks
    series = analysis.true or analysis.reading
    whole = span(ticks.end_s - ticks.start_s)
    names = [anomaly.name for anomaly in analysis.anomalies]
    word: Word = "bad" if _GRAVE & set(names) else "look" if names else "good"
    if series is None or not series.windows[0].count:
        return "bad", f"Not held: no second of {whole} counts as settled{_what(names)}."
    seconds = series.windows[0]
    who = "true centre" if analysis.true else "laser reading"
    std = f"std {seconds.std_um:.3f} µm, " if seconds.count > 1 else ""
    share = 100 * seconds.in_band
    parts = []
    if ticks.unread_s >= _UNREAD_LEAST_S:
        parts.append(f"{span(ticks.unread_s)} of it without a reading")
    if ticks.hold_s - ticks.settled_s >= _MOVING_LEAST_S:
        parts.append(f"{span(ticks.hold_s - ticks.settled_s)} of it not yet settled")
    but = f" ({', '.join(parts)})" if parts else ""
    return word, (
        f"Held for {span(ticks.hold_s)} of {whole}{but}; {share:.6g} % of its seconds within "
        f"±{run.config.limits.band_um:g} µm ({who}: {std}mean {seconds.mean_um:+.3f} µm)"
        f"{_what(names)}."
    )


def _what(names: list[str]) -> str:
    if not names:
        return "; nothing out of the ordinary"
    distinct = list(dict.fromkeys(names))
    return f"; to look at: {', '.join(distinct)}"
