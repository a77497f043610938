"""`measure` of a SOFAST file: checks its frames only.

Slopes need the poses that SOFAST itself finds.
"""

import json
from pathlib import Path

import numpy as np

from membrane_ctrl.measure.sofast_file import (
    SofastMeasurement,
    axis_series,
    lit_pixels,
    read_sofast_file,
)
from membrane_ctrl.metrology.frame_checks.frequency_series import SeriesFlag, check_series
from membrane_ctrl.model import errors

_LEAST_PIXELS = 200  # fewer cannot judge a frame


def check_sofast_file(path: Path, as_json: bool) -> int:
    """Check the frames of a SOFAST measurement and print the verdict.

    Parameters
    ----------
    path : Path
        The HDF5 file.
    as_json : bool
        Print one object (schema membrane-frames/1) instead of lines of text.

    Returns
    -------
    int
        `Exit.REJECTED` if the frames are unusable, else `Exit.DONE`.

    Raises
    ------
    InputError
        It is not a SOFAST file, h5py is not installed, or hardly a pixel sees fringes.
    """
    try:
        measurement = read_sofast_file(path)
    except (ValueError, OSError) as error:
        raise errors.InputError(str(error)) from None

    # Pixels that see fringes, and what their frames contradict.
    mask = lit_pixels(measurement)
    if np.count_nonzero(mask) < _LEAST_PIXELS:
        raise errors.InputError(f"{path}: only {np.count_nonzero(mask)} pixels see fringes")
    found = check_series(
        axis_series(measurement, mask), measurement.black[mask], measurement.white[mask]
    )

    # The verdict with the flagged frames by name.
    flagged = [
        {"file": _frame_name(measurement, flag), "reason": flag.reason} for flag in found.flags
    ]
    table = {
        "schema": "membrane-frames/1",
        "quality": {"verdict": found.verdict, "reason": found.reason, "flagged_frames": flagged},
        "pixels": int(np.count_nonzero(mask)),
    }
    lines = [f"verdict   {found.verdict}{': ' + found.reason if found.reason else ''}"]
    lines += [f"flagged   {item['file']}: {item['reason']}" for item in flagged]
    print(json.dumps(table) if as_json else "\n".join(lines))
    return int(errors.Exit.REJECTED if found.verdict == "rejected" else errors.Exit.DONE)


def _frame_name(measurement: SofastMeasurement, flag: SeriesFlag) -> str:
    """Name for people: axis, periods per screen, step from 0."""
    if flag.axis in ("white", "black"):
        return flag.axis
    periods = measurement.periods_x if flag.axis == "x" else measurement.periods_y
    return f"{flag.axis}, {periods[flag.index]:g} periods, step {flag.step}"
