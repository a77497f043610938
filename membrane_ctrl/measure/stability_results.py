"""The table of a stability run, one line a set: written, read back, and summarised in lines."""

import csv
import math
from collections.abc import Iterable, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

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
    """Read times (n,), point heights (n, points) and coefficients (n, terms) of the sets with a
    figure.

    At most about `most` of them, evenly spaced, however long the run.
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


def format_stability(table: Mapping[str, Any]) -> list[str]:
    """The table of `stability.json` as lines of text."""
    sets = table["sets"]
    sd_um = table["sd_um"]
    rmse_um = table["rmse_um"]
    out = [
        f"sets      {sets['used']} of {sets['found']} used, {sets['degraded']} degraded, "
        f"{sets['bad']} bad",
        f"SD        mean {sd_um['mean']:.4g} µm, largest {sd_um['max']:.4g} µm",
    ]
    first = table["first_set"]
    if first is not None:
        known = first["geometry_known"]
        reason = ""
        if first["reason"]:
            reason = f": {first['reason']}"
        out.append(f"first set {first['verdict']}{reason}")
        out.append(f"geometry  {known['state']}: {known['source']}")
    out += [
        f"point {name:3s} ({p['x_mm']:.0f}, {p['y_mm']:.0f}) mm: SD {p['sd_um']:.4g} µm, "
        f"peak to peak {p['peak_to_peak_um']:.4g} µm"
        for name, p in table["points"].items()
    ]
    out += [_pair_line(pair) for pair in table["pairs"]]
    return [
        *out,
        f"height    RMSE {rmse_um['mean']:.4g} µm, shared by all sets "
        f"({table['geometry']['source']})",
    ]


def _pair_line(pair: dict[str, Any]) -> str:
    lag = f"{pair['lag_s'] / 60:g} min"
    if not pair["count"]:
        return f"{lag:9s} no pairs"
    change_um = pair["change_rms_um"]["mean"]
    rmse_um = pair["rmse_um"]["mean"]
    return (
        f"{lag:9s} {pair['count']} pairs: change {change_um:.4g} µm RMS, RMSE {rmse_um:.4g} µm on "
        "average"
    )
