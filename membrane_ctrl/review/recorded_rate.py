"""The rate of a run's ticks: what was recorded knows it better than a configuration that lost a line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.config import Config
from membrane_ctrl.recording.column_tables import TICKS, level_table
from membrane_ctrl.review.column_reader import column_files, first_column

# Rates in use are farther apart.
_DIFFERS = 0.05
# Nobody sets 9.998 Hz; that is a clock's jitter.
_WHOLE = 0.005


def at_recorded_rate(config: Config, folder: Path, notes: list[str]) -> Config:
    """The configuration with the rate of the run's first minute, if that is another; a note says so."""
    said_hz, found_hz = config.loop.rate_hz, recorded_rate_hz(folder)
    if found_hz is None or abs(found_hz / said_hz - 1) <= _DIFFERS:
        return config
    notes.append(
        f"config.toml: loop.rate_hz is {said_hz:g} Hz (by default, if it is not there), the ticks come at "
        f"{found_hz:.4g} Hz: what was recorded is taken"
    )
    return config.model_copy(update={"loop": config.loop.model_copy(update={"rate_hz": found_hz})})


def recorded_rate_hz(folder: Path) -> float | None:
    """Ticks a second by the tables; None where they do not say."""
    for path in column_files(folder, TICKS):
        spacing_s = _spacing_s(path)
        spacing_s = spacing_s[spacing_s > 0]
        if spacing_s.size:
            return _whole(1 / float(np.median(spacing_s)))
    for path in column_files(folder, level_table(1.0)):
        rows = first_column(path, "rows")
        if rows.size:
            return _whole(float(np.median(rows)))
    return None


def _spacing_s(path: Path) -> NDArray[np.float64]:
    """From when one of a file's first ticks was due to when the next was: `dt_s` is that and the jitter of both."""
    dt_s, late_ms = (first_column(path, name) for name in ("dt_s", "lateness_ms"))
    return dt_s[1:] - 1e-3 * np.diff(np.nan_to_num(late_ms)) if late_ms.size == dt_s.size else dt_s


def _whole(rate_hz: float) -> float:
    whole_hz = float(round(rate_hz))
    return whole_hz if abs(rate_hz - whole_hz) <= _WHOLE * rate_hz else rate_hz
