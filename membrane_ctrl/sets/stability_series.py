"""The table of a stability run, one line a set, written as the sets pass by and read back thinned for pictures."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.recording.atomic import fresh_text

FloatArray = NDArray[np.float64]

_HEAD = ("set", "verdict", "reason")
_NUMBERS = ("time_s", "displacement_um", "sag_um", "slope_residual_urad", "rmse_mean_um")
_ZERNIKE = tuple(f"z{j}_um" for j in range(1, 37))


class SeriesFile:
    """Writes `series.csv`; a set that gave no figure has a line without numbers.

    Parameters
    ----------
    path : Path
        Overwritten.
    points : sequence of str
        Names of the points whose height is followed.
    """

    def __init__(self, path: Path, points: Sequence[str]) -> None:
        self._file = fresh_text(path)
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._writer.writerow((*_HEAD, *_NUMBERS, *(f"{name}_um" for name in points), *_ZERNIKE))

    def __enter__(self) -> SeriesFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        self._file.close()

    def add(
        self,
        name: str,
        verdict: str,
        reason: str,
        numbers: Sequence[float] = (),
        points_um: Sequence[float] = (),
        coeffs_um: Sequence[float] = (),
    ) -> None:
        """One line; `numbers` are time_s, displacement_um, sag_um, slope_residual_urad, rmse_mean_um."""
        cells = [f"{value:.12g}" for value in (*numbers, *points_um, *coeffs_um)]
        self._writer.writerow((name, verdict, reason, *cells))


def read_series(path: Path, points: int, most: int = 4000) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times (n,), heights of the points (n, points) and coefficients (n, 36) of the sets that gave a figure.

    At most about `most` of them, evenly chosen, however long the run.
    """
    with path.open(newline="", encoding="utf-8") as file:
        stride = max(1, -(-(sum(1 for _ in file) - 1) // most))
        file.seek(0)
        rows = csv.reader(file)
        next(rows)
        good = (row for row in rows if len(row) > len(_HEAD))
        kept = [[float(cell) for cell in row[len(_HEAD) :]] for k, row in enumerate(good) if k % stride == 0]
    table = np.array(kept).reshape(len(kept), len(_NUMBERS) + points + len(_ZERNIKE))
    first = len(_NUMBERS)
    return table[:, 0], table[:, first : first + points], table[:, first + points :]
