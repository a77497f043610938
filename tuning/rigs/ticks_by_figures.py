"""Displacement from the figures, for the ticks of a hold without a laser."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import shape_estimate, telemetry

_FIGURE_LATE_S = 1.5  # a figure takes 0.1 s; after this long, none shows the tick
_FIGURES_APART_S = 0.4  # further apart, a line between them shows nothing


class TicksByFigures:
    """Gives the ticks of a hold without a laser the displacement that the figures show at their
    time.

    A figure shows the mirror of some time before it arrives: a tick waits for the figures before
    and after it. In the telemetry it has the last figure that had arrived by then.
    """

    def __init__(self, config: Config) -> None:
        self._zero_um = 1e3 * config.optics.mirror.sag_mm
        self._figure_interval_s = 1 / config.shape.track_rate_hz
        self._waiting: deque[telemetry.TelemetryRow] = deque()
        # time, displacement
        self._shown: deque[tuple[float, float]] = deque([(-math.inf, math.nan)])
        self._intervals_s: list[float] = []

    @property
    def interval_s(self) -> float:
        """Time between figures: as configured, or the median so far if that is longer."""
        if not self._intervals_s:
            return self._figure_interval_s
        return max(self._figure_interval_s, float(np.median(self._intervals_s)))

    def add_rows(
        self, rows: Sequence[telemetry.TelemetryRow], shapes: Sequence[shape_estimate.ShapeEstimate]
    ) -> list[telemetry.TelemetryRow]:
        """Add new ticks and figures, and return the ticks that are complete.

        Parameters
        ----------
        rows : sequence of TelemetryRow
            The newest ticks, in order.
        shapes : sequence of ShapeEstimate
            The newest figures, in order.

        Returns
        -------
        list of TelemetryRow
            Of these and earlier ones; the displacement is NaN where no figure shows the mirror.
        """
        self._waiting.extend(rows)
        for shape in shapes:
            self._add_figure(shape)
        # A tick is complete once a figure of a later time is there, or when none can come any more.
        done: list[telemetry.TelemetryRow] = []
        while self._waiting and self._is_complete(self._waiting[0]):
            row = self._waiting.popleft()
            done.append(replace(row, displacement_um=self._figure_at(row.mono_s)))
        return done

    def _add_figure(self, shape: shape_estimate.ShapeEstimate) -> None:
        """Add a figure that may be used and is newer than the last one."""
        newest_s = self._shown[-1][0]
        if shape.verdict == "rejected" or shape.kind == "full" or not shape.time_s > newest_s:
            return
        self._shown.append((shape.time_s, shape.sag_um - self._zero_um))
        if math.isfinite(newest_s):
            self._intervals_s.append(shape.time_s - newest_s)

    def _is_complete(self, row: telemetry.TelemetryRow) -> bool:
        """Whether the displacement of the oldest waiting tick is known, or never will be."""
        has_later_figure = row.mono_s <= self._shown[-1][0]
        is_too_late = self._waiting[-1].mono_s - row.mono_s > _FIGURE_LATE_S
        return has_later_figure or is_too_late

    def _figure_at(self, time_s: float) -> float:
        """Displacement at a time, on the line between the figures before and after it; NaN without
        such figures. Times must not fall from call to call.
        """
        while len(self._shown) > 1 and self._shown[1][0] <= time_s:
            self._shown.popleft()
        before_s, before_um = self._shown[0]
        after_s, after_um = self._shown[min(1, len(self._shown) - 1)]
        if not before_s <= time_s <= after_s or after_s - before_s > _FIGURES_APART_S:
            return math.nan
        share = (time_s - before_s) / max(after_s - before_s, 1e-9)
        return before_um + (after_um - before_um) * share
