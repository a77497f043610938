"""A stability run as a Rerun recording: heights and terms in time, the map of standard deviations, the pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from membrane_ctrl.sets.result_recording import log_pictures, result_recording

FloatArray = NDArray[np.float64]


def log_stability(
    path: Path,
    points: Sequence[str],
    time_s: FloatArray,
    heights_um: FloatArray,
    coeffs_um: FloatArray,
    sd_um: FloatArray,
    lines: Sequence[str],
    pictures: Sequence[Path],
) -> None:
    """Write a recording.

    Parameters
    ----------
    path : Path
        The `.rrd` file, overwritten.
    points : names
        Of the heights that were followed.
    time_s : (n,) array
        Of the sets.
    heights_um : (n, points) array
        Shown against their means.
    coeffs_um : (n, 36) array
        Zernike terms; shown against their means, piston left out.
    sd_um : (m, m) array
        Map of standard deviations, rows along y, NaN outside.
    lines, pictures
        The report, and what was drawn.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    terms = [f"Z{j}" for j in range(2, 37)]
    with result_recording(path, "membrane_ctrl_stability", _blueprint(pictures)) as recording:
        recording.log("stability/report", rr.TextDocument("\n".join(lines)), static=True)
        # row 0 of a picture is on top, that is at +y
        sd = rr.Tensor(sd_um[::-1].astype(np.float32), dim_names=["y", "x"])
        recording.log("stability/sd_um", sd, static=True)
        for entity, names, values in (("points_um", points, heights_um), ("zernike_um", terms, coeffs_um[:, 1:])):
            recording.log(f"stability/{entity}", rr.SeriesLines(names=list(names)), static=True)
            change = rr.Scalars.columns(scalars=values - values.mean(axis=0))
            recording.send_columns(f"stability/{entity}", [rr.TimeColumn("run_time", duration=time_s)], change)
        log_pictures(recording, "stability/pictures", pictures)


def _blueprint(pictures: Sequence[Path]) -> rrb.Blueprint:
    """Plots over the whole run: without it they show a minute about the cursor."""
    axis = rrb.TimeAxis(
        view_range=rr.TimeRange(start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite())
    )
    plots = (
        rrb.TimeSeriesView(origin=f"stability/{name}", name=title, axis_x=axis)
        for name, title in (("points_um", "height at the points (um)"), ("zernike_um", "Zernike terms (um RMS)"))
    )
    maps = (rrb.TensorView(origin="stability/sd_um", name="SD (um)"), rrb.TextDocumentView(origin="stability/report"))
    drawn = [rrb.Spatial2DView(origin=f"stability/pictures/{file.stem}", name=file.stem) for file in pictures]
    columns = (rrb.Vertical(*plots), rrb.Vertical(*maps), rrb.Tabs(*drawn))
    return rrb.Blueprint(rrb.Horizontal(*columns), collapse_panels=True)
