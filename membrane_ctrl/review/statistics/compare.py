"""Two runs side by side, with the significance of each difference."""

import math
from dataclasses import dataclass

import numpy as np
from scipy import stats

from membrane_ctrl.control.shape_reference import SHAPES
from membrane_ctrl.model.arrays import Column
from membrane_ctrl.model.telemetry import ShapeState, State
from membrane_ctrl.review.statistics.analysis import Analysis
from membrane_ctrl.review.statistics.difference_tests import mean_p, spread_p, window_means
from membrane_ctrl.review.statistics.drift import FittedSlope
from membrane_ctrl.review.statistics.error_series import ErrorSeries

_SIGNIFICANT = 0.01
_SHORT = "no test: too short"
_STRETCHES = (
    "tests these two stretches of time, not the settings: the weather differs from day to day"
)


@dataclass(frozen=True, slots=True)
class Difference:
    """One quantity of two runs."""

    name: str
    unit: str
    ours: float
    theirs: float
    # Probability of a difference this large between equal runs; NaN without a test
    p_value: float = math.nan
    note: str = ""  # why there is no test, or a caveat of the test; may be empty

    @property
    def verdict_text(self) -> str:
        """The verdict in words."""
        if math.isnan(self.p_value):
            return ""
        if self.p_value >= _SIGNIFICANT:
            return "no significant difference"
        if self.ours > self.theirs:
            return "larger"
        return "smaller"


def compare_analyses(ours: Analysis, theirs: Analysis) -> list[Difference]:
    """Compare two analyses number by number.

    Means are tested between blocks: each run gives one every five minutes, and Welch's t test asks
    whether the two sets differ. Spreads are tested so, too, and as a whole (`spread_p`); slopes by
    their own standard errors.

    Parameters
    ----------
    ours, theirs : Analysis
        Analyses of two runs, or of two parts.

    Returns
    -------
    list of Difference
        Every number that both have, with the probability of its difference by chance.
    """
    # The error by the reading, and by the true centre of a twin. The figures' references differ by
    # chance, and so do the true centres that they hold.
    found: list[Difference] = []
    for name, a, b in (
        ("reading", ours.reading, theirs.reading),
        ("true centre", ours.true, theirs.true),
    ):
        if a is not None and b is not None:
            offset_um = 0.0
            if name == "true centre":
                offset_um = math.hypot(_reference_um(ours), _reference_um(theirs))
            tracks = name == "true centre" and (_is_tracking(ours) or _is_tracking(theirs))
            found += _compare_series(name, a, b, offset_um, tracks)

    # What the feed-forward takes away, the loop, and the figure.
    if ours.benefit is not None and theirs.benefit is not None:
        without = ours.benefit.without_um, theirs.benefit.without_um
        p_value = spread_p(ours.benefit.without_seconds_um, theirs.benefit.without_seconds_um)
        found.append(_make_tested_row("without feed-forward", "µm", *without, p_value))
    found += _compare_loop(ours, theirs)
    if ours.shape is not None and theirs.shape is not None:
        found += _compare_figure(ours, theirs)
    return found


def _compare_series(
    name: str, a: ErrorSeries, b: ErrorSeries, offset_um: float, tracks: bool
) -> list[Difference]:
    # Mean, scatter of single seconds, and drift.
    first = a.windows[0], b.windows[0]
    mean = mean_p(a.seconds_um, b.seconds_um, offset=offset_um)
    found = [
        _make_tested_row(
            f"{name}, mean",
            "µm",
            first[0].mean_um,
            first[1].mean_um,
            mean,
            _of_mean(offset_um, tracks),
        ),
        _make_tested_row(
            f"{name}, std of 1 s",
            "µm",
            first[0].std_um,
            first[1].std_um,
            spread_p(a.seconds_um, b.seconds_um),
        ),
        _make_tested_row(
            f"{name}, drift", "µm/h", a.drift.per_hour, b.drift.per_hour, _slope_p(a.drift, b.drift)
        ),
    ]
    # Scatter of longer windows, from their means.
    for x, y in zip(a.windows[1:], b.windows[1:], strict=True):
        parts = [
            np.stack(window_means(series.seconds_um[0], series.seconds_um[1], x.window_s))
            for series in (a, b)
        ]
        p_value = spread_p(parts[0], parts[1], x.window_s)
        found.append(
            _make_tested_row(f"{name}, std of {x.window_s:g} s", "µm", x.std_um, y.std_um, p_value)
        )
    return found


def _of_mean(offset_um: float, tracks: bool) -> str:
    if offset_um > 0:
        return f"with ±{offset_um:.2g} µm for the references of the shape loops"
    if not tracks:
        return ""
    return f"{_STRETCHES}, and ignores the reference of the shape loop"


def _compare_loop(ours: Analysis, theirs: Analysis) -> list[Difference]:
    ours_ticks = ours.ticks
    theirs_ticks = theirs.ticks
    # Means of the windows in which each run held; lateness is compared by its logarithm, whose
    # distribution is less skewed.
    leak, pump, late = (
        [_select_held(analysis, name) for analysis in (ours, theirs)]
        for name in ("mean_leak_um_per_s", "mean_pump_fraction", "max_lateness_ms")
    )
    window_s = max(ours.level_s, theirs.level_s)
    late = [np.stack((part[0], np.log(np.maximum(part[1], 1e-6)))) for part in late]
    # The maximum of a window grows with its length.
    same = ours.level_s == theirs.level_s
    late_p = mean_p(late[0], late[1], window_s) if same else math.nan
    late_note = f"tested by the maximum of each {window_s:g} s"
    if not same:
        late_note = "no test: levels of different length"
    elif math.isnan(late_p):
        late_note = _SHORT
    return [
        _make_tested_row(
            "leak",
            "µm/s",
            ours.leak_um_per_s[0],
            theirs.leak_um_per_s[0],
            mean_p(leak[0], leak[1], window_s),
            _STRETCHES,
        ),
        _make_tested_row(
            "pump, mean",
            "of full",
            ours_ticks.pump.mean_fraction,
            theirs_ticks.pump.mean_fraction,
            mean_p(pump[0], pump[1], window_s),
            _STRETCHES,
        ),
        Difference(
            "pump strokes",
            "1/h",
            ours_ticks.pump.travel_per_hour,
            theirs_ticks.pump.travel_per_hour,
            math.nan,
            "no test: one sum over the run",
        ),
        Difference(
            "lateness p99",
            "ms",
            ours_ticks.lateness_ms.find_quantile(0.99),
            theirs_ticks.lateness_ms.find_quantile(0.99),
            late_p,
            late_note,
        ),
    ]


def _compare_figure(ours: Analysis, theirs: Analysis) -> list[Difference]:
    assert ours.shape is not None
    assert theirs.shape is not None
    cycle_s = max(float(np.median(np.diff(shape.time_s))) for shape in (ours.shape, theirs.shape))
    points = [
        spread_p(
            np.stack((ours.shape.time_s, height)),
            np.stack((theirs.shape.time_s, theirs.shape.points_um[name])),
            cycle_s,
        )
        for name, height in ours.shape.points_um.items()
    ]
    # the smallest p of three tests, times three (Bonferroni)
    least = float(np.minimum(1.0, len(points) * np.min(points)))
    parting = ours.shape.disagreement, theirs.shape.disagreement
    return [
        _make_tested_row(
            "figure, mean SD",
            "µm",
            ours.shape.mean_sd_um,
            theirs.shape.mean_sd_um,
            least,
            "tested at A, B and C",
        ),
        _make_tested_row(
            "sag − laser", "µm/h", parting[0].per_hour, parting[1].per_hour, _slope_p(*parting)
        ),
    ]


def _make_tested_row(
    name: str, unit: str, ours: float, theirs: float, p_value: float, note: str = ""
) -> Difference:
    """A row with a test; it states if that was not possible."""
    return Difference(name, unit, ours, theirs, p_value, _SHORT if math.isnan(p_value) else note)


def _select_held(analysis: Analysis, name: str) -> Column:
    """(2, n): times and values of the level while held."""
    level = analysis.level
    held = (level["state"] == State.HOLD) & np.isfinite(level[name])
    return np.stack((level["time_s"][held], level[name][held]))


def _is_tracking(analysis: Analysis) -> bool:
    return bool((analysis.level.get("shape_state", np.empty(0)) == ShapeState.TRACKING).any())


def _reference_um(analysis: Analysis) -> float:
    """Standard error (µm) of the shape loop's reference, an offset of the true centre for the whole
    run.

    From the observed scatter of sag minus laser between cycles; 0 if the loop does not track or
    there are too few cycles.
    """
    shape = analysis.shape
    if shape is None or shape.time_s.size < 2 * SHAPES or not _is_tracking(analysis):
        return 0.0
    scatter_um = float(np.std(np.diff(shape.sag_um - shape.laser_um))) / math.sqrt(2)
    return scatter_um / math.sqrt(SHAPES)


def _slope_p(a: FittedSlope, b: FittedSlope) -> float:
    sigmas = [(slope.high - slope.low) / 2 / 1.96 for slope in (a, b)]
    sigma = math.hypot(*sigmas)
    if not math.isfinite(sigma):
        return math.nan
    if sigma == 0.0:
        return float(a.per_hour == b.per_hour)
    return float(2 * stats.norm.sf(abs(a.per_hour - b.per_hour) / sigma))
