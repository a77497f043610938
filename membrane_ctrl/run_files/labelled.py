"""Tables of a run as labelled data: a pandas frame, or an xarray dataset with units and
descriptions.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pyarrow as pa

from membrane_ctrl.model.optional import import_optional
from membrane_ctrl.model.zernike_terms import NOLL_INDICES
from membrane_ctrl.run_files import named_tables, shapes, table_specs
from membrane_ctrl.run_files.table_store.spec import TableSpec

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

LabelledTable = Literal["ticks", "overview", "cycles"]
Labels = dict[str, dict[str, str]]
_TIME = "time"


def labels_of(spec: TableSpec) -> Labels:
    """Unit and description of each column of a table, by the names that xarray shows."""
    # By the key of our metadata: the attribute that xarray shows on axes (CF conventions)
    attributes = {b"unit": "units", b"description": "long_name"}
    labels: Labels = {}
    for field in spec.schema:
        metadata = field.metadata or {}
        known = {attributes[key]: text for key, text in metadata.items() if key in attributes}
        labels[field.name] = {name: text.decode() for name, text in known.items() if text}
    return labels


def make_frame(table: pa.Table) -> pd.DataFrame:
    """A table for people (`named_tables.named_table`) with its UTC as index; names of codes are
    categories.
    """
    import_optional("pandas", "data", "a frame")
    return table.to_pandas().set_index("time_utc")


def make_dataset(table: pa.Table, labels: Labels, about: Mapping[str, str]) -> xr.Dataset:
    """A table for people as a dataset along `time` (UTC), with `time_s` as a second coordinate.

    Parameters
    ----------
    table : pyarrow.Table
        As made by `named_tables.named_table`.
    labels : mapping
        Unit and description by column.
    about : mapping
        Attributes of the dataset.

    Returns
    -------
    xarray.Dataset
        A missing number is NaN, a missing name an empty string.
    """
    xarray = import_optional("xarray", "data", "a dataset")
    times = _naive_utc(table.column("time_utc"))
    coordinates = {
        _TIME: times,
        "time_s": (_TIME, _column_values(table.column("time_s")), {"units": "s"}),
    }
    names = [name for name in table.column_names if name not in named_tables.TIMES]
    variables = {
        name: (_TIME, _column_values(table.column(name)), dict(labels.get(name, {})))
        for name in names
    }
    return xarray.Dataset(variables, coords=coordinates, attrs=dict(about))


def make_cycles_dataset(
    found: shapes.Shapes,
    part_s: tuple[float, float],
    origin_utc: datetime,
    about: Mapping[str, str],
) -> xr.Dataset:
    """Measured figures along `time`, their coefficients also along `noll`, covariances along
    `covariance_time`.

    Parameters
    ----------
    found : Shapes
        All figures of the run, by time.
    part_s : (float, float)
        Part of the run, s.
    origin_utc : datetime
        UTC at 0 s of the run.
    about : mapping
        Attributes of the dataset.
    """
    xarray = import_optional("xarray", "data", "a dataset")
    # Covariances are recorded less often than cycles, and have their own times.
    found = found.select_cycles((found.time_s >= part_s[0]) & (found.time_s < part_s[1]))
    kept = (found.covariance_time_s >= part_s[0]) & (found.covariance_time_s < part_s[1])
    labels = labels_of(table_specs.SHAPES) | labels_of(table_specs.COVARIANCES)
    numbers = [name for name in shapes.NUMBERS if name != "time_s"]
    variables: dict[str, Any] = {
        name: (_TIME, getattr(found, name), dict(labels[name])) for name in numbers
    }
    variables["verdict"] = (_TIME, np.asarray(found.verdict, dtype=str))
    variables["coeffs_um"] = ((_TIME, "noll"), found.coeffs_um, dict(labels["coeffs_um"]))
    dimensions = ("covariance_time", "noll", "noll_other")
    variables["covariance_um2"] = (
        dimensions,
        found.covariance_um2[kept],
        dict(labels["covariance_um2"]),
    )
    origin = np.datetime64(origin_utc.replace(tzinfo=None), "us")
    coordinates = {
        _TIME: origin + _to_microseconds(found.time_s),
        "time_s": (_TIME, found.time_s, {"units": "s"}),
        "covariance_time": origin + _to_microseconds(found.covariance_time_s[kept]),
        "noll": NOLL_INDICES,
        "noll_other": NOLL_INDICES,
    }
    return xarray.Dataset(variables, coords=coordinates, attrs=dict(about))


def _to_microseconds(time_s: np.ndarray) -> np.ndarray:
    return np.rint(time_s * 1e6).astype("timedelta64[us]")


def _naive_utc(column: pa.ChunkedArray) -> np.ndarray:
    """UTC without a time zone, as xarray stores times."""
    return np.asarray(column.cast(pa.timestamp("us")).to_numpy())


def _column_values(column: pa.ChunkedArray) -> np.ndarray:
    if pa.types.is_dictionary(column.type):
        column = column.cast(pa.string())
    if pa.types.is_string(column.type):
        return np.asarray(column.fill_null("").to_pylist(), dtype=str)
    return np.asarray(column.to_numpy())
