"""Pictures of uncertainty and of stability, as PNG files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from membrane_ctrl.sets.result_files import write_figure

FloatArray = NDArray[np.float64]


def draw_uncertainty(path: Path, axis_mm: FloatArray, height_um: FloatArray, rmse_um: FloatArray, pair: bool) -> None:
    """Height, or its change, beside its RMSE; (n, n) maps."""
    figure = Figure(figsize=(11, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    if pair:
        _image(left, "change of height (um)", axis_mm, height_um, "RdBu_r", even=True)
    else:
        _image(left, "height (mm)", axis_mm, height_um / 1e3, "viridis")
    _image(right, f"RMSE (um), mean {np.nanmean(rmse_um):.3g}", axis_mm, rmse_um, "magma")
    write_figure(path, figure)


def draw_stability(
    path: Path,
    axis_mm: FloatArray,
    sd_um: FloatArray,
    time_s: FloatArray,
    points: Mapping[str, tuple[float, float]],
    heights_um: FloatArray,
) -> None:
    """The paper's figure: height at the named points (sets, points) in time, and the map of standard deviations."""
    figure = Figure(figsize=(12, 2.2 * max(2, len(points))), layout="constrained")
    grid = figure.add_gridspec(len(points), 2, width_ratios=(1.4, 1))
    for k, name in enumerate(points):
        axes = figure.add_subplot(grid[k, 0])
        change = heights_um[:, k] - heights_um[:, k].mean()
        axes.plot(time_s, change, ".-", markersize=3, linewidth=0.7)
        axes.set(ylabel=f"{name} (um)", xlabel="time (s)" if k == len(points) - 1 else "")
    shown = figure.add_subplot(grid[:, 1])
    _image(shown, f"SD (um), mean {np.nanmean(sd_um):.3g}", axis_mm, sd_um, "magma")
    for name, (x, y) in points.items():
        shown.plot(x, y, "o", color="white", markeredgecolor="black")
        frame = {"boxstyle": "round,pad=0.15", "facecolor": "black", "alpha": 0.6}  # readable on any colour
        shown.annotate(name, (x, y), xytext=(7, 7), textcoords="offset points", color="white", bbox=frame)
    write_figure(path, figure)


def draw_zernike(path: Path, time_s: FloatArray, coeffs_um: FloatArray) -> None:
    """Changes of the terms (sets, 36) against their means: the eight that move most, named by Noll's index."""
    change = coeffs_um - coeffs_um.mean(axis=0)
    figure = Figure(figsize=(10, 5), layout="constrained")
    axes = figure.subplots()
    for j in 1 + np.argsort(-change[:, 1:].std(axis=0))[:8]:
        axes.plot(time_s, change[:, j], linewidth=0.9, label=f"Z{j + 1}")
    axes.set(xlabel="time (s)", ylabel="change (um RMS)", title="Zernike terms that move most")
    axes.legend(ncols=4)
    write_figure(path, figure)


def draw_pairs(path: Path, axis_mm: FloatArray, maps: Mapping[float, tuple[FloatArray, FloatArray]]) -> None:
    """For each lag in s a pair's change of height beside its RMSE, in um."""
    figure = Figure(figsize=(11, 4.6 * len(maps)), layout="constrained")
    axes = figure.subplots(len(maps), 2, squeeze=False)
    for row, (lag_s, (change_um, rmse_um)) in zip(axes, maps.items(), strict=True):
        _image(row[0], f"change over {lag_s / 60:g} min (um)", axis_mm, change_um, "RdBu_r", even=True)
        _image(row[1], f"RMSE (um), mean {np.nanmean(rmse_um):.3g}", axis_mm, rmse_um, "magma")
    write_figure(path, figure)


def _image(axes: Any, title: str, axis_mm: FloatArray, values: FloatArray, colours: str, even: bool = False) -> None:
    low, high = np.nanpercentile(values, [0.5, 99.5])
    if even:
        high = max(abs(low), abs(high))
        low = -high
    extent = (axis_mm[0], axis_mm[-1], axis_mm[0], axis_mm[-1])
    shown = axes.imshow(values, origin="lower", extent=extent, cmap=colours, vmin=low, vmax=high)
    axes.set(title=title, xlabel="x (mm)", ylabel="y (mm)")
    axes.figure.colorbar(shown, ax=axes, shrink=0.85)
