"""Pictures of a stability run, and its Rerun recording."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from matplotlib.figure import Figure

from membrane_ctrl.measure.matplotlib_sheet import show_map
from membrane_ctrl.measure.rerun_recording import log_pictures, open_recording
from membrane_ctrl.measure.result_files import write_picture
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.colours import DIVERGING_MAP, SEQUENTIAL_MAP
from membrane_ctrl.model.zernike_terms import zernike_labels


def draw_uncertainty(
    path: Path, axis_mm: FloatArray, height_um: FloatArray, rmse_um: FloatArray, pair: bool
) -> None:
    """Draw the height, or its change, beside its RMSE.

    Parameters
    ----------
    path : Path
        Picture to write.
    axis_mm : (n,) array
        Coordinates of the map's columns and rows.
    height_um, rmse_um : (n, n) arrays
        The maps.
    pair : bool
        The height is a change between two sets.
    """
    figure = Figure(figsize=(11, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    if pair:
        show_map(left, "change of height (µm)", axis_mm, height_um, DIVERGING_MAP, even=True)
    else:
        show_map(left, "height (mm)", axis_mm, height_um / 1e3, SEQUENTIAL_MAP)
    show_map(right, f"RMSE (µm), mean {np.nanmean(rmse_um):.3g}", axis_mm, rmse_um, "magma")
    write_picture(path, figure)


def draw_stability(
    path: Path,
    axis_mm: FloatArray,
    sd_um: FloatArray,
    time_s: FloatArray,
    points: Mapping[str, tuple[float, float]],
    heights_um: FloatArray,
) -> None:
    """Draw the paper's figure: heights of the points over time, and the map of standard deviations.

    Parameters
    ----------
    path : Path
        The picture's file.
    axis_mm : (n,) array
        Of the map, in x and y.
    sd_um : (n, n) array
        Standard deviation of the height; NaN outside the area.
    time_s : (sets,) array
    points : mapping of str to (float, float)
        Name and place of each point.
    heights_um : (sets, points) array
    """
    figure = Figure(figsize=(12, 2.2 * max(2, len(points))), layout="constrained")
    grid = figure.add_gridspec(len(points), 2, width_ratios=(1.4, 1))

    # On the left, each point over time.
    for k, name in enumerate(points):
        axes = figure.add_subplot(grid[k, 0])
        change = heights_um[:, k] - heights_um[:, k].mean()
        axes.plot(time_s, change, ".-", markersize=3, linewidth=0.7)
        axes.set(ylabel=f"{name} (µm)", xlabel="time (s)" if k == len(points) - 1 else "")

    # On the right, the map of the standard deviation with the points.
    shown = figure.add_subplot(grid[:, 1])
    show_map(shown, f"SD (µm), mean {np.nanmean(sd_um):.3g}", axis_mm, sd_um, "magma")
    for name, (x, y) in points.items():
        shown.plot(x, y, "o", color="white", markeredgecolor="black")
        frame = {
            "boxstyle": "round,pad=0.15",
            "facecolor": "black",
            "alpha": 0.6,
        }  # readable on any colour
        shown.annotate(
            name, (x, y), xytext=(7, 7), textcoords="offset points", color="white", bbox=frame
        )
    write_picture(path, figure)


def draw_zernike(path: Path, time_s: FloatArray, coeffs_um: FloatArray) -> None:
    """Draw how the Zernike terms change from their means: the eight that move most, by Noll index.

    Parameters
    ----------
    path : Path
        The picture to write.
    time_s : (sets,) array
        Times of the sets.
    coeffs_um : (sets, terms) array
        Zernike terms, RMS.
    """
    change = coeffs_um - coeffs_um.mean(axis=0)
    figure = Figure(figsize=(10, 5), layout="constrained")
    axes = figure.subplots()
    for j in 1 + np.argsort(-change[:, 1:].std(axis=0))[:8]:
        axes.plot(time_s, change[:, j], linewidth=0.9, label=f"Z{j + 1}")
    axes.set(xlabel="time (s)", ylabel="change (µm RMS)", title="Zernike terms that move most")
    axes.legend(loc="best", ncols=4)
    write_picture(path, figure)


def draw_pairs(
    path: Path, axis_mm: FloatArray, maps: Mapping[float, tuple[FloatArray, FloatArray]]
) -> None:
    """Draw pairs of sets: the change of height beside its RMSE.

    Parameters
    ----------
    path : Path
        The picture to write.
    axis_mm : (m,) array
        Places of the maps' rows and columns.
    maps : mapping of two (m, m) arrays
        Change of height and its RMSE in µm, by the lag of the pair in s.
    """
    figure = Figure(figsize=(11, 4.6 * len(maps)), layout="constrained")
    axes = figure.subplots(len(maps), 2, squeeze=False)
    for row, (lag_s, (change_um, rmse_um)) in zip(axes, maps.items(), strict=True):
        show_map(
            row[0],
            f"change over {lag_s / 60:g} min (µm)",
            axis_mm,
            change_um,
            DIVERGING_MAP,
            even=True,
        )
        show_map(row[1], f"RMSE (µm), mean {np.nanmean(rmse_um):.3g}", axis_mm, rmse_um, "magma")
    write_picture(path, figure)


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
    """Write a stability run as a Rerun recording.

    Parameters
    ----------
    path : Path
        The file (.rrd), replaced if it exists.
    points : sequence of str
        Names of the followed points.
    time_s : (n,) array
        Time of each set with a figure.
    heights_um, coeffs_um : (n, points), (n, terms) arrays
        Shown relative to their means, without piston.
    sd_um : (m, m) array
        Map of standard deviations, rows along y, NaN outside.
    lines : sequence of str
        The result as lines of text.
    pictures : sequence of Path
        PNG files.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    terms = zernike_labels(first=2)
    with open_recording(path, "membrane_ctrl_stability", _make_blueprint(pictures)) as recording:
        recording.log("stability/report", rr.TextDocument("\n".join(lines)), static=True)
        # row 0 of a picture is at the top, i.e. at +y
        sd = rr.Tensor(sd_um[::-1].astype(np.float32), dim_names=["y", "x"])
        recording.log("stability/sd_um", sd, static=True)
        for entity, names, values in (
            ("points_um", points, heights_um),
            ("zernike_um", terms, coeffs_um[:, 1:]),
        ):
            recording.log(f"stability/{entity}", rr.SeriesLines(names=list(names)), static=True)
            change = rr.Scalars.columns(scalars=values - values.mean(axis=0))
            recording.send_columns(
                f"stability/{entity}", [rr.TimeColumn("run_time", duration=time_s)], change
            )
        log_pictures(recording, "stability/pictures", pictures)


def _make_blueprint(pictures: Sequence[Path]) -> rrb.Blueprint:
    """Show plots over the whole run; the default is a minute around the cursor."""
    always = rr.TimeRangeBoundary.infinite()
    axis = rrb.TimeAxis(view_range=rr.TimeRange(start=always, end=always))
    plots = (
        rrb.TimeSeriesView(origin=f"stability/{name}", name=title, axis_x=axis)
        for name, title in (
            ("points_um", "height at the points (µm)"),
            ("zernike_um", "Zernike terms (µm RMS)"),
        )
    )
    maps = (
        rrb.TensorView(origin="stability/sd_um", name="SD (µm)"),
        rrb.TextDocumentView(origin="stability/report"),
    )
    drawn = [
        rrb.Spatial2DView(origin=f"stability/pictures/{file.stem}", name=file.stem)
        for file in pictures
    ]
    columns = (rrb.Vertical(*plots), rrb.Vertical(*maps), rrb.Tabs(*drawn))
    return rrb.Blueprint(rrb.Horizontal(*columns), collapse_panels=True)
