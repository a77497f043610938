"""The table of columns of measured figures: the one place for their names, units, labels, plots and
descriptions, as `columns` is for telemetry.

A column is in the run's tables, in the viewer, or in both. Changes are against the figure at the
start of the hold; a change and a learned quantity are known only in the viewer, as they follow from
the tables.
"""

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
from membrane_ctrl.model.columns import RECORD, Group, Plot, TelemetryColumn, title_with_unit
from membrane_ctrl.model.zernike_terms import NOLL_INDICES

TERMS = Plot("Zernike terms", Group.SHAPE)
LOW_ORDERS = Plot("Low orders, change ± 1σ", Group.SHAPE)
SAG_CHANGE = Plot("Sag change by camera and laser", Group.SHAPE)
FOCUS = Plot("Focus ± 1σ", Group.SHAPE)
FIGURE_RMS = Plot("RMS against the first figure ± 1σ", Group.SHAPE)
SLOPE_RESIDUAL = Plot("Slope residual", Group.SHAPE)
FRINGE_QUALITY = Plot("Fringe quality", Group.SHAPE)
MODULATION = Plot("Modulation of the fringes", Group.SHAPE)
VIBRATIONS = Plot("Vibrations found in each minute", Group.SHAPE)
LATENCY = Plot("Last frame to result", Group.TIMING)
PUMP_CURVE = Plot("Pump against its curve", Group.PUMP)

VIBRATIONS_MOST = 8  # drawn at once


def _in_tables(name: str, description: str) -> TelemetryColumn:
    """Return a column that no plot shows."""
    return TelemetryColumn(name, description, description, RECORD, "")


def _low_order(index: int, name: str, colour: Colour) -> TelemetryColumn:
    return TelemetryColumn(
        f"z{index}_um",
        f"{name} Z{index}",
        f"change of Zernike term {index}",
        LOW_ORDERS,
        "/shape/change",
        colour,
    )


_RECORDED = (
    _in_tables("time_s", "middle of the exposures"),
    _in_tables(
        "hencky_um", "amplitude of the part of a Hencky bowl that the Zernike terms lack, as sag"
    ),
    _in_tables("sag_um", "height at the rim above the vertex"),
    _in_tables("sag_change_sigma_um", "standard deviation of changes of the sag"),
    _in_tables("displacement_um", "mean reading of the laser during the exposures"),
    TelemetryColumn(
        "slope_residual_urad",
        "slope residual",
        "RMS of measured minus fitted slopes",
        SLOPE_RESIDUAL,
        "/shape/residual",
    ),
    TelemetryColumn(
        "valid_fraction",
        "valid fraction",
        "share of the aperture with a slope",
        FRINGE_QUALITY,
        "/shape/quality",
        GREEN,
        2.0,
    ),
    TelemetryColumn(
        "modulation_median_adu",
        "modulation",
        "median modulation of the fringes",
        MODULATION,
        "/shape/modulation",
    ),
    TelemetryColumn(
        "saturated_fraction",
        "saturated fraction",
        "share of saturated pixels",
        FRINGE_QUALITY,
        "/shape/quality",
        RED,
    ),
    _in_tables("latency_s", "from the last frame to the result"),
    _in_tables("geometry_sag_sigma_um", "standard deviation of the sag that all cycles share"),
)
# By Noll index: low orders that a film shows, each worth a line.
LOW_ORDER_COLUMNS: dict[int, TelemetryColumn] = {
    4: _low_order(4, "defocus", BLUE),
    5: _low_order(5, "astigmatism", ORANGE),
    6: _low_order(6, "astigmatism", YELLOW),
    7: _low_order(7, "coma", GREEN),
    8: _low_order(8, "coma", VIOLET),
    9: _low_order(9, "trefoil", GREY),
    10: _low_order(10, "trefoil", WHITE),
    11: _low_order(11, "spherical", RED),
}
_DRAWN = (
    *(
        TelemetryColumn(
            f"z{index}_um", f"Z{index}", f"Zernike term {index}", TERMS, "/shape/zernike", GREY
        )
        for index in NOLL_INDICES
    ),
    *LOW_ORDER_COLUMNS.values(),
    TelemetryColumn(
        "sag_change_um",
        "sag change ± 1σ",
        "change of the sag by the camera",
        SAG_CHANGE,
        "/shape/sag_change",
        BLUE,
        2.0,
    ),
    TelemetryColumn(
        "laser_change_um",
        "laser change",
        "change of the laser's reading between the same cycles",
        SAG_CHANGE,
        "/shape/sag_change",
        ORANGE,
    ),
    TelemetryColumn(
        "focus_mm",
        "focus ± 1σ",
        "half the radius of the best sphere over the used aperture",
        FOCUS,
        "/shape/focus",
        BLUE,
        2.0,
    ),
    TelemetryColumn(
        "figure_rms_um",
        "RMS of the change ± 1σ",
        "RMS of the change of the figure without piston and tilt",
        FIGURE_RMS,
        "/shape/figure_rms",
        BLUE,
        2.0,
    ),
    TelemetryColumn(
        "least_rms_um",
        "at the best depth",
        "RMS that no depth can remove: the limit of one actuator",
        FIGURE_RMS,
        "/shape/figure_rms",
        ORANGE,
    ),
    TelemetryColumn(
        "latency_ms",
        "last frame to result",
        "from the last frame to the result",
        LATENCY,
        "/shape/latency",
    ),
    *(
        TelemetryColumn(
            f"mode_{number}_hz",
            f"mode {number}",
            "frequency of a vibration of the mirror",
            VIBRATIONS,
            "/shape/vibrations",
            GREY,
        )
        for number in range(1, VIBRATIONS_MOST + 1)
    ),
    TelemetryColumn(
        "pump_scale",
        "flow against its curve ± 1σ",
        "learned flow of the pump as a multiple of its curve",
        PUMP_CURVE,
        "/pump/scale",
        BLUE,
        2.0,
    ),
    TelemetryColumn(
        "pump_correction",
        "scale in use",
        "factor by which the loop corrects the curve",
        PUMP_CURVE,
        "/pump/scale",
        ORANGE,
    ),
)
# By name: the columns of the run's tables of figures that are numbers.
RECORDED_COLUMNS: dict[str, TelemetryColumn] = {each.name: each for each in _RECORDED}
DRAWN_COLUMNS: tuple[TelemetryColumn, ...] = (
    *(each for each in _RECORDED if each.entity),
    *_DRAWN,
)


def figure_columns_of(plot: Plot) -> tuple[TelemetryColumn, ...]:
    """Return the columns that a plot of figures shows, in the order of the table."""
    return tuple(each for each in DRAWN_COLUMNS if each.plot == plot)


def figure_plot_title(plot: Plot, detail: str = "") -> str:
    """Return the title of a plot of figures with its unit, as `columns.plot_title`.

    Parameters
    ----------
    plot : Plot
        A plot with at least one column of figures; the first one has the unit.
    detail : str
        Put between title and unit, unless it is empty.
    """
    return title_with_unit(plot.title, detail, figure_columns_of(plot)[0].unit)
