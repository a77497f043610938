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
        """Heights as whole numbers, first row at +y."""
        whole = np.where(
            self.is_measured, np.rint(np.nan_to_num(self.height_mm) * counts_per_mm), missing
        )
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
    where, (x, y, height) = folder / "height.npz", arrays
    if (
        height.ndim != 2
        or height.shape != (y.size, x.size)
        or x.ndim != 1
        or y.ndim != 1
        or min(height.shape) < 2
    ):
        raise errors.InputError(f"{where}: h_mm has not the shape of y_mm and x_mm, at least 2 x 2")
    steps = np.concatenate([np.diff(x), np.diff(y)])
    if not np.isfinite(steps).all() or steps.min() <= 0 or np.ptp(steps) > 1e-6 * steps.max():
        raise errors.InputError(f"{where}: x_mm and y_mm must rise in even steps of one size")
    measured = np.isfinite(height)
    if np.count_nonzero(measured) < LEAST_CELLS:
        raise errors.InputError(
            f"{where}: has {np.count_nonzero(measured)} measured cells, too few for a figure"
        )
    if (
        not np.nanmax(np.abs(np.where(measured, height, 0))) <= _HEIGHT_MAX_MM
        or np.isinf(height).any()
    ):
        raise errors.InputError(f"{where}: h_mm has heights beyond {_HEIGHT_MAX_MM:g} mm")
    radius = float(np.max(np.where(measured, np.hypot(x, y[:, None]), 0)))
    return ExportedMap(x, y, height, radius), table if isinstance(table, dict) else {}


def fit_fringe_terms(seen: ExportedMap, terms: int) -> grid_fit.GridFit:
    axes = seen.x_mm / seen.radius_mm, seen.y_mm / seen.radius_mm
    return grid_fit.GridFit(
        axes[0], seen.is_measured, [zernike.fringe_set_orders(j + 1) for j in range(terms)], axes[1]
    )


def remove_parts(seen: ExportedMap, names: list[str]) -> ExportedMap:
    """The map without the named parts.

    Piston, tilt and power are fitted together; what is not named stays. `sphere` leaves the
    deviation along the best sphere's normal, and then the other parts of that.
    """
    height, measured = seen.height_mm, seen.is_measured
    if "sphere" in names:
        rows, columns = np.nonzero(measured)
        points = np.stack([seen.x_mm[columns], seen.y_mm[rows], height[measured]])
        height = np.full(height.shape, np.nan)
        height[measured] = best_sphere.best_sphere(points).deviation(points)[0]
    places = [place for name in names for place in REMOVABLE.get(name, ())]
    if places:
        fit = fit_fringe_terms(seen, 4)
        coefficients = np.zeros(4)
        coefficients[places] = fit.coefficients(height)[places]
        height = height - fit.values(coefficients)
    return ExportedMap(seen.x_mm, seen.y_mm, height, seen.radius_mm, ", ".join(names) or "nothing")
