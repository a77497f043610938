"""Values of a tick for the console: with the label, the decimals and the unit of the table of columns."""

from membrane_ctrl.model.columns import COLUMNS
from membrane_ctrl.model.telemetry import TelemetryRow


def quantity(row: TelemetryRow, name: str, sign: bool = False, width: int = 0) -> str:
    """Return a value with its unit.

    Parameters
    ----------
    row : TelemetryRow
    name : str
        Column.
    sign : bool
        Whether a positive number has its sign.
    width : int
        Least width of the number.

    Returns
    -------
    str
        Such as `+0.25 µm`.
    """
    column = COLUMNS[name]
    return f"{column.format_value(getattr(row, name), sign):>{width}} {column.unit}".rstrip()


def labelled(row: TelemetryRow, name: str, sign: bool = False, width: int = 0) -> str:
    """Return a value with label and unit, such as `error +0.25 µm`; parameters as those of `quantity`."""
    return f"{COLUMNS[name].short_label} {quantity(row, name, sign, width)}"
