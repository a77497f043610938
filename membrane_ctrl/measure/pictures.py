"""Pictures of a measurement, as PNG files beside the result."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from membrane_ctrl.measure.figure_results import ENERGY_SHARES, MeasuredFigure
from membrane_ctrl.measure.measurement import Measurement
from membrane_ctrl.measure.result_files import write_picture
from membrane_ctrl.measure.results import ErrorBars
from membrane_ctrl.metrology.figure import radial_profile
from membrane_ctrl.metrology.figure.pixel_figure import FullResult
from membrane_ctrl.metrology.figure.star_image import image_star
from membrane_ctrl.metrology.figure.surface_map import SurfaceMap
from membrane_ctrl.metrology.rays import rim_outline
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.colours import DIVERGING_MAP, SEQUENTIAL_MAP
from membrane_ctrl.model.terminal import escape_controls

_SHOWN_PX = 600  # side of pixel maps
_MAP_CELLS = 450  # side of other maps
# Largest value of a map over that of 99 % of it, beyond which a linear scale would hide the rest.
_STEEP = 3.0
_TYPICAL_PERCENTILES = (0.5, 99.5)
_LEAST_SCALE = 1e-12
_STAR_CELLS = 192  # side of the grid that the image of a star is made of
_FAINTEST = 1e-4  # light of the star's image that is drawn, over its brightest
_LARGE_UM = 1000.0  # beyond which its picture counts in millimetres
_STAR_VIEW = 3.0  # half the side of its picture, over the radius with 80 % of the light
_SHOWN_ROWS = 16  # of the budget: further ones add nothing
_LONGEST_TITLE = 110


def draw_measurement(
    out: Path,
    measurement: Measurement,
    light: FloatArray,
    profile: radial_profile.RadialProfile | None,
    outline: rim_outline.Outline | None,
    bars: ErrorBars | None,
    figure: MeasuredFigure | None,
) -> list[Path]:
    """Draw all pictures of a measurement.

    Parameters
    ----------
    out : Path
        Folder of the pictures.
    measurement : Measurement
        The measured set.
    light : (H, W) array
        The white frame, or the fringes' mean; of any size.
    profile, outline, bars, figure
        Further results, as far as there are any.

    Returns
    -------
    list of Path
        The files.
    """
    # A title in a fixed place: matplotlib measures all labels of an axis twice to find a free one.
    with rc_context({"axes.titley": 1.0}):
        drawn = _draw_pictures(measurement, light, profile, outline, bars, figure)
        return [write_picture(out / f"{name}.png", picture) for name, picture in drawn.items()]


def _draw_pictures(
    measurement: Measurement,
    light: FloatArray,
    profile: radial_profile.RadialProfile | None,
    outline: rim_outline.Outline | None,
    bars: ErrorBars | None,
    figure: MeasuredFigure | None,
) -> dict[str, Figure]:
    """All pictures by their names."""
    drawn = {"frames": _draw_frames(measurement)}
    full = measurement.full
    if full is not None and profile is not None:
        axis_mm = full.grid.axis_mm
        residual_um = 1e3 * full.residual_mm
        seen = full.map() if figure is None else figure.seen
        drawn["sag"] = _draw_map("height (mm)", axis_mm, full.height_mm(), SEQUENTIAL_MAP)
        drawn["residual"] = _draw_map(
            "height over the fit (µm)", axis_mm, residual_um, DIVERGING_MAP, even=True
        )
        drawn["slopes"] = _draw_slopes(full, seen)
        drawn["modulation"] = _draw_modulation(measurement, full, light, outline)
        drawn["profile"] = _draw_profile(profile)
        drawn["convergence"] = _draw_convergence(full)
        if bars is not None:
            drawn["uncertainty"] = _draw_uncertainty(bars)
        if figure is not None:
            drawn["figure"] = _draw_figure(figure)
            star = _draw_star(figure)
            if star is not None:
                drawn["star"] = star
    return drawn


def new_sheet(width: float, height: float, rows: int = 1, columns: int = 1) -> tuple[Figure, Any]:
    """Make a figure and its axes with fixed margins: fitted ones double the time of a picture.

    Parameters
    ----------
    width, height : float
        Inches, margins included.
    rows, columns : int
        Number of axes.

    Returns
    -------
    figure : Figure
    axes : Axes or array of Axes
        As `Figure.subplots` returns them: one, (columns,), (rows,) or (rows, columns).
    """
    figure = Figure(figsize=(width, height))
    axes = figure.subplots(rows, columns)
    figure.subplots_adjust(
        left=0.8 / width,
        right=1 - 0.35 / width,
        bottom=0.6 / height,
        top=1 - 0.4 / height,
        wspace=0.25,
        hspace=0.28,
    )
    return figure, axes


def _plain_powers(*axes: Any) -> None:
    """Label logarithmic axes like 1e-06, without ticks between: mathematical type takes a tenth of
    a second a picture, and each tick as long as a label.
    """
    for axis in axes:
        axis.set_major_formatter("{x:.0e}")
        axis.set_minor_locator(NullLocator())


def _draw_figure(found: MeasuredFigure) -> Figure:
    """Draw what deviates from the best sphere, its spectrum, and the encircled energy."""
    figure, ((whole, rest), (spectrum, energy)) = new_sheet(12, 10, 2, 2)
    numbers = found.figure.numbers

    # The deviation, and its part that is not rotationally invariant.
    axis_mm = found.seen.axis_mm
    deviation_um = found.figure.deviation_um
    asymmetry_um = deviation_um - found.figure.rotational_um
    title = f"less the best sphere, R = {numbers.radius_of_curvature_mm:.1f} mm (µm)"
    show_map(whole, title, axis_mm, deviation_um, DIVERGING_MAP, even=True)
    title = "and less its rotationally invariant part (µm)"
    show_map(rest, title, axis_mm, asymmetry_um, DIVERGING_MAP, even=True)

    # The spectrum with its band of 1 sigma.
    psd = found.spectrum
    density = psd.density_um2_mm2
    low = np.maximum(density - psd.sigma_um2_mm2, density / 10)
    spectrum.fill_between(psd.frequency_per_mm, low, density + psd.sigma_um2_mm2, alpha=0.3)
    spectrum.loglog(psd.frequency_per_mm, density)
    spectrum.set(title="spectral density", xlabel="spatial frequency (1/mm)", ylabel="um^2 mm^2")
    _plain_powers(spectrum.xaxis, spectrum.yaxis)

    # The encircled energy, of a mirror that focuses.
    if numbers.best_focus_mm > 0:
        energy.plot(np.quantile(found.figure.spot_mm, ENERGY_SHARES), 100 * ENERGY_SHARES)
        for percent, name in ((50, "spot_50_mm"), (80, "spot_80_mm"), (95, "spot_95_mm")):
            of_noise = getattr(found.noise.numbers, name)
            of_geometry = getattr(found.geometry.numbers, name)
            energy.errorbar(
                getattr(numbers, name),
                float(percent),
                xerr=np.nan_to_num(np.hypot(of_noise, of_geometry)),
                fmt="o",
                capsize=4,
                color="tab:red",
            )
        energy.set(title=f"encircled energy, {numbers.best_focus_mm:.1f} mm from the vertex")
    energy.set(xlabel="radius (mm)", ylabel="% of the rays", ylim=(0, 101))
    return figure


def _draw_star(found: MeasuredFigure) -> Figure | None:
    """Draw the image of a distant point at the stated wavelength, and its energy by radius.

    None without a real focus. Where the cells do not resolve the differences of the paths, the
    point spread function is not that of the mirror: the picture states this, and shows where the
    rays meet the focal plane.
    """
    if not found.figure.numbers.best_focus_mm > 0:
        return None
    # Some cells: the image of the whole grid has no more detail near its middle.
    seen = found.seen.take_every(max(1, found.seen.axis_mm.size // _STAR_CELLS))
    try:
        image = image_star(seen.axis_mm, seen.height_mm, found.wavelength_um)
    except ValueError:
        return None
    figure, (picture, energy) = new_sheet(12, 5.2, 1, 2)
    wave = f"at {found.wavelength_um:g} µm"
    energy.set(title=f"focus {image.focus_mm:.1f} mm above the vertex", ylim=(0, 101))
    if not image.resolved:
        reason = (
            f"not resolved {wave}:\nthe paths to the focus differ by\n"
            f"{image.path_rms_um:.3g} µm RMS, and from cell to cell\nby more than half a wavelength"
        )
        place = picture.transAxes
        picture.text(0.5, 0.5, reason, transform=place, ha="center", va="center")
        picture.set(title=f"image of a star {wave}", xticks=[], yticks=[])
        energy.plot(np.quantile(found.figure.spot_mm, ENERGY_SHARES), 100 * ENERGY_SHARES)
        energy.set(xlabel="radius (mm)", ylabel="% of the rays")
        return figure

    # The light around the middle, in a unit that suits it.
    half_um = image.pixel_um * len(image.spread) / 2
    view_um = min(half_um, _STAR_VIEW * image.radius_80_um)
    unit, per_um = "µm", 1.0
    if view_um > _LARGE_UM:
        unit, per_um = "mm", 1e-3
    half = per_um * half_um
    view = per_um * view_um
    shown = picture.imshow(
        np.log10(np.maximum(image.spread / image.spread.max(), _FAINTEST)),
        extent=(-half, half, -half, half),
        origin="lower",
        cmap=SEQUENTIAL_MAP,
        interpolation="nearest",
    )
    figure.colorbar(shown, ax=picture, shrink=0.85)
    picture.set(
        title=f"image of a star {wave}, log10; Strehl {found.figure.numbers.strehl:.3g}",
        xlabel=f"x ({unit})",
        xlim=(-view, view),
        ylim=(-view, view),
    )

    # Its energy by radius.
    radius_um, share = image.energy_curve()
    energy.plot(per_um * radius_um, 100 * share)
    for percent, at_um in ((50, image.radius_50_um), (80, image.radius_80_um)):
        at = per_um * at_um
        energy.plot(at, percent, "o", color="tab:red")
        energy.annotate(f"  {percent} % within {at:.4g} {unit}", (at, percent))
    energy.set(xlabel=f"radius ({unit})", ylabel="% of the light", xlim=(0, view))
    return figure


def _draw_uncertainty(bars: ErrorBars) -> Figure:
    """Draw 1 sigma from the set itself and from the geometry, and the budget."""
    figure, (left, middle, right) = new_sheet(17, 4.8, 1, 3)
    of_noise_um, of_geometry_um = bars.maps_um()
    axis_mm = bars.grid.axis_mm
    title = "1 sigma from this set: noise, film, light (µm)"
    show_map(left, title, axis_mm, of_noise_um, "magma")
    show_map(middle, "1 sigma from the geometry (µm)", axis_mm, of_geometry_um, "magma")

    # The largest rows of the budget, the largest at the top.
    rows = [row for row in bars.budget.rows() if row["height_rms_um"] > 0]
    rows = list(reversed(rows[:_SHOWN_ROWS]))
    places = np.arange(len(rows))
    heights_um = [row["height_rms_um"] for row in rows]
    figures_um = [row["figure_rms_um"] for row in rows]
    right.barh(places + 0.2, heights_um, 0.4, label="height")
    right.barh(places - 0.2, figures_um, 0.4, label="figure (without its plane)")
    right.set_yticks(places, [row["name"] for row in rows], fontsize=8)
    right.set(xscale="log", xlabel="µm RMS", title="budget: contribution of each input, 1 sigma")
    right.legend(loc="lower right")
    _plain_powers(right.xaxis)
    return figure


def _draw_map(
    title: str, axis: FloatArray, values: FloatArray, colours: str, even: bool = False
) -> Figure:
    """Draw one map, as `show_map`."""
    figure, axes = new_sheet(6.4, 5.4)
    show_map(axes, title, axis, values, colours, even)
    return figure


def show_map(
    axes: Any, title: str, axis: FloatArray, values: FloatArray, colours: str, even: bool = False
) -> None:
    """Draw a map with its colour scale, its peak to valley, and its RMS about its mean.

    Parameters
    ----------
    axes : matplotlib axes
        Where to draw.
    title : str
        Title, with the unit of the values.
    axis : (n,) array
        Coordinates along both sides, mm.
    values : (n, n) array
        The map; NaN where nothing is known.
    colours : str
        Name of the colour map.
    even : bool
        Centre the scale on 0; values far beyond those of the rest of the map make it logarithmic
        beyond these.
    """
    # A scale from typical values, which single cells at the edge do not set.
    every = max(1, values.shape[0] // _MAP_CELLS)
    low, high = np.nanpercentile(values[::every, ::every], _TYPICAL_PERCENTILES)
    scale: dict[str, Any] = {"vmin": low, "vmax": high}
    if even:
        high = max(abs(low), abs(high), _LEAST_SCALE)
        most = max(high, float(np.nanmax(np.abs(_local_mean(values)))))
        scale = {"vmin": -most, "vmax": most}
        if most > _STEEP * high:
            scale = {"norm": SymLogNorm(high, vmin=-most, vmax=most)}
            title += f", linear to +-{high:.2g}"

    # The map.
    extent = (axis[0], axis[-1], axis[0], axis[-1])
    shown = axes.imshow(
        values[::every, ::every],
        origin="lower",
        extent=extent,
        cmap=colours,
        interpolation="nearest",
        **scale,
    )
    axes.set(title=title, xlabel="x (mm)", ylabel="y (mm)")

    # Its peak to valley and RMS, in the unit of the title.
    known = values[np.isfinite(values)]
    figures = f"PV {np.ptp(known):.3g}\nRMS {np.std(known):.3g}"  # in the unit of the title
    axes.text(0.02, 0.98, figures, transform=axes.transAxes, va="top", fontsize=8)
    axes.figure.colorbar(shown, ax=axes, shrink=0.85)


def _local_mean(values: FloatArray) -> FloatArray:
    """Mean over squares of 3 x 3 cells: a single wild cell does not set a scale."""
    whole = [size // 3 * 3 for size in values.shape]
    squares = values[: whole[0], : whole[1]].reshape(whole[0] // 3, 3, whole[1] // 3, 3)
    return np.asarray(squares.mean(axis=(1, 3)))


def _draw_slopes(full: FullResult, seen: SurfaceMap) -> Figure:
    """Draw the measured slopes and the residuals of the fit."""
    figure, axes = new_sheet(11, 9, 2, 2)
    grid = full.grid
    is_seen = grid.count > 0
    columns = (
        ("dh/dx", seen.slope_x, grid.slope_x),
        ("dh/dy", seen.slope_y, grid.slope_y),
    )
    for column, (name, measured, residual) in enumerate(columns):
        measured_mrad = np.where(is_seen, 1e3 * measured, np.nan)
        title = f"{name} measured (mrad)"
        show_map(axes[0, column], title, grid.axis_mm, measured_mrad, DIVERGING_MAP, even=True)
        residual_urad = np.where(is_seen, 1e6 * residual, np.nan)
        title = f"{name} less the fit (µrad)"
        show_map(axes[1, column], title, grid.axis_mm, residual_urad, DIVERGING_MAP, even=True)
    return figure


def _draw_modulation(
    measurement: Measurement,
    full: FullResult,
    light: FloatArray,
    outline: rim_outline.Outline | None,
) -> Figure:
    """Draw the fringe amplitude in the camera's picture beside the light with the detected rim."""
    camera = measurement.head.optics.camera
    swing = np.full(camera.width_px * camera.height_px, np.nan, np.float32)
    swing[full.index] = full.swing_adu
    step = max(1, camera.height_px // _SHOWN_PX)
    figure, (left, right) = new_sheet(12, 5, 1, 2)
    extent = (-0.5, camera.width_px - 0.5, camera.height_px - 0.5, -0.5)
    picture = swing.reshape(camera.height_px, camera.width_px)[::step, ::step]
    figure.colorbar(left.imshow(picture, extent=extent), ax=left, shrink=0.85)
    left.set(title="fringe amplitude (ADU)", xlabel="column", ylabel="row")
    right.imshow(light, extent=extent, cmap="gray")
    right.set(title="light and rim", xlabel="column", ylabel="row")
    if outline is not None:
        right.plot(*outline.rim_px, ".", markersize=2, color="tab:orange")
    return figure


def _draw_frames(measurement: Measurement) -> Figure:
    """Draw one tile per frame, the flagged ones with their reason."""
    names = [pattern.name for pattern in measurement.head.patterns]
    reasons = {flag.frame: escape_controls(flag.reason) for flag in measurement.flags}
    figure, axes = new_sheet(9, 0.28 * len(names) + 1.2)
    colours = ["tab:red" if k in reasons else "tab:green" for k in range(len(names))]
    axes.barh(range(len(names)), 1.0, color=colours, alpha=0.5)
    for k in range(len(names)):
        axes.text(
            0.02, k, reasons.get(k, "as predicted"), va="center", fontsize=8, parse_math=False
        )
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set(xticks=[], xlim=(0, 1))
    axes.set_title(
        escape_controls(f"{measurement.verdict} {measurement.reason}")[:_LONGEST_TITLE],
        parse_math=False,
    )
    return figure


def _draw_profile(profile: radial_profile.RadialProfile) -> Figure:
    """Draw the mean height over azimuth, and its difference from Hencky's film."""
    figure, (upper, lower) = new_sheet(7, 6, 2, 1)

    # Above, the height.
    upper.fill_between(
        profile.radius_mm, profile.low_mm, profile.high_mm, alpha=0.4, label="95 % of the ring"
    )
    upper.plot(profile.radius_mm, profile.mean_mm, label="measured, mean over azimuth")
    upper.plot(
        profile.radius_mm, profile.hencky_mm, "--", label=f"Hencky, sag {profile.sag_mm:.3f} mm"
    )
    upper.set(
        ylabel="height (mm)",
        title=f"radial profile; pressure equivalent {profile.pressure_pa:.0f} Pa",
    )
    upper.legend(loc="best")

    # Below, its difference from Hencky's bowl.
    low_um = 1e3 * (profile.low_mm - profile.hencky_mm)
    mean_um = 1e3 * (profile.mean_mm - profile.hencky_mm)
    high_um = 1e3 * (profile.high_mm - profile.hencky_mm)
    lower.fill_between(profile.radius_mm, low_um, high_um, alpha=0.4)
    lower.plot(profile.radius_mm, mean_um)
    lower.set(xlabel="radius (mm)", ylabel="less Hencky (µm)")
    return figure


def _draw_convergence(full: FullResult) -> Figure:
    """Draw the largest change of height of each iteration."""
    figure, axes = new_sheet(6, 4)
    changes = full.fit.changes_mm
    axes.semilogy(range(1, len(changes) + 1), np.maximum(changes, 1e-16), "o-")
    axes.axhline(1e-6, linestyle="--", color="tab:red")
    axes.set(
        xlabel="iteration",
        ylabel="largest change of height (mm)",
        title="bins first, then every pixel",
    )
    _plain_powers(axes.yaxis)
    return figure
