"""The pump's activity while the mirror was held: mean, travel, starts, saturation."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import Column
from membrane_ctrl.model.run_status import RunStatus
from membrane_ctrl.run_files import run_statistics
from membrane_ctrl.run_files.run import Run

# A wanted flow that exceeds the pump's range by less than this is a rounding error of single
# precision.
_SATURATED_UM_PER_S = 1e-3


@dataclass(frozen=True, slots=True)
class PumpActivity:
    """Activity of the pump while the mirror was held."""

    mean_fraction: float
    std_fraction: float
    travel_per_hour: float  # sum of its command's changes, a measure of wear
    starts_per_hour: float
    running_share: float
    saturated_share: float  # of ticks that wanted less than zero or more than full flow


class PumpSums:
    """Sums behind `PumpActivity`."""

    def __init__(self, run: Run) -> None:
        self._since_s, self._most_um_per_s = _flow_limits(run)
        self._fraction = run_statistics.Moments()
        self._travel = 0.0
        self._starts = self._running = self._saturated = 0

    def add(self, held: Mapping[str, Column]) -> None:
        """Add the held ticks of the next block: columns (n,) by name, with `mono_s`,
        `pump_fraction` and `flow_wanted_um_per_s`.
        """
        pump = np.nan_to_num(held["pump_fraction"])
        self._fraction.add(pump)
        running = pump > 0
        self._travel += float(np.abs(np.diff(pump)).sum())
        self._starts += int((running[1:] & ~running[:-1]).sum())
        self._running += int(running.sum())
        # Ticks whose wanted flow is beyond the pump's range with the gains of that time
        wanted = held["flow_wanted_um_per_s"]
        gains_number = np.searchsorted(self._since_s, held["mono_s"], "right") - 1
        most = self._most_um_per_s[gains_number] + _SATURATED_UM_PER_S
        is_saturated = (wanted < -_SATURATED_UM_PER_S) | (wanted > most)
        self._saturated += int(is_saturated.sum())

    def result(self, period_s: float) -> PumpActivity:
        """The activity over all ticks added; `period_s` is the time from one tick to the next."""
        count = self._fraction.count
        hours = count * period_s / 3600
        per_hour = 1 / hours if hours else math.nan
        share = 1 / count if count else math.nan
        return PumpActivity(
            mean_fraction=self._fraction.mean if count else math.nan,
            std_fraction=self._fraction.std,
            travel_per_hour=self._travel * per_hour,
            starts_per_hour=self._starts * per_hour,
            running_share=self._running * share,
            saturated_share=self._saturated * share,
        )


def _flow_limits(run: Run) -> tuple[Column, Column]:
    """Times from which a largest flow applied, and those flows: they change with a curve of
    the pump.
    """
    # The configuration at the start, and after each event that changed the loop's settings.
    found = [(-math.inf, run.config)]
    status = RunStatus()
    for each in run.log:
        before = status.loop
        status = status.after_event(each.event, each.mono_s)
        if status.loop is not before:
            found.append((each.mono_s, run.config.with_gains(status.loop)))
    since_s, most = np.array(
        [(at_s, config.loop.flow_most_um_per_s(config.pump)) for at_s, config in found]
    ).T
    return since_s, most
