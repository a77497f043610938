"""Pictures of a measurement, as PNG files beside the result."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from membrane_ctrl.metrology.full import FullResult
from membrane_ctrl.metrology.outline import Outline
from membrane_ctrl.metrology.radial import RadialProfile
from membrane_ctrl.sets.error_bars import ErrorBars
from membrane_ctrl.sets.measurement import Measurement
from membrane_ctrl.sets.result_files import write_figure
from membrane_ctrl.terminal import plain

FloatArray = NDArray[np.float64]

_SHOWN_PX = 600  # a side, of maps of pixels


def draw_all(
    out: Path,
    measurement: Measurement,
    light: FloatArray,
    profile: RadialProfile | None,
    outline: Outline | None,
    bars: ErrorBars | None,
) -> list[Path]:
    """Draw everything there is to draw; returns the files.

    Parameters
    ----------
    light : (H, W) array
        The scene, of any size: white, or the mean of the fringes.
    """
    files = [write_figure(out / "frames.png", _frames(measurement))]
    full = measurement.full
    if full is None or profile is None:
        return files
    axis, height = full.grid.axis_mm, full.height_mm()
    residual_um = 1e3 * full.residual_mm
    files += [
        write_figure(out / "sag.png", _map("height (mm)", axis, height, "viridis")),
        write_figure(out / "residual.png", _map("height over the fit (um)", axis, residual_um, "RdBu_r", even=True)),
        write_figure(out / "slopes.png", _slopes(full)),
        write_figure(out / "modulation.png", _modulation(measurement, full, light, outline)),
        write_figure(out / "profile.png", _profile(profile)),
        write_figure(out / "convergence.png", _convergence(full)),
    ]
    return files if bars is None else [*files, write_figure(out / "uncertainty.png", _uncertainty(bars))]


def _uncertainty(bars: ErrorBars) -> Figure:
    """1 sigma from noise and, if its spread is one, from the geometry."""
    figure = Figure(figsize=(12, 4.8), layout="constrained")
    of_noise, of_geometry = bars.maps_um()
    left, right = figure.subplots(1, 2)
    _image(left, "1 sigma of pixel noise (nm)", bars.grid.axis_mm, 1e3 * of_noise, "magma")
    if np.isfinite(of_geometry).any():
        _image(right, "1 sigma of the geometry (um)", bars.grid.axis_mm, of_geometry, "magma")
    return figure


def _map(title: str, axis: FloatArray, values: FloatArray, colours: str, even: bool = False) -> Figure:
    figure = Figure(figsize=(6.4, 5.4), layout="constrained")
    _image(figure.subplots(), title, axis, values, colours, even)
    return figure


def _image(axes: Any, title: str, axis: FloatArray, values: FloatArray, colours: str, even: bool = False) -> None:
    low, high = np.nanpercentile(values, [0.5, 99.5])
    if even:
        high = max(abs(low), abs(high))
        low = -high
    extent = (axis[0], axis[-1], axis[0], axis[-1])
    shown = axes.imshow(values, origin="lower", extent=extent, cmap=colours, vmin=low, vmax=high)
    axes.set(title=title, xlabel="x (mm)", ylabel="y (mm)")
    axes.figure.colorbar(shown, ax=axes, shrink=0.85)


def _slopes(full: FullResult) -> Figure:
    """Slopes as measured, and what the fit leaves of them."""
    figure = Figure(figsize=(11, 9), layout="constrained")
    axes = figure.subplots(2, 2)
    grid = full.grid
    every = max(1, full.index.size // _SHOWN_PX**2)
    x, y, gx, gy = full.field[:4, ::every]
    for place, slope, name in ((axes[0, 0], gx, "dh/dx"), (axes[0, 1], gy, "dh/dy")):
        points = place.scatter(x, y, c=1e3 * slope, s=1, cmap="RdBu_r", rasterized=True)
        place.set(title=f"{name} measured (mrad)", xlabel="x (mm)", ylabel="y (mm)", aspect="equal")
        figure.colorbar(points, ax=place, shrink=0.85)
    for place, slope, name in ((axes[1, 0], grid.slope_x, "dh/dx"), (axes[1, 1], grid.slope_y, "dh/dy")):
        left = np.where(grid.count > 0, 1e6 * slope, np.nan)
        _image(place, f"{name} less the fit (urad)", grid.axis_mm, left, "RdBu_r", even=True)
    return figure


def _modulation(measurement: Measurement, full: FullResult, light: FloatArray, outline: Outline | None) -> Figure:
    """Fringe amplitude in the camera's picture, beside the light with the rim found in it."""
    camera = measurement.head.optics.camera
    swing = np.full(camera.width_px * camera.height_px, np.nan, np.float32)
    swing[full.index] = full.swing_adu
    step = max(1, camera.height_px // _SHOWN_PX)
    figure = Figure(figsize=(12, 5), layout="constrained")
    left, right = figure.subplots(1, 2)
    extent = (-0.5, camera.width_px - 0.5, camera.height_px - 0.5, -0.5)
    picture = swing.reshape(camera.height_px, camera.width_px)[::step, ::step]
    figure.colorbar(left.imshow(picture, extent=extent), ax=left, shrink=0.85)
    left.set(title="fringe amplitude (ADU)", xlabel="column", ylabel="row")
    right.imshow(light, extent=extent, cmap="gray")
    right.set(title="light and rim", xlabel="column", ylabel="row")
    if outline is not None:
        right.plot(*outline.rim_px, ".", markersize=2, color="tab:orange")
    return figure


def _frames(measurement: Measurement) -> Figure:
    """One tile a frame, the flagged ones with their reason."""
    names = [pattern.name for pattern in measurement.head.patterns]
    reasons = {flag.frame: plain(flag.reason) for flag in measurement.flags}
    figure = Figure(figsize=(9, 0.28 * len(names) + 1.2), layout="constrained")
    axes = figure.subplots()
    colours = ["tab:red" if k in reasons else "tab:green" for k in range(len(names))]
    axes.barh(range(len(names)), 1.0, color=colours, alpha=0.5)
    for k in range(len(names)):
        axes.text(0.02, k, reasons.get(k, "as predicted"), va="center", fontsize=8, parse_math=False)
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set(xticks=[], xlim=(0, 1))
    axes.set_title(plain(f"{measurement.verdict} {measurement.reason}")[:110], parse_math=False)
    return figure


def _profile(profile: RadialProfile) -> Figure:
    figure = Figure(figsize=(7, 6), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    upper.fill_between(profile.radius_mm, profile.low_mm, profile.high_mm, alpha=0.4, label="95 % of the ring")
    upper.plot(profile.radius_mm, profile.mean_mm, label="measured, mean over azimuth")
    upper.plot(profile.radius_mm, profile.hencky_mm, "--", label=f"Hencky, sag {profile.sag_mm:.3f} mm")
    upper.set(ylabel="height (mm)", title=f"radial profile; pressure equivalent {profile.pressure_pa:.0f} Pa")
    upper.legend()
    low, mean, high = (1e3 * (row - profile.hencky_mm) for row in (profile.low_mm, profile.mean_mm, profile.high_mm))
    lower.fill_between(profile.radius_mm, low, high, alpha=0.4)
    lower.plot(profile.radius_mm, mean)
    lower.set(xlabel="radius (mm)", ylabel="less Hencky (um)")
    return figure


def _convergence(full: FullResult) -> Figure:
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    changes = full.fit.changes_mm
    axes.semilogy(range(1, len(changes) + 1), np.maximum(changes, 1e-16), "o-")
    axes.axhline(1e-6, linestyle="--", color="tab:red")
    axes.set(xlabel="iteration", ylabel="largest change of height (mm)", title="bins first, then every pixel")
    return figure
