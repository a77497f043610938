"""Reads the frames of a SOFAST measurement (OpenCSP, Sandia) from HDF5; lengths become mm."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from membrane_ctrl.metrology.frame_checks.frequency_series import AxisSeries
from membrane_ctrl.metrology.phase.phase_steps import compute_phasors, equal_shifts
from membrane_ctrl.model.arrays import BoolArray, FloatArray
from membrane_ctrl.model.files import open_plain
from membrane_ctrl.model.optional import import_optional

SOFAST_STEPS = 4  # SOFAST always takes four
MM_PER_M = 1e3
_ELEMENTS_MAX = 100_000_000  # 24 frames of 4 megapixels; each pixel takes eight bytes in memory
# SOFAST shows cos(2 pi p s - k pi / 2), s from 1 at column 0 to 0 at the last column, and from 1 at
# row 0 to 0 at the last row; its screen coordinates have y the other way round, so the y fraction
# is 1 - s.
SHIFTS_RAD = -equal_shifts(SOFAST_STEPS)
_LIT_SHARE = 0.3  # of the bright pixels' swing


@dataclass(frozen=True)
class SofastMeasurement:
    """Frames of a measurement.

    Attributes
    ----------
    frames_x, frames_y : (F, 4, H, W) arrays
        Fringes that vary along the screen's x and y: frequency, step, row, column.
    periods_x, periods_y : (F,) arrays
        Periods per screen.
    black, white : (H, W) arrays
    distance_mm : float
        Facet's measure point to the screen's origin.
    """

    frames_x: FloatArray
    frames_y: FloatArray
    periods_x: FloatArray
    periods_y: FloatArray
    black: FloatArray
    white: FloatArray
    distance_mm: float


def read_sofast_file(path: Path) -> SofastMeasurement:
    """Read frames and their data. Raises ValueError, FileNotFoundError or InputError with one
    line.
    """
    # What the file contains.
    with open_hdf5(path) as file:
        group = "MeasurementSofastFringe"
        frames = np.moveaxis(read_floats(file, f"{group}/fringe_images"), 2, 0)
        black, white = np.moveaxis(read_floats(file, f"{group}/mask_images"), 2, 0)
        periods_x, periods_y = (
            read_floats(file, f"{group}/fringe_periods_{axis}") for axis in "xy"
        )
        distance_m = float(read_floats(file, f"{group}/dist_optic_screen").item())

    # Its frames, of y and then of x.
    count_y = SOFAST_STEPS * len(periods_y)
    if len(frames) != count_y + SOFAST_STEPS * len(periods_x):
        raise ValueError(
            f"{path}: {group}/fringe_images has {len(frames)} frames, not {SOFAST_STEPS} for "
            "each of "
            f"{len(periods_y)} + {len(periods_x)} frequencies"
        )
    size = black.shape
    return SofastMeasurement(
        frames_x=frames[count_y:].reshape(-1, SOFAST_STEPS, *size),
        frames_y=frames[:count_y].reshape(-1, SOFAST_STEPS, *size),  # y comes first in the file
        periods_x=periods_x,
        periods_y=periods_y,
        black=black,
        white=white,
        distance_mm=distance_m * MM_PER_M,
    )


def open_hdf5(path: Path) -> Any:
    """Open the file with h5py (untyped), an optional extra that only this reader needs."""
    h5py = import_optional("h5py", "sofast", f"{path}, a SOFAST file,")
    try:
        open_plain(path, follow=True).close()  # h5py would wait forever for a pipe without a writer
        return h5py.File(path, "r")
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such file") from None
    except OSError as error:
        raise ValueError(f"{path}: not an HDF5 file ({error})") from None


def read_item(file: Any, name: str) -> Any:
    """Read one data set of the file itself.

    Parameters
    ----------
    file : h5py.File
        An open file; untrusted.
    name : str
        Path of the data set within the file, as `group/name`.

    Returns
    -------
    numpy array or scalar
        As h5py reads it.

    Raises
    ------
    ValueError
        It is missing, damaged, too large, or a link: links could lead to other files.
    """
    import h5py

    try:
        # Each link on the way must be one inside this file.
        parts = name.split("/")
        for end in range(1, len(parts) + 1):
            link = file.get("/".join(parts[:end]), getlink=True)
            if link is None:
                raise ValueError(f"{file.filename}: {name} is missing")
            if not isinstance(link, h5py.HardLink):
                raise ValueError(
                    f"{file.filename}: {name} is a link, and links are not followed here"
                )

        # The item must be a data set of a size that can be read.
        found = file[name]
        if not isinstance(found, h5py.Dataset) or found.is_virtual or found.external:
            raise ValueError(f"{file.filename}: {name} is not a data set of this file")
        if found.size is None or found.size > _ELEMENTS_MAX:
            raise ValueError(
                f"{file.filename}: {name} has {found.shape} elements, too many to read"
            )
        return found[()]
    except (
        OSError,
        RuntimeError,
        KeyError,
        TypeError,
    ) as error:  # HDF5's errors for a damaged file
        raise ValueError(f"{file.filename}: {name} cannot be read ({error})") from None


def read_floats(file: Any, name: str) -> FloatArray:
    """Read one data set as 64-bit floats.

    Parameters
    ----------
    file, name
        As for `read_item`.

    Returns
    -------
    array of float
        In the data set's own shape and unit.

    Raises
    ------
    ValueError
        As `read_item`; also if it holds no numbers.
    """
    try:
        return np.asarray(read_item(file, name), float)
    except TypeError:
        raise ValueError(f"{file.filename}: {name} holds no numbers") from None


def lit_pixels(measurement: SofastMeasurement) -> BoolArray:
    """Pixels (H, W) that see fringes: thresholds the median swing over the series, robust to single
    bad frames.
    """
    series = (*measurement.frames_y, *measurement.frames_x)
    swing = np.median([np.abs(compute_phasors(steps, SHIFTS_RAD)) for steps in series], axis=0)
    return np.asarray(swing > _LIT_SHARE * np.percentile(swing, 95))


def axis_series(measurement: SofastMeasurement, mask: BoolArray) -> tuple[AxisSeries, AxisSeries]:
    """Return the series of both axes at some pixels, in the order of capture: y, then x.

    Parameters
    ----------
    measurement : SofastMeasurement
        The file's frames.
    mask : (rows, columns) bool array
        The pixels.
    """
    return (
        AxisSeries("y", measurement.frames_y[..., mask], measurement.periods_y, SHIFTS_RAD),
        AxisSeries("x", measurement.frames_x[..., mask], measurement.periods_x, SHIFTS_RAD),
    )
