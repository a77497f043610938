"""The tables of a run: their names and columns, with unit and description in the metadata of each
field.
"""

from dataclasses import replace

import pyarrow as pa

from membrane_ctrl.model.arithmetic import describe_arithmetic
from membrane_ctrl.model.columns import COLUMNS
from membrane_ctrl.model.program import file_origin
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.run_files import figure_minutes, levels
from membrane_ctrl.run_files.table_fields import (
    FORMAT,
    INPUT_FIELDS,
    level_table,
    make_field,
    make_input_field,
    make_level_field,
    make_shape_fields,
    make_spec,
    make_tick_field,
)
from membrane_ctrl.run_files.table_store.spec import LONG_PART_S, PART_S, TableSpec

# The covariance of one cycle in this time is enough for a report: a month of all would be 3 GB.
COVARIANCE_INTERVAL_S = 600.0
# A row of these holds 3 kB, a thumbnail 10 kB.
_SHAPE_GROUP_ROWS = 3_000
# A row of these holds up to 70 kB, and a replay reads one.
_SNAPSHOT_GROUP_ROWS = 50
_THUMBNAIL_GROUP_ROWS = 500
_SHAPE_LAYOUT = (("zernike_terms", str(ZERNIKE_TERMS)),)


TICKS = make_spec("ticks", [make_tick_field(column) for column in COLUMNS.values()], "mono_s")
INPUTS = make_spec(
    "inputs",
    [make_field("tick", pa.int64(), "number of the tick"), *map(make_input_field, INPUT_FIELDS)],
)
RARE = make_spec(
    "rare",
    [
        make_field("time_s", pa.float64(), "start of the tick"),
        make_field("tick", pa.int64(), "number of the tick"),
        make_field("json", pa.string(), "commands and ended tasks of the tick"),
    ],
)
SNAPSHOTS = make_spec(
    "snapshots",
    [
        make_field("time_s", pa.float64(), "start of the tick"),
        make_field("tick", pa.int64(), "number of the tick"),
        make_field("json", pa.string(), "what the controller remembers before the tick"),
    ],
    group_rows=_SNAPSHOT_GROUP_ROWS,
)
SHAPES = make_spec(
    "shapes", make_shape_fields(), group_rows=_SHAPE_GROUP_ROWS, layout=_SHAPE_LAYOUT
)
TRACKED = make_spec(
    "tracked", make_shape_fields(), group_rows=_SHAPE_GROUP_ROWS, layout=_SHAPE_LAYOUT
)
COVARIANCES = make_spec(
    "covariances",
    [
        make_field("time_s", pa.float64(), "time of the cycle"),
        make_field(
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
    window_s: make_spec(
        level_table(window_s),
        [make_level_field(name) for name in levels.NAMES],
        part_s=PART_S if window_s == levels.WINDOWS_S[0] else LONG_PART_S,
    )
    for window_s in levels.WINDOWS_S
}
FIGURE_MINUTES = make_spec(
    f"figures_{figure_minutes.WINDOW_S:.0f}s",
    [
        make_field("time_s", pa.float64(), "start of the window"),
        make_field("figures", pa.int64(), "usable cycles and tracked frames in the window"),
        make_field(
            "coeffs_um",
            pa.list_(pa.float32(), ZERNIKE_TERMS),
            "mean of the Zernike coefficients, Noll 1...",
        ),
        make_field(
            "scatter_um",
            pa.list_(pa.float32(), ZERNIKE_TERMS),
            "standard deviation of single figures about that mean",
        ),
    ],
    layout=_SHAPE_LAYOUT,
    part_s=LONG_PART_S,
)
_EVENT_FIELDS = [
    make_field("number", pa.int64(), "of the event in the run, from 1"),
    make_field("time_s", pa.float64(), "when it was reported"),
    make_field("time_utc", pa.timestamp("us", "UTC"), "the same in UTC"),
    make_field("kind", pa.string(), "kind of the event"),
    make_field("text", pa.string(), "sentence for people"),
    make_field("data", pa.string(), "the line of events.jsonl"),
]
# events of several processes may be reported out of order
EVENTS = make_spec("events", _EVENT_FIELDS, "number")
MARKS = make_spec("marks", _EVENT_FIELDS, "number")
THUMBNAILS = make_spec(
    "thumbnails",
    [
        make_field("number", pa.int64(), "of the picture in the run, from 1"),
        make_field("time_s", pa.float64(), "middle of the exposure"),
        make_field("pattern", pa.string(), "the pattern on the screen"),
        make_field("jpeg", pa.binary(), "the picture"),
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
