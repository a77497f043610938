"""Seconds of which the ticks are not all there (segments while nothing happens): their means are in the 1 s level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.names import State
from membrane_ctrl.review.run import Block, Run
from membrane_ctrl.review.windows import Seconds, SecondsOf, least_ticks

Column = NDArray[np.float64]

LEVEL_COLUMNS = ("state", "mean_displacement_um", "mean_true_error_um")


class ThinSeconds:
    """Finds them, over blocks that come in their order.

    Parameters
    ----------
    rate_hz : float
        Ticks a second of the run.
    """

    def __init__(self, rate_hz: float) -> None:
        self._least = least_ticks(1.0, rate_hz)
        self._parts: list[tuple[Seconds, Column]] = []

    def add(self, time_s: Column, setpoint_um: Column, settled: NDArray[np.bool_]) -> None:
        """Take in (n,) times, setpoints and whether each tick is settled."""
        if not time_s.size:
            return
        second = np.floor(time_s + 1e-9).astype(np.int32)
        starts = _starts(second)
        rows = np.stack((np.ones(time_s.size), settled.astype(np.float64), setpoint_um))
        sums = np.add.reduceat(rows, starts, axis=1)
        # a second that two blocks share is thin in both
        thin = (sums[0] < self._least) & (sums[1] > 0)
        self._parts.append((second[starts][thin], sums[:, thin]))

    def result(self) -> tuple[Seconds, Column]:
        """(k,) seconds whose few ticks are all settled, (k,) their mean setpoint in um."""
        if not self._parts:
            return np.empty(0, dtype=np.int32), np.empty(0)
        second = np.concatenate([part[0] for part in self._parts])
        if not second.size:
            return second, np.empty(0)
        starts = _starts(second)
        ticks, settled, setpoint_um = np.add.reduceat(np.hstack([part[1] for part in self._parts]), starts, axis=1)
        thin = (ticks < self._least) & (settled == ticks)
        return second[starts][thin], setpoint_um[thin] / ticks[thin]


@dataclass(frozen=True, slots=True)
class LevelMeans:
    """Means of (k,) thin seconds by the level: with the ticks they had, errors in um, NaN where there is none."""

    second: Seconds
    ticks: Column
    reading_um: Column
    true_um: Column


def level_means(run: Run, second: Seconds, setpoint_um: Column) -> LevelMeans:
    """What the 1 s level knows of thin seconds, as far as its own are whole."""
    level: Block = run.level(1.0, float(second[0]), float(second[-1]) + 1.0, LEVEL_COLUMNS)
    _, place, row = np.intersect1d(second, np.rint(level["time_s"]).astype(np.int32), return_indices=True)
    whole = (level["rows"][row] >= least_ticks(1.0, run.config.loop.rate_hz)) & (level["state"][row] == State.HOLD)
    place, row = place[whole], row[whole]
    reading_um = setpoint_um[place] - level["mean_displacement_um"][row]
    return LevelMeans(second[place], level["rows"][row], reading_um, level["mean_true_error_um"][row])


def filled(seconds: SecondsOf, means: LevelMeans, error_um: Column) -> SecondsOf:
    """Sums over seconds, with those of the level in the place of the thin ones.

    What the feed-forward kept away (the second row) needs every tick before it: it is nowhere known then.
    """
    there = np.isfinite(error_um)
    second, counts, sums = seconds
    kept = ~np.isin(second, means.second[there])
    ticks = means.ticks[there].astype(np.float32)
    joined = np.concatenate((second[kept], means.second[there]))
    order = np.argsort(joined, kind="stable")
    errors_um = np.concatenate((sums[0][kept], error_um[there] * ticks))[order]
    return joined[order], np.concatenate((counts[kept], ticks))[order], np.stack((errors_um, errors_um * np.nan))


def _starts(second: Seconds) -> NDArray[np.intp]:
    return np.flatnonzero(np.concatenate(([True], second[1:] != second[:-1])))
