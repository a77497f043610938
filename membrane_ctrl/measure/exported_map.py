"""A measured height map to be exported: read from a result, with parts of it removed."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from membrane_ctrl.measure.result_files import read_arrays
from membrane_ctrl.metrology.figure import best_sphere
from membrane_ctrl.metrology.figure.error_bars import LEAST_CELLS
from membrane_ctrl.metrology.numerics import grid_fit, zernike
from membrane_ctrl.model import errors, files, plain_json
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray

REMOVABLE = {"piston": (0,), "tilt": (1, 2), "power": (3,)}  # places in the Fringe set
_CELLS_MAX = 4_000_000
_HEIGHT_MAX_MM = 1e4
_UNEVEN_STEP = 1e-6  # relative difference of steps that are called even
_REMOVABLE_TERMS = 4


@dataclass(frozen=True)
class ExportedMap:
    """A height map on an even grid, to be written.

    Attributes
    ----------
    x_mm, y_mm : (W,), (H,) arrays
        Middle of the cells, rising, the same pitch along both.
    height_mm : (H, W) array
        Rows along y; NaN where not measured.
    radius_mm : float
        Radius of the Fringe terms' disc: about the vertex, the smallest that holds every measured
        cell.
    removed : str
        What was taken off, for people.
    """

    x_mm: FloatArray
    y_mm: FloatArray
    height_mm: FloatArray
    radius_mm: float
    removed: str = "nothing"

    @property
    def pitch_mm(self) -> float:
        """Side of a cell."""
        return float(self.x_mm[-1] - self.x_mm[0]) / (self.x_mm.size - 1)

    @property
    def is_measured(self) -> BoolArray:
        """Cells with a height."""
        return np.isfinite(self.height_mm)

    def top_down(self, counts_per_mm: float, missing: int) -> IntArray:
        """Return the heights as whole numbers, first row at +y.

        Parameters
        ----------
        counts_per_mm : float
            Counts of one mm.
        missing : int
            Stands for cells that were not measured.

        Returns
        -------
        (rows, columns) int64 array
        """
        counts = np.rint(np.nan_to_num(self.height_mm) * counts_per_mm)
        whole = np.where(self.is_measured, counts, missing)
        return whole[::-1].astype(np.int64)


def read_result(folder: Path) -> tuple[ExportedMap, dict[str, Any]]:
    """The height map and `result.json` of a result folder. Raises InputError."""
    try:
        arrays = read_arrays(folder / "height.npz", ("x_mm", "y_mm", "h_mm"), _CELLS_MAX)
        table = plain_json.loads(files.read_text(folder / "result.json"))
    except OSError as error:
        raise errors.InputError(
            f"{error.filename or folder}: {errors.os_reason(error)}: is it a result?"
        ) from None
    except ValueError as error:
        raise errors.InputError(f"{folder}: not a usable result: {error}") from None
    x_mm, y_mm, height_mm = arrays
    _check_map(folder / "height.npz", x_mm, y_mm, height_mm)
    radius_mm = np.where(np.isfinite(height_mm), np.hypot(x_mm, y_mm[:, None]), 0)
    seen = ExportedMap(x_mm, y_mm, height_mm, float(np.max(radius_mm)))
    return seen, table if isinstance(table, dict) else {}


def _check_map(where: Path, x_mm: FloatArray, y_mm: FloatArray, height_mm: FloatArray) -> None:
    """Raise InputError for a map of another shape, uneven steps, few cells or large heights."""
    # A grid of at least 2 x 2 cells.
    is_grid = x_mm.ndim == 1 and y_mm.ndim == 1 and height_mm.shape == (y_mm.size, x_mm.size)
    if not is_grid or min(height_mm.shape) < 2:
        raise errors.InputError(f"{where}: h_mm has not the shape of y_mm and x_mm, at least 2 x 2")

    # Even steps, the same along both axes.
    steps = np.concatenate([np.diff(x_mm), np.diff(y_mm)])
    is_rising = np.isfinite(steps).all() and steps.min() > 0
    if not is_rising or np.ptp(steps) > _UNEVEN_STEP * steps.max():
        raise errors.InputError(f"{where}: x_mm and y_mm must rise in even steps of one size")

    # Enough cells, and heights that a mirror may have.
    measured = np.isfinite(height_mm)
    cells = np.count_nonzero(measured)
    if cells < LEAST_CELLS:
        raise errors.InputError(f"{where}: has {cells} measured cells, too few for a figure")
    largest_mm = np.max(np.abs(np.where(measured, height_mm, 0)))
    if largest_mm > _HEIGHT_MAX_MM or np.isinf(height_mm).any():
        raise errors.InputError(f"{where}: h_mm has heights beyond {_HEIGHT_MAX_MM:g} mm")


def fit_fringe_terms(seen: ExportedMap, terms: int) -> grid_fit.GridFit:
    """Prepare the fit of Fringe Zernike terms to the measured cells.

    Parameters
    ----------
    seen : ExportedMap
        The map.
    terms : int
        How many, from the first.
    """
    orders = [zernike.fringe_set_orders(j + 1) for j in range(terms)]
    x = seen.x_mm / seen.radius_mm
    y = seen.y_mm / seen.radius_mm
    return grid_fit.GridFit(x, seen.is_measured, orders, y)


def remove_parts(seen: ExportedMap, names: list[str]) -> ExportedMap:
    """Return the map without some parts.

    Piston, tilt and power are fitted together; what is not named stays. `sphere` leaves the
    deviation along the best sphere's normal, and then the other parts of that.

    Parameters
    ----------
    seen : ExportedMap
        The map.
    names : list of str
        Keys of `REMOVABLE`, or "sphere".
    """
    # The best sphere first: the deviation is along its normal.
    height = seen.height_mm
    measured = seen.is_measured
    if "sphere" in names:
        rows, columns = np.nonzero(measured)
        points = np.stack([seen.x_mm[columns], seen.y_mm[rows], height[measured]])
        height = np.full(height.shape, np.nan)
        height[measured] = best_sphere.best_sphere(points).deviation(points)[0]

    # All removable terms are fitted together, since over a part of the disc they are not
    # independent; only the named ones are subtracted.
    places = [place for name in names for place in REMOVABLE.get(name, ())]
    if places:
        fit = fit_fringe_terms(seen, _REMOVABLE_TERMS)
        coefficients = np.zeros(_REMOVABLE_TERMS)
        coefficients[places] = fit.coefficients(height)[places]
        height = height - fit.values(coefficients)
    return ExportedMap(seen.x_mm, seen.y_mm, height, seen.radius_mm, ", ".join(names) or "nothing")
