"""One pass over every tick of a run, for all parts of the report that need single ticks, in bounded
memory.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model import telemetry
from membrane_ctrl.model.arrays import Column, IntArray, Singles
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.review.statistics import (
    held_time,
    second_sums,
    without_feedforward,
)
from membrane_ctrl.review.statistics.pump_activity import PumpActivity, PumpSums
from membrane_ctrl.run_files import hold_parts, run_statistics
from membrane_ctrl.run_files.run import Run

NAMES = (
    *hold_parts.FIELDS,
    "truth_displacement_um",
    "feedforward_um_per_s",
    "flow_wanted_um_per_s",
    "pump_fraction",
    "lateness_ms",
    "missed_ticks",
)
# Kind of error: a tick without a reading still has a true centre, so each kind has its own sums,
READING, TRUE = range(2)
# and these are their rows.
ERROR, KEPT_AWAY = range(2)
# The histogram extends this many bands to each side, in bins of a fiftieth of a band.
_HISTOGRAM_BANDS = 5
_HISTOGRAM_BINS = 500


@dataclass(frozen=True, slots=True)
class HoldPass:
    """Results from single ticks."""

    ticks: int
    settled: int  # those with a reading
    unread_s: float  # settled time without a reading
    missed_ticks: int  # within the part
    start_s: float
    end_s: float
    hold_s: float  # time in `hold`
    settled_s: float  # the settled hold of `hold_parts.HoldParts`
    faults_s: float
    paused_s: float
    moving_s: float  # the setpoint on its way, or not yet settled
    # (n,) each: setpoint minus laser reading, target minus true centre; on a grid of ticks, NaN
    # where not settled
    reading_um: Singles
    true_um: Singles
    # `SecondSums.result` of the ticks with a reading (`READING`) and of those with a true centre
    # (`TRUE`): rows of sums are the error (`ERROR`) and what the feed-forward kept away
    # (`KEPT_AWAY`: of the true
    # centre, if known)
    seconds: tuple[second_sums.SecondsOf, second_sums.SecondsOf]
    raw_reading: run_statistics.Moments
    raw_true: run_statistics.Moments
    raw_in_band: float  # share of settled readings within the band
    histogram_um: Column  # edges and counts of the reading error
    histogram_counts: IntArray
    lateness_ms: run_statistics.LogHistogram
    pump: PumpActivity


def hold_pass(
    run: Run, span_s: tuple[float, float], part_s: tuple[float, float] = (-np.inf, np.inf)
) -> HoldPass:
    """Pass once through the ticks of a run, or of a part of it.

    Parameters
    ----------
    run : Run
        The run.
    span_s : (float, float)
        First and last second of the run, from a level.
    part_s : (float, float)
        The part, in s.
    """
    collected = _Collector(run, span_s, math.isfinite(part_s[0]))
    for block in run.tick_blocks(NAMES, *part_s):
        collected.add(block)
    return collected.result()


class _Collector:
    def __init__(self, run: Run, span_s: tuple[float, float], from_within: bool) -> None:
        loop = run.config.loop
        self._band_um = run.config.limits.band_um
        self._period_s = 1 / loop.rate_hz
        self._parts = hold_parts.HoldParts(self._band_um)
        self._without = without_feedforward.WithoutFeedforward(
            loop.kp_per_s, loop.ti_s, self._period_s
        )
        self._grid_s = span_s[0]
        size = max(0, math.ceil((span_s[1] - span_s[0]) / self._period_s) + 2)
        self._reading = np.full(size, np.nan, dtype=np.float32)
        self._true = np.full(size, np.nan, dtype=np.float32)
        self._seconds = second_sums.SecondSums(2), second_sums.SecondSums(2)
        self._raw_reading = run_statistics.Moments()
        self._raw_true = run_statistics.Moments()
        reach_um = _HISTOGRAM_BANDS * self._band_um
        self._edges_um = np.linspace(-reach_um, reach_um, _HISTOGRAM_BINS + 1)
        self._histogram = np.zeros(_HISTOGRAM_BINS, dtype=np.int64)
        self._lateness = run_statistics.LogHistogram()
        self._pump = PumpSums(run)
        self._ticks = self._counted = self._unread = self._inside = 0
        self._times = {name: held_time.HeldTime() for name in ("hold", *hold_parts.PARTS)}
        # the running count at the start: for a part that of its first tick, which includes earlier
        # ones
        self._missed_before = math.nan if from_within else 0.0
        self._missed = 0.0
        self._span = (math.nan, math.nan)

    def add(self, block: Mapping[str, Column]) -> None:
        """Add the next block of ticks: columns (n,) by name, as `Run.tick_blocks` reads them."""
        time_s = block["mono_s"]
        parts = self._parts.classify_block(block)
        is_held = parts["held"]
        kept_away = self._without.estimate_kept_away_um(block["feedforward_um_per_s"])[is_held]
        # Counts of all ticks
        if not self._ticks:
            self._span = (float(time_s[0]), math.nan)
        self._span = (self._span[0], float(time_s[-1]))
        self._ticks += time_s.size
        for name, part in {"hold": block["state"] == State.HOLD, **parts}.items():
            self._times[name].add_times(time_s, part)
        self._add_missed(block["missed_ticks"])
        self._lateness.add(block["lateness_ms"])
        # Errors of the ticks in which the mirror was held
        held = {name: np.asarray(block[name][is_held], dtype=np.float64) for name in NAMES}
        self._pump.add(held)
        reading = held["setpoint_um"] - held["displacement_um"]
        true = telemetry.true_error_um(held)
        self._add_to_grid(held["mono_s"], reading, true)
        for sums, error in zip(self._seconds, (reading, true), strict=True):
            known = np.isfinite(error)
            sums.add(held["mono_s"][known], np.stack((error, kept_away))[:, known])
        self._raw_reading.add(reading)
        self._raw_true.add(true)
        known_reading = reading[np.isfinite(reading)]
        self._counted += known_reading.size
        self._unread += true.size - known_reading.size
        self._inside += int((np.abs(known_reading) <= self._band_um).sum())
        self._add_to_histogram(known_reading)

    def _add_missed(self, missed_ticks: Column) -> None:
        """Count the missed ticks, of which each row has the running count."""
        missed = missed_ticks[np.isfinite(missed_ticks)]
        if not missed.size:
            return
        if math.isnan(self._missed_before):
            self._missed_before = float(missed[0])
        self._missed = max(self._missed, float(missed.max()) - self._missed_before)

    def _add_to_grid(self, time_s: Column, reading: Column, true: Column) -> None:
        """Place errors at their ticks, for spectra."""
        place = np.rint((time_s - self._grid_s) / self._period_s).astype(np.int64)
        is_inside = (place >= 0) & (place < self._reading.size)
        self._reading[place[is_inside]] = reading[is_inside]
        self._true[place[is_inside]] = true[is_inside]

    def _add_to_histogram(self, reading: Column) -> None:
        """Count readings by bins; those beyond the ends are in the last bins."""
        low_um = self._edges_um[0]
        high_um = self._edges_um[-1]
        bins = (reading - low_um) * (_HISTOGRAM_BINS / (high_um - low_um))
        bins = np.clip(bins, 0, _HISTOGRAM_BINS - 1).astype(np.int64)
        self._histogram += np.bincount(bins, minlength=_HISTOGRAM_BINS)

    def result(self) -> HoldPass:
        reading, true = (sums.result() for sums in self._seconds)
        times_s = {name: time.result_s(self._period_s) for name, time in self._times.items()}
        if true[0].size:  # the prevented error is needed for only one of the two: 20 MB for a month
            reading = reading[0], reading[1], reading[2][:KEPT_AWAY].copy()
        return HoldPass(
            ticks=self._ticks,
            settled=self._counted,
            unread_s=self._unread * self._period_s,
            missed_ticks=int(self._missed),
            start_s=self._span[0],
            end_s=self._span[1],
            hold_s=times_s["hold"],
            settled_s=times_s["held"],
            faults_s=times_s["faults"],
            paused_s=times_s["paused"],
            moving_s=times_s["moving"],
            reading_um=self._reading,
            true_um=self._true,
            seconds=(reading, true),
            raw_reading=self._raw_reading,
            raw_true=self._raw_true,
            raw_in_band=self._inside / self._counted if self._counted else math.nan,
            histogram_um=self._edges_um,
            histogram_counts=self._histogram,
            lateness_ms=self._lateness,
            pump=self._pump.result(self._period_s),
        )
