"""The table of telemetry columns: the one place for their names, units, labels, decimals, plots and
descriptions.

Each field of `ColumnValues` is a column, and its `column(...)` is the column's row of the table. To
add a column, add a field here, and its value where the controller makes the row
(`controller/telemetry_row.py`). The recording, the run's tables, the viewer's plots, page, console,
`ctl status`, bridges, report, Grafana dashboard and docs/reference/telemetry.md are made from this
table.

An identifier ends in its unit (`error_um`), people read the unit as usual (µm): `unit_of` gives one
for the other.
"""

import math
from dataclasses import dataclass, field, fields
from enum import Enum
from typing import Any

from membrane_ctrl.model.colours import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    RED,
    VIOLET,
    WHITE,
    YELLOW,
    Colour,
)

MISSING = "–"  # shown for a value that is not known

# By the end of an identifier: the unit for people. The first one that fits counts.
UNIT_SUFFIXES: dict[str, str] = {
    "_um_per_s": "µm/s",
    "_um": "µm",
    "_mm": "mm",
    "_pa": "Pa",
    "_c": "°C",
    "_urad": "µrad",
    "_adu": "ADU",
    "_hz": "Hz",
    "_ms": "ms",
    "_s": "s",
    "_innovation": "σ",
    "_percent": "%",
    "_ppm": "ppm",
}

# What a unit measures, where the unit alone gives it.
QUANTITY_OF_UNIT: dict[str, str] = {"Pa": "pressure", "°C": "temperature"}
_TABLE_KEY = "column"


def unit_of(name: str) -> str:
    """Return the unit of an identifier for people.

    Parameters
    ----------
    name : str
        With its unit as suffix, such as `error_um`.

    Returns
    -------
    str
        Such as `µm`; empty for counts, codes and fractions.
    """
    return next((unit for suffix, unit in UNIT_SUFFIXES.items() if name.endswith(suffix)), "")


class Kind(Enum):
    """What the numbers of a column are."""

    QUANTITY = "quantity"
    COUNT = "count"  # an integer
    CODE = "code"  # an integer that stands for a name


class Aggregation(Enum):
    """What the overview levels (1, 10 and 60 s) keep of a column."""

    NONE = "none"
    EXTREMES = "min, mean, max"
    LAST = "last"
    LARGEST = "largest"


class Group(Enum):
    """Groups of columns: a section of displays and documentation."""

    LOOP = "Loop"
    PUMP = "Pump"
    ESTIMATE = "Estimate of the centre"
    ENVIRONMENT = "Gas and air"
    SHAPE = "Shape"
    TIMING = "Timing"
    STATE = "State"  # drawn as lanes of words
    RECORD = "Record"  # for programs rather than people: in no plot


DRAWN = tuple(group for group in Group if group not in (Group.STATE, Group.RECORD))


@dataclass(frozen=True, slots=True)
class Plot:
    """A plot of the viewer and the report.

    Attributes
    ----------
    title : str
        Without the unit, which is that of its columns.
    group : Group
        Of the columns that the plot shows.
    """

    title: str
    group: Group


POSITION = Plot("Position of the centre", Group.LOOP)
ERROR = Plot("Error", Group.LOOP)
TERMS = Plot("P, I, D and feed-forward", Group.LOOP)
FLOW = Plot("Flow and leak", Group.PUMP)
DRIVE = Plot("Pump and vent", Group.PUMP)
ESTIMATE_SIGMA = Plot("Estimate of the centre, 1 σ", Group.ESTIMATE)
INNOVATIONS = Plot("Innovations", Group.ESTIMATE)
OPTICS_SHARE = Plot("Share of the optics in the estimate", Group.ESTIMATE)
GAUGE = Plot("Gauge pressure", Group.ENVIRONMENT)
AMBIENT = Plot("Ambient pressure", Group.ENVIRONMENT)
TEMPERATURES = Plot("Temperatures", Group.ENVIRONMENT)
HUMIDITY = Plot("Relative humidity", Group.ENVIRONMENT)
STRAINS = Plot("Strains of film and ring", Group.ENVIRONMENT)
CLIMATE_FIGURE = Plot("Figure change predicted from the climate", Group.ENVIRONMENT)
TRIM = Plot("Trim of the shape loop", Group.SHAPE)
LATENESS = Plot("Lateness of the tick", Group.TIMING)
INTERVAL = Plot("Time between ticks", Group.TIMING)
MISSED = Plot("Ticks missed so far", Group.TIMING)
CODES = Plot("Codes", Group.STATE)
RECORD = Plot("Record", Group.RECORD)


@dataclass(frozen=True, slots=True)
class TelemetryColumn:
    """A column of telemetry, or of measured figures (`figure_columns`).

    Attributes
    ----------
    name : str
        Identifier with its unit as suffix: field of the row, column of tables, topic of bridges.
    label : str
        For people, without the unit.
    description : str
        What it is, as a phrase.
    plot : Plot
        Where it is drawn, which also determines its group.
    entity : str
        Rerun entity. Columns that are known together share one: m scalars of one entity cost the
        writer and the viewer far less than m entities. Empty: not drawn, or a time axis.
    colour : tuple of int
        Red, green, blue.
    width : float
        Of its line, in points.
    decimals : int
        For people.
    kind : Kind
    aggregation : Aggregation
        What overview levels keep.
    published : bool
        Whether page, console, `ctl status`, bridges and dashboard show it; such a column is
        aggregated.
    """

    name: str
    label: str
    description: str
    plot: Plot
    entity: str
    colour: Colour = BLUE
    width: float = 1.5
    decimals: int = 2
    kind: Kind = Kind.QUANTITY
    aggregation: Aggregation = Aggregation.NONE
    published: bool = False

    @property
    def unit(self) -> str:
        """Unit for people; empty for counts, codes and fractions."""
        return unit_of(self.name)

    @property
    def title(self) -> str:
        """Label and unit: `error, µm`."""
        if not self.unit:
            return self.label
        return f"{self.label}, {self.unit}"

    @property
    def legend(self) -> str:
        """Label and unit as the viewer's legend has room for: `error µm`."""
        return f"{self.label} {self.unit}".rstrip()

    @property
    def short_label(self) -> str:
        """Label without what its unit gives: `gauge` for `gauge pressure` in Pa."""
        quantity = QUANTITY_OF_UNIT.get(self.unit)
        if quantity is None:
            return self.label
        return self.label.removesuffix(f" {quantity}")

    @property
    def twin_only(self) -> bool:
        """Whether it is known of a simulated mirror only."""
        return self.entity.startswith("/truth/")

    def format_value(self, value: float | None, sign: bool = False) -> str:
        """Return a value with the column's decimals, without unit.

        Parameters
        ----------
        value : float or None
            In the column's unit; None, NaN and infinity give a dash.
        sign : bool
            Whether a positive value has a plus.
        """
        if value is None or not math.isfinite(value):
            return MISSING
        plus = "+" if sign else ""
        return f"{value:{plus}z.{self.decimals}f}"


def declare_column(
    label: str,
    description: str,
    plot: Plot,
    entity: str,
    *,
    colour: Colour = BLUE,
    width: float = 1.5,
    decimals: int | None = None,
    kind: Kind = Kind.QUANTITY,
    aggregation: Aggregation | None = None,
    published: bool = False,
) -> Any:
    """Return a dataclass field whose metadata is a row of the table of columns.

    A value that nothing sets is missing: NaN.

    Parameters
    ----------
    label, description, plot, entity, colour, width, kind, published
        As the attributes of `TelemetryColumn`.
    decimals : int or None
        None: two for a quantity, none for counts and codes.
    aggregation : Aggregation or None
        None: overview levels keep the last value of a code, and minimum, mean and maximum of a
        published column.
    """
    if decimals is None:
        decimals = 2 if kind is Kind.QUANTITY else 0
    if aggregation is None:
        aggregation = _usual_aggregation(kind, published)
    about = {
        "label": label,
        "description": description,
        "plot": plot,
        "entity": entity,
        "colour": colour,
        "width": width,
        "decimals": decimals,
        "kind": kind,
        "aggregation": aggregation,
        "published": published,
    }
    return field(default=math.nan, metadata={_TABLE_KEY: about})


def _usual_aggregation(kind: Kind, published: bool) -> Aggregation:
    if kind is Kind.CODE:
        return Aggregation.LAST
    if published:
        return Aggregation.EXTREMES
    return Aggregation.NONE


_EXTREMES = Aggregation.EXTREMES


@dataclass(frozen=True, slots=True)
class ColumnValues:
    """What one tick read, decided and wrote; NaN for missing values. Its fields are the table of
    columns.
    """

    mono_s: float = declare_column(
        "time", "the run's clock at the start of the tick", RECORD, "", decimals=3
    )
    tick: float = declare_column(
        "tick", "number of the tick, from 1", RECORD, "/tick/record", colour=GREY, kind=Kind.COUNT
    )
    dt_s: float = declare_column(
        "time between ticks",
        "true time since the last tick, clamped",
        INTERVAL,
        "/tick/dt",
        decimals=4,
    )
    lateness_ms: float = declare_column(
        "lateness",
        "start of the tick after its deadline",
        LATENESS,
        "/tick/lateness",
        decimals=1,
        published=True,
    )
    missed_ticks: float = declare_column(
        "missed ticks",
        "ticks missed so far in the run",
        MISSED,
        "/tick/missed",
        colour=RED,
        width=2.0,
        kind=Kind.COUNT,
        published=True,
    )
    state: float = declare_column(
        "state", "state of the controller", CODES, "/tick/record", colour=GREEN, kind=Kind.CODE
    )
    shape_state: float = declare_column(
        "shape loop",
        "state of the shape loop",
        CODES,
        "/tick/record",
        colour=VIOLET,
        kind=Kind.CODE,
    )
    safe_level: float = declare_column(
        "safe level", "active safe level", CODES, "/tick/record", colour=YELLOW, kind=Kind.CODE
    )
    fault: float = declare_column(
        "fault",
        "code of the standing fault; 0 without one",
        CODES,
        "/tick/record",
        colour=RED,
        kind=Kind.CODE,
        aggregation=Aggregation.LARGEST,
    )
    target_um: float = declare_column(
        "target",
        "end of the setpoint's ramp",
        POSITION,
        "/loop/position",
        colour=WHITE,
        width=1.0,
        published=True,
    )
    setpoint_um: float = declare_column(
        "setpoint",
        "setpoint of the loop, with the trim",
        POSITION,
        "/loop/position",
        colour=ORANGE,
        published=True,
    )
    displacement_um: float = declare_column(
        "reading",
        "reading of the laser; of the optics where they replace it",
        POSITION,
        "/loop/position",
        colour=GREY,
        width=1.0,
        published=True,
    )
    filtered_um: float = declare_column(
        "process value",
        "what the loop holds: the filtered reading, or the estimate of the centre",
        POSITION,
        "/loop/position",
    )
    error_um: float = declare_column(
        "error", "setpoint minus process value", ERROR, "/loop/error", published=True
    )
    p_um_per_s: float = declare_column("P", "proportional term", TERMS, "/loop/terms", decimals=3)
    i_um_per_s: float = declare_column(
        "I", "integral term", TERMS, "/loop/terms", colour=ORANGE, decimals=3
    )
    d_um_per_s: float = declare_column(
        "D", "derivative term", TERMS, "/loop/terms", colour=VIOLET, decimals=3
    )
    feedforward_um_per_s: float = declare_column(
        "feed-forward",
        "flow for known disturbances and the setpoint's ramp",
        TERMS,
        "/loop/terms",
        colour=GREEN,
        decimals=3,
        aggregation=_EXTREMES,
    )
    flow_wanted_um_per_s: float = declare_column(
        "flow wanted",
        "flow that the loop asks for; what exceeds the flow is beyond its limits",
        FLOW,
        "/loop/flow",
        colour=GREY,
        decimals=3,
    )
    flow_um_per_s: float = declare_column(
        "flow",
        "the pump's flow, as motion of the centre",
        FLOW,
        "/loop/flow",
        decimals=3,
        published=True,
    )
    pump_fraction: float = declare_column(
        "pump",
        "pump command, share of full scale",
        DRIVE,
        "/pump/drive",
        decimals=3,
        published=True,
    )
    vent_fraction: float = declare_column(
        "vent",
        "vent command, share of full scale",
        DRIVE,
        "/pump/drive",
        colour=RED,
        decimals=3,
        published=True,
    )
    pump_readback_fraction: float = declare_column(
        "pump read-back",
        "pump command that the device reports",
        DRIVE,
        "/pump/drive",
        colour=GREY,
        width=1.0,
        decimals=3,
    )
    vent_readback_fraction: float = declare_column(
        "vent read-back",
        "vent command that the device reports",
        DRIVE,
        "/pump/drive",
        colour=VIOLET,
        width=1.0,
        decimals=3,
    )
    gauge_pressure_pa: float = declare_column(
        "gauge pressure",
        "pressure in the mirror above ambient",
        GAUGE,
        "/gas/pressure",
        decimals=1,
        published=True,
    )
    ambient_pressure_pa: float = declare_column(
        "ambient pressure",
        "reading of the barometer",
        AMBIENT,
        "/ambient/pressure",
        colour=ORANGE,
        decimals=1,
        published=True,
    )
    air_temperature_c: float = declare_column(
        "air temperature",
        "temperature of the air around the mirror",
        TEMPERATURES,
        "/ambient/temperature",
        colour=ORANGE,
        published=True,
    )
    gas_temperature_c: float = declare_column(
        "gas temperature",
        "temperature of the gas in the mirror",
        TEMPERATURES,
        "/gas/temperature",
        colour=VIOLET,
        published=True,
    )
    film_temperature_c: float = declare_column(
        "film temperature",
        "temperature of the film; missing without a film thermometer",
        TEMPERATURES,
        "/film/temperature",
        published=True,
    )
    ring_temperature_c: float = declare_column(
        "ring temperature",
        "temperature of the ring; missing without a ring thermometer",
        TEMPERATURES,
        "/ring/temperature",
        colour=GREY,
        published=True,
    )
    humidity_percent: float = declare_column(
        "relative humidity",
        "humidity of the air around the mirror; missing without a hygrometer",
        HUMIDITY,
        "/ambient/humidity",
        decimals=1,
        published=True,
    )
    film_strain_ppm: float = declare_column(
        "film strain",
        "strain of the film by temperature and humidity since the hold began",
        STRAINS,
        "/film/strain",
        decimals=1,
    )
    ring_strain_ppm: float = declare_column(
        "ring strain",
        "strain of the ring by temperature since the hold began",
        STRAINS,
        "/ring/strain",
        colour=GREY,
        decimals=1,
    )
    climate_figure_um: float = declare_column(
        "climate figure",
        "change of the figure, RMS, predicted from the two strains at a held centre",
        CLIMATE_FIGURE,
        "/film/figure_change",
        published=True,
    )
    climate_sigma_um: float = declare_column(
        "climate figure sigma",
        "standard deviation of that prediction",
        CLIMATE_FIGURE,
        "/film/figure_change_sigma",
        colour=GREY,
    )
    displacement_quality: float = declare_column(
        "displacement quality",
        "quality code of the laser's reading; 0 is good, missing where the optics hold "
        "without a laser",
        RECORD,
        "/tick/record",
        colour=RED,
        decimals=0,
        aggregation=_EXTREMES,
    )
    sample_counter: float = declare_column(
        "sample counter",
        "the board's count of its samples",
        RECORD,
        "/tick/record",
        kind=Kind.COUNT,
    )
    device_time_s: float = declare_column(
        "device time",
        "the board's clock at its sample",
        RECORD,
        "/tick/record",
        colour=ORANGE,
        decimals=3,
    )
    leak_um_per_s: float = declare_column(
        "leak",
        "estimated leak, as motion of the centre",
        FLOW,
        "/loop/flow",
        colour=RED,
        width=2.0,
        decimals=3,
        published=True,
    )
    trim_um: float = declare_column(
        "trim",
        "the shape loop's part of the setpoint",
        TRIM,
        "/shape/trim",
        colour=VIOLET,
        width=2.0,
        published=True,
    )
    held_offset_um: float = declare_column(
        "offset of the held scalar",
        "how far the centre is moved so that focus or figure stay; missing where the centre is "
        "held",
        TRIM,
        "/shape/held_offset",
        colour=GREEN,
        width=2.0,
        aggregation=_EXTREMES,
    )
    held_offset_sigma_um: float = declare_column(
        "offset of the held scalar, 1 σ",
        "its standard deviation by the noise of the figures",
        RECORD,
        "/shape/held_offset_sigma",
        decimals=3,
    )
    truth_displacement_um: float = declare_column(
        "true centre",
        "true displacement of the centre; twin only",
        POSITION,
        "/truth/displacement",
        colour=GREEN,
        width=2.0,
    )
    truth_laser_bias_um: float = declare_column(
        "true drift of the laser's mount",
        "part of the reading that is no motion of the mirror; twin only",
        RECORD,
        "/truth/laser_bias",
        colour=RED,
    )
    # the estimate of the centre (docs/explanation/estimator.md), which is then the process value
    estimate_sigma_um: float = declare_column(
        "estimate of the centre, 1 σ",
        "standard deviation of the estimate; missing where the laser is held",
        ESTIMATE_SIGMA,
        "/estimate/sigma",
        decimals=3,
    )
    optics_share: float = declare_column(
        "share of the optics",
        "share of the optics in the estimate's corrections; the laser has the rest",
        OPTICS_SHARE,
        "/estimate/optics_share",
        decimals=3,
    )
    laser_innovation: float = declare_column(
        "laser innovation",
        "reading less expectation, in standard deviations; missing while it is not used",
        INNOVATIONS,
        "/estimate/innovations",
        colour=GREY,
        width=1.0,
    )
    optics_innovation: float = declare_column(
        "optics innovation", "as the laser's", INNOVATIONS, "/estimate/innovations"
    )
    barometer_innovation: float = declare_column(
        "barometer innovation",
        "as the laser's",
        INNOVATIONS,
        "/estimate/innovations",
        colour=ORANGE,
        width=1.0,
    )
    thermometer_innovation: float = declare_column(
        "thermometer innovation",
        "as the laser's",
        INNOVATIONS,
        "/estimate/innovations",
        colour=RED,
        width=1.0,
    )
    interlocks_open: float = declare_column(
        "open interlocks",
        "bit i: interlock i of the configuration is open or lost; missing without interlocks "
        "or without a reading",
        RECORD,
        "/interlocks/open",
        colour=RED,
        decimals=0,
    )


COLUMNS: dict[str, TelemetryColumn] = {
    each.name: TelemetryColumn(each.name, **each.metadata[_TABLE_KEY])
    for each in fields(ColumnValues)
}

# Group by group: the order for people.
BY_GROUP: tuple[TelemetryColumn, ...] = tuple(
    each for group in Group for each in COLUMNS.values() if each.plot.group is group
)
PUBLISHED: tuple[TelemetryColumn, ...] = tuple(each for each in BY_GROUP if each.published)

# Computed where it is shown (`telemetry.true_error_um`).
TRUE_ERROR_COLUMN = TelemetryColumn(
    "true_error_um",
    "true error",
    "target minus true centre; twin only",
    ERROR,
    "/truth/error",
    colour=GREEN,
    width=2.0,
    aggregation=_EXTREMES,
)


# By name: all columns, also those that no row has.
EVERY_COLUMN: dict[str, TelemetryColumn] = {**COLUMNS, TRUE_ERROR_COLUMN.name: TRUE_ERROR_COLUMN}

# What overview levels keep as minimum, mean and maximum.
AGGREGATED: tuple[TelemetryColumn, ...] = tuple(
    each for each in EVERY_COLUMN.values() if each.aggregation is Aggregation.EXTREMES
)


def plots_of(*groups: Group) -> tuple[Plot, ...]:
    """Return the plots of some groups, group by group."""
    return tuple(dict.fromkeys(each.plot for each in BY_GROUP if each.plot.group in groups))


def columns_of(plot: Plot) -> tuple[TelemetryColumn, ...]:
    """Return the columns that a plot shows, in the order of the table."""
    return tuple(each for each in EVERY_COLUMN.values() if each.plot == plot)


def aggregated_of(plot: Plot) -> tuple[TelemetryColumn, ...]:
    """Return the columns of a plot whose minimum, mean and maximum overview levels keep."""
    return tuple(each for each in columns_of(plot) if each in AGGREGATED)


def plot_title(plot: Plot, detail: str = "") -> str:
    """Return the title of a plot with its unit.

    Parameters
    ----------
    plot : Plot
    detail : str
        What is shown of it, such as `mean of each second`.

    Returns
    -------
    str
        Such as `Flow and leak, mean of each second, µm/s`.
    """
    return title_with_unit(plot.title, detail, columns_of(plot)[0].unit)


def title_with_unit(title: str, detail: str, unit: str) -> str:
    """Return a title, a detail and a unit with commas between them.

    Parameters
    ----------
    title, detail, unit : str
        Any of them may be empty, and is then left out.
    """
    return ", ".join(part for part in (title, detail, unit) if part)
