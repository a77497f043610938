"""The covariance of a geometry in a file: a `[covariance]` table beside `[geometry]`.

names = ["a_mm", "b_mm", "alpha_deg"], or of the twelve of the general form (see `metrology.geometry_spread`), and
matrix = rows of their covariance.
"""

from pathlib import Path

import numpy as np

from membrane_ctrl.config.schema import GeometryConfig
from membrane_ctrl.config.section import Section
from membrane_ctrl.config.toml_file import parse, read_toml
from membrane_ctrl.metrology.uncertainty.geometry_spread import PAPER_SPREAD, GeometrySpread, changed, stated_spread
from membrane_ctrl.model.errors import InputError


class CovarianceTable(Section):
    """The `[covariance]` table."""

    names: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]


def read_spread(path: Path) -> GeometrySpread | None:
    """The covariance that a geometry file gives; None if it has none. Raises InputError."""
    table = read_toml(path).get("covariance")
    if table is None:
        return None
    content = parse(table, CovarianceTable, f"{path}: covariance")
    if any(len(row) != len(content.names) for row in content.matrix) or len(content.matrix) != len(content.names):
        raise InputError(f"{path}: covariance.matrix: {len(content.names)} names need as many rows and columns")
    try:
        return GeometrySpread(content.names, np.array(content.matrix, float))
    except ValueError as error:
        raise InputError(f"{path}: covariance.{error}") from None


def spread_of(geometry: GeometryConfig, file: Path | None) -> tuple[GeometrySpread, str]:
    """How well a geometry is known, and where that is said; the first that there is.

    The file's covariance, the geometry's own sigmas, the paper's instruments for the short form. A general form
    without a covariance is taken as exact.

    Raises
    ------
    InputError
        If the file's covariance is of the other form.
    """
    given = None if file is None else read_spread(file)
    if given is not None:
        try:
            changed(geometry, given.names, np.zeros(len(given.names)))
        except ValueError as error:
            raise InputError(f"{file}: covariance.names: {error}") from None
        return given, f"covariance in {file}"
    stated = stated_spread(geometry)
    if stated is not None:
        return stated, "a_sigma_mm, b_sigma_mm, alpha_sigma_deg of the geometry"
    if geometry.a_mm is not None:
        return PAPER_SPREAD, "not stated: the paper's 2 mm, 2 mm and 0.3 degrees assumed"
    return GeometrySpread((), np.zeros((0, 0))), "not stated: poses taken as exact, pixel noise alone"
