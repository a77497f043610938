"""The fields of a run's tables: name, type, unit and description of each column."""

import pyarrow as pa

from membrane_ctrl.controller.tick_codec import RECORD, SAME
from membrane_ctrl.model import shape_estimate
from membrane_ctrl.model.columns import COLUMNS, TRUE_ERROR_COLUMN, Kind, TelemetryColumn, unit_of
from membrane_ctrl.model.figure_columns import RECORDED_COLUMNS
from membrane_ctrl.model.zernike_terms import COVARIANCE_UPPER_SIZE, ZERNIKE_TERMS
from membrane_ctrl.run_files.table_store.spec import PART_S, TableSpec

FORMAT = "membrane-table/1"
# Fields of a tick's record that are no column of its telemetry row, and are not repeated in it: the
# table of inputs.
INPUT_FIELDS: tuple[str, ...] = tuple(
    name for name in RECORD.names or () if name not in SAME or name == "now_s"
)
# By the field of a record: the column of the telemetry row with that reading or time, exact or
# derived.
ROW_COLUMNS: dict[str, str] = {
    name: SAME.get(name, name) for name in RECORD.names or () if SAME.get(name, name) in COLUMNS
}
_INPUT_TEXTS = {
    "flags": "bit 0: the link was up; bit 1: there was a reading",
    "estimate_time_s": "time of the shape estimate that arrived in this tick; NaN without one",
    "output_crc": "CRC-32 of the tick's outputs",
    "tail_bytes": "size of the tick's commands and ended tasks in the table of rare inputs",
}
_HOW = {
    "min": "least value",
    "mean": "mean",
    "max": "greatest value",
    "std": "standard deviation of single ticks",
}


def make_field(
    name: str, kind: pa.DataType, description: str, unit: str | None = None, **more: str
) -> pa.Field:
    """Return a field with its description and unit as metadata.

    Parameters
    ----------
    name : str
        Of the column; its suffix states the unit, such as `_um`.
    kind : pyarrow.DataType
        Type of its values.
    description : str
        For people.
    unit : str, optional
        None: by the suffix of the name; empty: without a unit.
    more : str
        Further metadata.
    """
    about = {"description": description, "unit": unit_of(name) if unit is None else unit, **more}
    return pa.field(name, kind, metadata={key: text for key, text in about.items() if text})


def make_spec(
    name: str,
    fields: list[pa.Field],
    time_name: str = "time_s",
    group_rows: int = 30_000,
    layout: tuple[tuple[str, str], ...] = (),
    part_s: float = PART_S,
) -> TableSpec:
    """Return the specification of a table.

    Parameters
    ----------
    name : str
        Of the table and its folder.
    fields : list of pyarrow.Field
        Its columns, as `make_field` makes them.
    time_name : str
        The field in which rows are in ascending order.
    group_rows : int
        Rows of one row group in Parquet, which is read as a whole.
    layout : tuple of (str, str)
        What a reader needs of the lengths of lists.
    part_s : float
        Time after which the journal becomes a Parquet part.
    """
    about = {"schema": FORMAT, "table": name, **dict(layout)}
    schema = pa.schema(fields, metadata=about)
    return TableSpec(name, schema, time_name, group_rows, layout, part_s)


def make_tick_field(column: TelemetryColumn) -> pa.Field:
    """Return the field of a telemetry column: readings and times to the bit, the rest to seven
    digits.
    """
    if column.kind is not Kind.QUANTITY:
        return make_field(column.name, pa.int64(), column.description)
    if is_exact(column.name):
        return make_field(column.name, pa.float64(), column.description)
    return make_field(column.name, pa.float32(), column.description)


def is_exact(name: str) -> bool:
    """Whether a column of a tick's row is a reading or a time, and recorded to the bit."""
    return name in ROW_COLUMNS.values()


def make_input_field(name: str) -> pa.Field:
    """Return the field of a tick's input, in the type of the record."""
    kind = pa.from_numpy_dtype(RECORD[name])
    if name == "now_s":
        return make_field("time_s", kind, COLUMNS["mono_s"].description)
    if name in COLUMNS:
        return make_field(name, kind, f"{COLUMNS[name].description}, as it was read")
    return make_field(
        name, kind, _INPUT_TEXTS.get(name, f"{name.replace('_', ' ')} of the tick's reading")
    )


def make_shape_fields() -> list[pa.Field]:
    """Return the fields of a figure: numbers, verdict, coefficients and their covariance."""
    return [
        *(
            make_field(name, pa.float64(), RECORDED_COLUMNS[name].description)
            for name in shape_estimate.NUMBERS
        ),
        make_field("cycle", pa.int64(), "number of the cycle or frame"),
        make_field(
            "tracking_lost",
            pa.bool_(),
            "phases cannot be tracked from here: a full cycle is needed",
        ),
        make_field("kind", pa.string(), "full, fringes or track"),
        make_field("verdict", pa.string(), "ok, degraded or rejected"),
        make_field("reason", pa.string(), "why it is not ok"),
        make_field(
            "coeffs_um", pa.list_(pa.float64(), ZERNIKE_TERMS), "Zernike coefficients, Noll 1..."
        ),
        make_field(
            "sigma_um",
            pa.list_(pa.float32(), ZERNIKE_TERMS),
            "standard deviation of changes of the coefficients",
        ),
        make_field(
            "upper_um2",
            pa.list_(pa.float32(), COVARIANCE_UPPER_SIZE),
            "upper half of the coefficients' covariance, row by row",
            "µm²",
        ),
    ]


def make_level_field(name: str) -> pa.Field:
    """Return a field of a level: `time_s`, `rows`, a count, or `min_`, `mean_`, ... of a column."""
    if name == "time_s":
        return make_field(name, pa.float64(), "start of the window")
    if name == "rows":
        return make_field(name, pa.int64(), "ticks in the window")
    if name in COLUMNS:
        return make_field(name, pa.int64(), COLUMNS[name].description)
    how, _, signal = name.partition("_")
    column = COLUMNS.get(signal, TRUE_ERROR_COLUMN)
    wide = column.unit == "Pa"
    return make_field(
        name,
        pa.float64() if wide else pa.float32(),
        f"{_HOW[how]} of: {column.description}",
        column.unit,
    )


def level_table(window_s: float) -> str:
    """Name of the table of a level."""
    return f"ticks_{window_s:.0f}s"
