"""Tables for people: times in UTC, names for codes, nulls for absent values."""

from collections.abc import Mapping
from datetime import datetime
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from membrane_ctrl.controller import safety
from membrane_ctrl.model import telemetry
from membrane_ctrl.model.arrays import Column
from membrane_ctrl.model.columns import (
    COLUMNS,
    Kind,
)

TIMES = ("mono_s", "time_s", "time_utc")
_COUNTS = ("rows", *(each.name for each in COLUMNS.values() if each.kind is Kind.COUNT))
_TIME_MAX_S = 1e9  # thirty years: a damaged file may hold any time


# By column: the name of each code.
WORDS: dict[str, dict[int, str]] = {
    "state": telemetry.name_codes(telemetry.State),
    "shape_state": telemetry.name_codes(telemetry.ShapeState),
    "safe_level": telemetry.name_codes(telemetry.SafeLevel),
    "fault": {0: "none"} | {rule.code: rule.name for rule in safety.TABLE},
}


def named_table(columns: Mapping[str, NDArray[Any]], origin_utc: datetime) -> pa.Table:
    """Arrow table of columns.

    Parameters
    ----------
    columns : dict of (n,) array
        One of them is `mono_s` or `time_s`: seconds of the run. NaN: no value.
    origin_utc : datetime
        UTC at 0 s of the run.

    Returns
    -------
    pyarrow.Table
        `time_s` and `time_utc` (timestamps to the microsecond), then the other columns: numbers,
        counts as integers, the codes of `WORDS` as dictionary-encoded names. An absent value is
        null.
    """
    time_s = np.asarray(
        columns["mono_s"] if "mono_s" in columns else columns["time_s"], dtype=np.float64
    )
    table = {"time_s": _null_non_finite(time_s), "time_utc": _to_utc(time_s, origin_utc)}
    for name, values in columns.items():
        if name in WORDS:
            table[name] = _name_codes(values, WORDS[name])
        elif name not in TIMES:
            if name in _COUNTS:
                table[name] = _null_non_finite(values).cast(pa.int64(), safe=False)
            else:
                table[name] = _null_non_finite(values)
    return pa.table(table)


def _null_non_finite(values: NDArray[Any]) -> pa.Array:
    return pa.array(values, from_pandas=True)  # NaN is null


def _to_utc(time_s: Column, origin_utc: datetime) -> pa.Array:
    possible = np.abs(time_s) < _TIME_MAX_S
    since_us = np.rint(np.where(possible, time_s, 0.0) * 1e6).astype("timedelta64[us]")
    origin = np.datetime64(round(origin_utc.timestamp() * 1e6), "us")
    return pa.array(origin + since_us, pa.timestamp("us", "UTC"), mask=~possible)


def _name_codes(codes: Column, words: Mapping[int, str]) -> pa.Array:
    """Names of codes; one that this version does not have is `code 99`."""
    there = np.isfinite(codes)
    found, places = np.unique(np.where(there, codes, 0.0), return_inverse=True)
    names = [words.get(int(code), f"code {code:g}") for code in found]
    return pa.DictionaryArray.from_arrays(
        pa.array(places.astype(np.int32), mask=~there), pa.array(names, pa.string())
    )
