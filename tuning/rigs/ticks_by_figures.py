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
        """Time between figures: as asked for, or the median so far if that is longer."""
        return max(
            self._figure_interval_s,
            float(np.median(self._intervals_s)) if self._intervals_s else 0.0,
        )

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
            newest_s = self._shown[-1][0]
            if shape.verdict != "rejected" and shape.kind != "full" and shape.time_s > newest_s:
                self._shown.append((shape.time_s, shape.sag_um - self._zero_um))
                self._intervals_s += [shape.time_s - newest_s] if math.isfinite(newest_s) else []
        done: list[telemetry.TelemetryRow] = []
        while self._waiting and (
            self._waiting[0].mono_s <= self._shown[-1][0]
            or self._waiting[-1].mono_s - self._waiting[0].mono_s > _FIGURE_LATE_S
        ):
            row = self._waiting.popleft()
            done.append(replace(row, displacement_um=self._figure_at(row.mono_s)))
        return done

    def _figure_at(self, time_s: float) -> float:
        while len(self._shown) > 1 and self._shown[1][0] <= time_s:
            self._shown.popleft()
        (before_s, before_um), (after_s, after_um) = (
            self._shown[0],
            self._shown[min(1, len(self._shown) - 1)],
        )
        if not before_s <= time_s <= after_s or after_s - before_s > _FIGURES_APART_S:
            return math.nan
        return before_um + (after_um - before_um) * (time_s - before_s) / max(
            after_s - before_s, 1e-9
        )
