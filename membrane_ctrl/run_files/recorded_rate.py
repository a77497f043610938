"""The rate of a run's ticks: its record is more reliable than a configuration that lost a line."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.run_files import levels, table_specs
from membrane_ctrl.run_files.table_store.reader import TableReader
from membrane_ctrl.run_files.table_store.spec import TableSpec

# Rates in use differ by more.
_DIFFERS = 0.05
# Nobody sets 9.998 Hz; that is clock jitter.
_WHOLE = 0.005


def at_recorded_rate(config: Config, folder: Path, notes: list[str]) -> Config:
    """The configuration with the rate of the run's first minutes, if that differs.

    Parameters
    ----------
    config : Config
        As read from the run's folder; a damaged one has the default rate.
    folder : Path
        Folder of the run, whose tables state the true rate.
    notes : list of str
        Gets a line if the record's rate is used.
    """
    configured_hz, found_hz = config.loop.rate_hz, recorded_rate_hz(folder)
    if found_hz is None or abs(found_hz / configured_hz - 1) <= _DIFFERS:
        return config
    notes.append(
        f"config.toml: loop.rate_hz is {configured_hz:g} Hz (or missing), but the record has "
        "ticks at "
        f"{found_hz:.4g} Hz, which is used"
    )
    return config.model_copy(update={"loop": config.loop.model_copy(update={"rate_hz": found_hz})})


def recorded_rate_hz(folder: Path) -> float | None:
    """Ticks per second in the tables; None if unknown."""
    spacing_s = _spacing_s(*_first_rows(folder, table_specs.TICKS, ("dt_s", "lateness_ms")))
    spacing_s = spacing_s[spacing_s > 0]
    if spacing_s.size:
        return _require_whole(1 / float(np.median(spacing_s)))
    (rows,) = _first_rows(folder, table_specs.LEVELS[levels.WINDOWS_S[0]], ("rows",))
    if not rows.size:
        return None
    return _require_whole(float(np.median(rows)))


def _first_rows(folder: Path, spec: TableSpec, names: Sequence[str]) -> list[FloatArray]:
    """Columns of the first rows that can be read; empty arrays without any."""
    table = next(TableReader(folder, spec, []).iterate_tables(names), None)
    if table is None or table.column_names != list(names):
        return [np.empty(0) for _ in names]
    return [np.asarray(table.column(name).to_numpy(), dtype=np.float64) for name in names]


def _spacing_s(dt_s: FloatArray, late_ms: FloatArray) -> FloatArray:
    """Time between the deadlines of ticks: `dt_s` is that plus the jitter of both."""
    return dt_s[1:] - 1e-3 * np.diff(np.nan_to_num(late_ms))


def _require_whole(rate_hz: float) -> float:
    whole_hz = float(round(rate_hz))
    if abs(rate_hz - whole_hz) <= _WHOLE * rate_hz:
        return whole_hz
    return rate_hz
