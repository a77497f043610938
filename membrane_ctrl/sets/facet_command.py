"""`measure` of a SOFAST file: are its frames what they should be? Slopes need the poses that its own tool finds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from membrane_ctrl.errors import Exit, InputError
from membrane_ctrl.metrology.series_integrity import SeriesFlag, check_series
from membrane_ctrl.metrology.sofast import SofastMeasurement, read_measurement
from membrane_ctrl.metrology.sofast_facet import lit_pixels, series_of

_LEAST_PIXELS = 200  # fewer tell nothing of a frame


def facet_command(path: Path, as_json: bool) -> int:
    """Check the frames and say what was found. Returns the exit code; raises InputError for what is no such file."""
    try:
        measurement = read_measurement(path)
    except (ValueError, OSError, ImportError) as error:
        raise InputError(str(error)) from None
    mask = lit_pixels(measurement)
    if np.count_nonzero(mask) < _LEAST_PIXELS:
        raise InputError(f"{path}: only {np.count_nonzero(mask)} pixels see fringes")
    found = check_series(series_of(measurement, mask), measurement.black[mask], measurement.white[mask])
    flagged = [{"file": _name(measurement, flag), "reason": flag.reason} for flag in found.flags]
    table = {
        "schema": "membrane-frames/1",
        "quality": {"verdict": found.verdict, "reason": found.reason, "flagged_frames": flagged},
        "pixels": int(np.count_nonzero(mask)),
    }
    lines = [f"verdict   {found.verdict}{': ' + found.reason if found.reason else ''}"]
    lines += [f"flagged   {item['file']}: {item['reason']}" for item in flagged]
    print(json.dumps(table) if as_json else "\n".join(lines))
    return int(Exit.REJECTED if found.verdict == "rejected" else Exit.DONE)


def _name(measurement: SofastMeasurement, flag: SeriesFlag) -> str:
    """For a person: axis, periods a screen, step from 0."""
    if flag.axis in ("white", "black"):
        return flag.axis
    periods = measurement.periods_x if flag.axis == "x" else measurement.periods_y
    return f"{flag.axis}, {periods[flag.index]:g} periods, step {flag.step}"
