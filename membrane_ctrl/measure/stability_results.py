"""The series of a stability run, one line a set: its columns, and how it is read back."""

import csv
import math
from collections.abc import Iterable
from itertools import islice
from pathlib import Path

import numpy as np

from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import zernike_columns

_HEAD = ("set", "verdict", "reason")
_NUMBERS = ("time_s", "displacement_um", "sag_um", "slope_residual_urad", "rmse_mean_um")
_ZERNIKE = tuple(zernike_columns())


def series_head(points: Iterable[str]) -> tuple[str, ...]:
    """Columns of `series.csv`, including the tracked points;
    a bad set fills only the first three.
    """
    return (*_HEAD, *_NUMBERS, *(f"{name}_um" for name in points), *_ZERNIKE)


def read_series(
    path: Path, points: int, most: int = 4000
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Read the sets with a figure from the series of a stability run.

    Parameters
    ----------
    path : Path
        The file.
    points : int
        Number of its points.
    most : int
        Read about this many sets at most, evenly spaced.

    Returns
    -------
    time_s : (n,) array
    heights_um : (n, points) array
    coeffs_um : (n, terms) array
    """
    with path.open(newline="", encoding="utf-8") as file:
        # Every stride-th row, so that at most `most` are left; the first line is the head.
        count = sum(1 for _ in file) - 1
        stride = max(1, math.ceil(count / most))
        file.seek(0)
        rows = csv.reader(file)
        next(rows)
        good = (row for row in rows if len(row) > len(_HEAD))
        some = islice(good, 0, None, stride)
        kept = [[float(cell) for cell in row[len(_HEAD) :]] for row in some]
    table = np.array(kept).reshape(len(kept), len(_NUMBERS) + points + len(_ZERNIKE))
    first_point = len(_NUMBERS)
    first_term = first_point + points
    return table[:, 0], table[:, first_point:first_term], table[:, first_term:]
