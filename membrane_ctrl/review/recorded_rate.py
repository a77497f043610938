"""The rate of a run's ticks: what was recorded knows it better than a configuration that lost a line."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from membrane_ctrl.config import Config
from membrane_ctrl.recording.column_tables import TICKS, level_table
from membrane_ctrl.review.column_reader import column_files, first_column

# Ticks jitter, and a minute of them has its late ones; rates in use are farther apart.
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
    for table, name in ((TICKS, "dt_s"), (level_table(1.0), "rows")):
        for path in column_files(folder, table):
            values = first_column(path, name)
            values = values[np.isfinite(values) & (values > 0)]
            if values.size:
                typical = float(np.median(values))
                rate_hz = 1 / typical if name == "dt_s" else typical
                whole_hz = float(round(rate_hz))
                return whole_hz if abs(rate_hz - whole_hz) <= _WHOLE * rate_hz else rate_hz
    return None
