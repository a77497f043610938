"""The tables of a run: their names and columns, with unit and description in the metadata of each
field.
"""

from dataclasses import replace

import pyarrow as pa

from membrane_ctrl.controller.tick_codec import RECORD, SAME
from membrane_ctrl.model import shape_estimate
from membrane_ctrl.model.arithmetic import describe_arithmetic
from membrane_ctrl.model.columns import COLUMNS, TRUE_ERROR_COLUMN, Kind, TelemetryColumn, unit_of
from membrane_ctrl.model.figure_columns import RECORDED_COLUMNS
from membrane_ctrl.model.program import file_origin
from membrane_ctrl.model.zernike_terms import COVARIANCE_UPPER_SIZE, ZERNIKE_TERMS
from membrane_ctrl.run_files import figure_minutes, levels
from membrane_ctrl.run_files.table_store.spec import LONG_PART_S, PART_S, TableSpec

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
# The covariance of one cycle in this time is enough for a report: a month of all would be 3 GB.
COVARIANCE_INTERVAL_S = 600.0
# A row of these holds 3 kB, a thumbnail 10 kB.
_SHAPE_GROUP_ROWS = 3_000
# A row of these holds up to 70 kB, and a replay reads one.
_SNAPSHOT_GROUP_ROWS = 50
_THUMBNAIL_GROUP_ROWS = 500
_INPUT_TEXTS = {
    "flags": "bit 0: the link was up; bit 1: there was a reading",
    "estimate_time_s": "time of the shape estimate that arrived in this tick; NaN without one",
    "output_crc": "CRC-32 of the tick's outputs",
    "tail_bytes": "size of the tick's commands and ended tasks in the table of rare inputs",
}
_SHAPE_LAYOUT = (("zernike_terms", str(ZERNIKE_TERMS)),)
_HOW = {
    "min": "least value",
    "mean": "mean",
    "max": "greatest value",
    "std": "standard deviation of single ticks",
}


def _make_field(
    name: str, kind: pa.DataType, description: str, unit: str | None = None, **more: str
) -> pa.Field:
    about = {"description": description, "unit": unit_of(name) if unit is None else unit, **more}
    return pa.field(name, kind, metadata={key: text for key, text in about.items() if text})


def _make_spec(
    name: str,
    fields: list[pa.Field],
    time_name: str = "time_s",
    group_rows: int = 30_000,
    layout: tuple[tuple[str, str], ...] = (),
    part_s: float = PART_S,
) -> TableSpec:
    about = {"schema": FORMAT, "table": name, **dict(layout)}
    schema = pa.schema(fields, metadata=about)
    return TableSpec(name, schema, time_name, group_rows, layout, part_s)


def _tick_field(column: TelemetryColumn) -> pa.Field:
    if column.kind is not Kind.QUANTITY:
        return _make_field(column.name, pa.int64(), column.description)
    if is_exact(column.name):
        return _make_field(column.name, pa.float64(), column.description)
    return _make_field(column.name, pa.float32(), column.description)


def is_exact(name: str) -> bool:
    """Whether a column of a tick's row is a reading or a time, and recorded to the bit."""
    return name in ROW_COLUMNS.values()


def _input_field(name: str) -> pa.Field:
    kind = pa.from_numpy_dtype(RECORD[name])
    if name == "now_s":
        return _make_field("time_s", kind, COLUMNS["mono_s"].description)
    if name in COLUMNS:
        return _make_field(name, kind, f"{COLUMNS[name].description}, as it was read")
    return _make_field(
        name, kind, _INPUT_TEXTS.get(name, f"{name.replace('_', ' ')} of the tick's reading")
    )


def _shape_fields() -> list[pa.Field]:
    return [
        *(
            _make_field(name, pa.float64(), RECORDED_COLUMNS[name].description)
            for name in shape_estimate.NUMBERS
        ),
        _make_field("cycle", pa.int64(), "number of the cycle or frame"),
        _make_field(
            "tracking_lost",
            pa.bool_(),
            "phases cannot be tracked from here: a full cycle is needed",
        ),
        _make_field("kind", pa.string(), "full, fringes or track"),
        _make_field("verdict", pa.string(), "ok, degraded or rejected"),
        _make_field("reason", pa.string(), "why it is not ok"),
        _make_field(
            "coeffs_um", pa.list_(pa.float64(), ZERNIKE_TERMS), "Zernike coefficients, Noll 1..."
        ),
        _make_field(
            "sigma_um",
            pa.list_(pa.float32(), ZERNIKE_TERMS),
            "standard deviation of changes of the coefficients",
        ),
        _make_field(
            "upper_um2",
            pa.list_(pa.float32(), COVARIANCE_UPPER_SIZE),
            "upper half of the coefficients' covariance, row by row",
            "µm²",
        ),
    ]


def _level_field(name: str) -> pa.Field:
    if name == "time_s":
        return _make_field(name, pa.float64(), "start of the window")
    if name == "rows":
        return _make_field(name, pa.int64(), "ticks in the window")
    if name in COLUMNS:
        return _make_field(name, pa.int64(), COLUMNS[name].description)
    how, _, signal = name.partition("_")
    column = COLUMNS.get(signal, TRUE_ERROR_COLUMN)
    wide = column.unit == "Pa"
    return _make_field(
        name,
        pa.float64() if wide else pa.float32(),
        f"{_HOW[how]} of: {column.description}",
        column.unit,
    )


def level_table(window_s: float) -> str:
    """Name of the table of a level."""
    return f"ticks_{window_s:.0f}s"


TICKS = _make_spec("ticks", [_tick_field(column) for column in COLUMNS.values()], "mono_s")
INPUTS = _make_spec(
    "inputs",
    [_make_field("tick", pa.int64(), "number of the tick"), *map(_input_field, INPUT_FIELDS)],
)
RARE = _make_spec(
    "rare",
    [
        _make_field("time_s", pa.float64(), "start of the tick"),
        _make_field("tick", pa.int64(), "number of the tick"),
        _make_field("json", pa.string(), "commands and ended tasks of the tick"),
    ],
)
SNAPSHOTS = _make_spec(
    "snapshots",
    [
        _make_field("time_s", pa.float64(), "start of the tick"),
        _make_field("tick", pa.int64(), "number of the tick"),
        _make_field("json", pa.string(), "what the controller remembers before the tick"),
    ],
    group_rows=_SNAPSHOT_GROUP_ROWS,
)
SHAPES = _make_spec("shapes", _shape_fields(), group_rows=_SHAPE_GROUP_ROWS, layout=_SHAPE_LAYOUT)
TRACKED = _make_spec("tracked", _shape_fields(), group_rows=_SHAPE_GROUP_ROWS, layout=_SHAPE_LAYOUT)
COVARIANCES = _make_spec(
    "covariances",
    [
        _make_field("time_s", pa.float64(), "time of the cycle"),
        _make_field(
            "covariance_um2",
            pa.list_(pa.float32(), ZERNIKE_TERMS**2),
            "covariance of the coefficients, row by row; of a cycle in "
            f"{COVARIANCE_INTERVAL_S:.0f} s",
            "µm²",
        ),
    ],
    layout=_SHAPE_LAYOUT,
)
LEVELS: dict[float, TableSpec] = {
    window_s: _make_spec(
        level_table(window_s),
        [_level_field(name) for name in levels.NAMES],
        part_s=PART_S if window_s == levels.WINDOWS_S[0] else LONG_PART_S,
    )
    for window_s in levels.WINDOWS_S
}
FIGURE_MINUTES = _make_spec(
    f"figures_{figure_minutes.WINDOW_S:.0f}s",
    [
        _make_field("time_s", pa.float64(), "start of the window"),
        _make_field("figures", pa.int64(), "usable cycles and tracked frames in the window"),
        _make_field(
            "coeffs_um",
            pa.list_(pa.float32(), ZERNIKE_TERMS),
            "mean of the Zernike coefficients, Noll 1...",
        ),
        _make_field(
            "scatter_um",
            pa.list_(pa.float32(), ZERNIKE_TERMS),
            "standard deviation of single figures about that mean",
        ),
    ],
    layout=_SHAPE_LAYOUT,
    part_s=LONG_PART_S,
)
_EVENT_FIELDS = [
    _make_field("number", pa.int64(), "of the event in the run, from 1"),
    _make_field("time_s", pa.float64(), "when it was reported"),
    _make_field("time_utc", pa.timestamp("us", "UTC"), "the same in UTC"),
    _make_field("kind", pa.string(), "kind of the event"),
    _make_field("text", pa.string(), "sentence for people"),
    _make_field("data", pa.string(), "the line of events.jsonl"),
]
# events of several processes may be reported out of order
EVENTS = _make_spec("events", _EVENT_FIELDS, "number")
MARKS = _make_spec("marks", _EVENT_FIELDS, "number")
THUMBNAILS = _make_spec(
    "thumbnails",
    [
        _make_field("number", pa.int64(), "of the picture in the run, from 1"),
        _make_field("time_s", pa.float64(), "middle of the exposure"),
        _make_field("pattern", pa.string(), "the pattern on the screen"),
        _make_field("jpeg", pa.binary(), "the picture"),
    ],
    "number",
    _THUMBNAIL_GROUP_ROWS,
)
ALL: tuple[TableSpec, ...] = (
    TICKS,
    INPUTS,
    RARE,
    SNAPSHOTS,
    SHAPES,
    TRACKED,
    COVARIANCES,
    *LEVELS.values(),
    FIGURE_MINUTES,
    EVENTS,
    MARKS,
    THUMBNAILS,
)


def with_origin(spec: TableSpec) -> TableSpec:
    """A table whose files state the running program and its commit."""
    about = {
        **file_origin(FORMAT),
        "table": spec.name,
        "arithmetic": describe_arithmetic(),
        **dict(spec.layout),
    }
    return replace(spec, schema=spec.schema.with_metadata(about))
