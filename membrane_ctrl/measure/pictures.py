"""Pictures of a measurement, as PNG files beside the result."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from membrane_ctrl.drawing import plot_axes
from membrane_ctrl.drawing.axis_scale import AxisScale, Spacing, Tick, fit_scale
from membrane_ctrl.drawing.canvas import Canvas
from membrane_ctrl.drawing.plot_axes import Box, PlotAxes, Sheet
from membrane_ctrl.measure.figure_results import ENERGY_SHARES, MeasuredFigure
from membrane_ctrl.measure.map_colours import choose_map_colours, describe_map
from membrane_ctrl.measure.measurement import Measurement
from membrane_ctrl.measure.results import ErrorBars
from membrane_ctrl.metrology.figure import radial_profile
from membrane_ctrl.metrology.figure.pixel_figure import FullResult
from membrane_ctrl.metrology.figure.star_image import image_star
from membrane_ctrl.metrology.figure.surface_map import SurfaceMap
from membrane_ctrl.metrology.rays import rim_outline
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.colours import DIVERGING_MAP, SEQUENTIAL_MAP
from membrane_ctrl.model.files import write_bytes_atomic
from membrane_ctrl.model.terminal import escape_controls

_SHOWN_PX = 600  # side of pixel maps
_MAP_CELLS = 450  # side of other maps
_STAR_CELLS = 192  # side of the grid that the image of a star is made of
_FAINTEST = 1e-4  # light of the star's image that is drawn, over its brightest
_LARGE_UM = 1000.0  # beyond which its picture counts in millimetres
_STAR_VIEW = 3.0  # half the side of its picture, over the radius with 80 % of the light
_SHOWN_ROWS = 16  # of the budget: further ones add nothing
_LONGEST_TITLE = 100  # letters: the width of the sheet
_PERCENT = AxisScale(0, 101)
_BAR = 0.4  # height of a bar, rows
_NAMES_PX = 45  # that names of inputs need beside the space between plots
_FRAME_OPACITY = 0.5  # of the tile of a frame
_ACCEPTED_MM = 1e-6  # change at which the fit has converged


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
    paths = []
    for name, canvas in _draw_pictures(measurement, light, profile, outline, bars, figure).items():
        path = out / f"{name}.png"
        write_bytes_atomic(path, canvas.encode_png())
        paths.append(path)
    return paths


def _draw_pictures(
    measurement: Measurement,
    light: FloatArray,
    profile: radial_profile.RadialProfile | None,
    outline: rim_outline.Outline | None,
    bars: ErrorBars | None,
    figure: MeasuredFigure | None,
) -> dict[str, Canvas]:
    """All pictures by their names."""
    drawn = {"frames": _draw_frames(measurement)}
    full = measurement.full
    if full is not None and profile is not None:
        axis_mm = full.grid.axis_mm
        residual_um = 1e3 * full.residual_mm
        seen = full.map() if figure is None else figure.seen
        drawn["sag"] = _draw_single_map("height (mm)", axis_mm, full.height_mm(), SEQUENTIAL_MAP)
        drawn["residual"] = _draw_single_map(
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


def _draw_figure(found: MeasuredFigure) -> Canvas:
    """Draw what deviates from the best sphere, its spectrum, and the encircled energy."""
    sheet = Sheet(12, 10, 2, 2)
    canvas = sheet.canvas
    numbers = found.figure.numbers

    # The deviation, and its part that is not rotationally invariant.
    axis_mm = found.seen.axis_mm
    deviation_um = found.figure.deviation_um
    asymmetry_um = deviation_um - found.figure.rotational_um
    title = f"less the best sphere, R = {numbers.radius_of_curvature_mm:.1f} mm (µm)"
    _show_map(canvas, sheet.box(0, 0), title, axis_mm, deviation_um, DIVERGING_MAP, even=True)
    title = "and less its rotationally invariant part (µm)"
    _show_map(canvas, sheet.box(0, 1), title, axis_mm, asymmetry_um, DIVERGING_MAP, even=True)

    # The spectrum with its band of 1 sigma.
    psd = found.spectrum
    density = psd.density_um2_mm2
    low = np.maximum(density - psd.sigma_um2_mm2, density / 10)
    high = density + psd.sigma_um2_mm2
    frequency = fit_scale(psd.frequency_per_mm, spacing=Spacing.LOGARITHMIC)
    power = fit_scale(low, high, spacing=Spacing.LOGARITHMIC)
    spectrum = PlotAxes(canvas, sheet.box(1, 0), frequency, power)
    spectrum.fill_between(psd.frequency_per_mm, low, high)
    spectrum.draw_line(psd.frequency_per_mm, density)
    spectrum.draw_frame("spectral density", "spatial frequency (1/mm)", "µm² mm²")

    # The encircled energy, of a mirror that focuses.
    radii_mm = np.quantile(found.figure.spot_mm, ENERGY_SHARES)
    energy = PlotAxes(canvas, sheet.box(1, 1), fit_scale(0.0, radii_mm), _PERCENT)
    title = ""
    if numbers.best_focus_mm > 0:
        energy.draw_line(radii_mm, 100 * ENERGY_SHARES)
        for percent, name in ((50, "spot_50_mm"), (80, "spot_80_mm"), (95, "spot_95_mm")):
            of_noise_mm = getattr(found.noise.numbers, name)
            of_geometry_mm = getattr(found.geometry.numbers, name)
            half_mm = float(np.nan_to_num(np.hypot(of_noise_mm, of_geometry_mm)))
            energy.draw_interval(getattr(numbers, name), half_mm, percent)
        title = f"encircled energy, {numbers.best_focus_mm:.1f} mm from the vertex"
    energy.draw_frame(title, "radius (mm)", "% of the rays")
    return canvas


def _draw_star(found: MeasuredFigure) -> Canvas | None:
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
    sheet = Sheet(12, 5.2, 1, 2)
    wave = f"at {found.wavelength_um:g} µm"
    title = f"focus {image.focus_mm:.1f} mm above the vertex"
    if not image.resolved:
        reason = (
            f"not resolved {wave}:\nthe paths to the focus differ by\n"
            f"{image.path_rms_um:.3g} µm RMS, and from cell to cell\nby more than half a wavelength"
        )
        empty = PlotAxes(sheet.canvas, sheet.box(0, 0), AxisScale(0, 1), AxisScale(0, 1))
        empty.write_note(reason, 0.5, 0.5, "middle", "middle", size_pt=10)
        empty.draw_frame(f"image of a star {wave}", x_ticks=(), y_ticks=())
        radii_mm = np.quantile(found.figure.spot_mm, ENERGY_SHARES)
        energy = PlotAxes(sheet.canvas, sheet.box(0, 1), fit_scale(0.0, radii_mm), _PERCENT)
        energy.draw_line(radii_mm, 100 * ENERGY_SHARES)
        energy.draw_frame(title, "radius (mm)", "% of the rays")
        return sheet.canvas

    # The light around the middle, in a unit that suits it.
    half_um = image.pixel_um * len(image.spread) / 2
    view_um = min(half_um, _STAR_VIEW * image.radius_80_um)
    unit = "µm"
    per_um = 1.0
    if view_um > _LARGE_UM:
        unit = "mm"
        per_um = 1e-3
    view = per_um * view_um
    around = max(1, round(view_um / image.pixel_um))
    middle = len(image.spread) // 2
    near = slice(max(0, middle - around), middle + around)
    bright = np.log10(np.maximum(image.spread[near, near] / image.spread.max(), _FAINTEST))
    side = AxisScale(-view, view)
    colours = AxisScale(np.log10(_FAINTEST), 0)
    picture = plot_axes.draw_map(
        sheet.canvas, sheet.box(0, 0), bright[::-1], side, side, colours, SEQUENTIAL_MAP
    )
    strehl = found.figure.numbers.strehl
    picture.draw_frame(f"image of a star {wave}, log10; Strehl {strehl:.3g}", f"x ({unit})")

    # Its energy by radius.
    energy = PlotAxes(sheet.canvas, sheet.box(0, 1), AxisScale(0, view), _PERCENT)
    energy.draw_line(per_um * image.curve_um, 100 * image.curve_share)
    for percent, at_um in ((50, image.radius_50_um), (80, image.radius_80_um)):
        at = per_um * at_um
        energy.draw_dots(at, percent)
        energy.write_beside(f"   {percent} % within {at:.4g} {unit}", at, percent)
    energy.draw_frame(title, f"radius ({unit})", "% of the light")
    return sheet.canvas


def _draw_uncertainty(bars: ErrorBars) -> Canvas:
    """Draw 1 sigma from the set itself and from the geometry, and the budget."""
    sheet = Sheet(17, 4.8, 1, 3)
    canvas = sheet.canvas
    of_noise_um, of_geometry_um = bars.maps_um()
    axis_mm = bars.grid.axis_mm
    title = "1 sigma from this set: noise, film, light (µm)"
    _show_map(canvas, sheet.box(0, 0), title, axis_mm, of_noise_um, "magma")
    title = "1 sigma from the geometry (µm)"
    _show_map(canvas, sheet.box(0, 1), title, axis_mm, of_geometry_um, "magma")

    # The largest rows of the budget, the largest at the top.
    rows = [row for row in bars.budget.rows() if row["height_rms_um"] > 0][:_SHOWN_ROWS]
    heights_um = [row["height_rms_um"] for row in rows]
    figures_um = [row["figure_rms_um"] for row in rows]
    size = fit_scale(heights_um, figures_um, spacing=Spacing.LOGARITHMIC)
    box = sheet.box(0, 2)
    box = replace(box, left=box.left + _NAMES_PX)
    budget = PlotAxes(canvas, box, size, AxisScale(max(len(rows), 1) - 0.4, -0.6))
    for place, (height_um, figure_um) in enumerate(zip(heights_um, figures_um, strict=True)):
        upper = (place - _BAR, place)
        lower = (place, place + _BAR)
        budget.draw_bar(size.low, height_um, upper, plot_axes.FIRST_COLOUR)
        budget.draw_bar(size.low, max(figure_um, size.low), lower, plot_axes.SECOND_COLOUR)
    names = [Tick(place, row["name"]) for place, row in enumerate(rows)]
    legend = [("height", plot_axes.FIRST_COLOUR)]
    legend.append(("figure (without its plane)", plot_axes.SECOND_COLOUR))
    budget.draw_legend(legend, along="bottom")
    title = "budget: contribution of each input, 1 sigma"
    budget.draw_frame(title, "µm RMS", y_ticks=names)
    return canvas


def _draw_single_map(
    title: str, axis: FloatArray, values: FloatArray, colours: str, even: bool = False
) -> Canvas:
    """Draw one map, as `_show_map`."""
    sheet = Sheet(6.4, 5.4)
    _show_map(sheet.canvas, sheet.box(), title, axis, values, colours, even)
    return sheet.canvas


def _show_map(
    canvas: Canvas,
    box: Box,
    title: str,
    axis: FloatArray,
    values: FloatArray,
    colours: str,
    even: bool = False,
) -> None:
    """Draw a map with its colour scale, its peak to valley, and its RMS about its mean.

    Parameters
    ----------
    canvas : Canvas
        The picture.
    box : Box
        Where to draw.
    title : str
        Title, with the unit of the values.
    axis : (n,) array
        Coordinates along both sides, mm.
    values : (n, n) array
        The map, from the lowest row on; NaN where nothing is known.
    colours : str
        Name of the colour table.
    even : bool
        Centre the scale on 0, as `choose_map_colours` does.
    """
    every = max(1, values.shape[0] // _MAP_CELLS)
    shown = values[::every, ::every]
    scale = choose_map_colours(values, shown, even)
    if scale.spacing is Spacing.SYMMETRIC:
        title += f", linear to +-{scale.linear_to:.2g}"
    side = AxisScale(float(axis[0]), float(axis[-1]))
    axes = plot_axes.draw_map(canvas, box, shown[::-1], side, side, scale, colours)
    axes.write_note(describe_map(values), 0.02, 0.98)
    axes.draw_frame(title, "x (mm)", "y (mm)")


def _draw_slopes(full: FullResult, seen: SurfaceMap) -> Canvas:
    """Draw the measured slopes and the residuals of the fit."""
    sheet = Sheet(11, 9, 2, 2)
    grid = full.grid
    is_seen = grid.count > 0
    columns = (
        ("dh/dx", seen.slope_x, grid.slope_x),
        ("dh/dy", seen.slope_y, grid.slope_y),
    )
    for column, (name, measured, residual) in enumerate(columns):
        measured_mrad = np.where(is_seen, 1e3 * measured, np.nan)
        residual_urad = np.where(is_seen, 1e6 * residual, np.nan)
        panels = (
            (f"{name} measured (mrad)", measured_mrad),
            (f"{name} less the fit (µrad)", residual_urad),
        )
        for row, (title, values) in enumerate(panels):
            box = sheet.box(row, column)
            _show_map(sheet.canvas, box, title, grid.axis_mm, values, DIVERGING_MAP, even=True)
    return sheet.canvas


def _draw_modulation(
    measurement: Measurement,
    full: FullResult,
    light: FloatArray,
    outline: rim_outline.Outline | None,
) -> Canvas:
    """Draw the fringe amplitude in the camera's picture beside the light with the detected rim."""
    camera = measurement.head.optics.camera
    swing_adu = np.full(camera.width_px * camera.height_px, np.nan, np.float32)
    swing_adu[full.index] = full.swing_adu
    step = max(1, camera.height_px // _SHOWN_PX)
    picture = swing_adu.reshape(camera.height_px, camera.width_px)[::step, ::step].astype(float)
    sheet = Sheet(12, 5, 1, 2)
    columns = AxisScale(-0.5, camera.width_px - 0.5)
    rows = AxisScale(camera.height_px - 0.5, -0.5)  # counted downwards

    amplitude = fit_scale(picture)
    left = plot_axes.draw_map(
        sheet.canvas, sheet.box(0, 0), picture, columns, rows, amplitude, SEQUENTIAL_MAP
    )
    left.draw_frame("fringe amplitude (ADU)", "column", "row")

    right = plot_axes.draw_map(
        sheet.canvas, sheet.box(0, 1), light, columns, rows, fit_scale(light), "gray"
    )
    if outline is not None:
        rim_columns, rim_rows = outline.rim_px
        right.draw_dots(rim_columns, rim_rows, plot_axes.SECOND_COLOUR, radius_px=1.2)
    right.draw_frame("light and rim", "column", "row")
    return sheet.canvas


def _draw_frames(measurement: Measurement) -> Canvas:
    """Draw one tile per frame, the flagged ones with their reason."""
    names = [pattern.name for pattern in measurement.head.patterns]
    reasons = {flag.frame: escape_controls(flag.reason) for flag in measurement.flags}
    sheet = Sheet(9, 0.28 * len(names) + 1.2)
    axes = PlotAxes(sheet.canvas, sheet.box(), AxisScale(0, 1), AxisScale(len(names) - 0.5, -0.5))
    for place in range(len(names)):
        colour = plot_axes.MARK_COLOUR if place in reasons else plot_axes.GOOD_COLOUR
        axes.draw_bar(0, 1, (place - _BAR, place + _BAR), colour, _FRAME_OPACITY)
        axes.write_beside(f"  {reasons.get(place, 'as predicted')}", 0, place)
    ticks = [Tick(place, name) for place, name in enumerate(names)]
    title = escape_controls(f"{measurement.verdict} {measurement.reason}")[:_LONGEST_TITLE]
    axes.draw_frame(title, x_ticks=(), y_ticks=ticks)
    return sheet.canvas


def _draw_profile(profile: radial_profile.RadialProfile) -> Canvas:
    """Draw the mean height over azimuth, and its difference from Hencky's film."""
    sheet = Sheet(7, 6, 2, 1)
    radius_mm = profile.radius_mm
    radius = fit_scale(radius_mm)

    # Above, the height.
    height = fit_scale(profile.low_mm, profile.high_mm, profile.hencky_mm)
    upper = PlotAxes(sheet.canvas, sheet.box(0, 0), radius, height)
    upper.fill_between(radius_mm, profile.low_mm, profile.high_mm)
    upper.draw_line(radius_mm, profile.mean_mm)
    upper.draw_line(radius_mm, profile.hencky_mm, plot_axes.SECOND_COLOUR, dashed=True)
    legend = [("measured, mean and 95 % over azimuth", plot_axes.FIRST_COLOUR)]
    legend.append((f"Hencky, sag {profile.sag_mm:.3f} mm", plot_axes.SECOND_COLOUR))
    upper.draw_legend(legend, across="left")
    title = f"radial profile; pressure equivalent {profile.pressure_pa:.0f} Pa"
    upper.draw_frame(title, y_label="height (mm)")

    # Below, its difference from Hencky's bowl.
    low_um = 1e3 * (profile.low_mm - profile.hencky_mm)
    mean_um = 1e3 * (profile.mean_mm - profile.hencky_mm)
    high_um = 1e3 * (profile.high_mm - profile.hencky_mm)
    lower = PlotAxes(sheet.canvas, sheet.box(1, 0), radius, fit_scale(low_um, high_um))
    lower.fill_between(radius_mm, low_um, high_um)
    lower.draw_line(radius_mm, mean_um)
    lower.draw_frame("", "radius (mm)", "less Hencky (µm)")
    return sheet.canvas


def _draw_convergence(full: FullResult) -> Canvas:
    """Draw the largest change of height of each iteration."""
    sheet = Sheet(6, 4)
    changes_mm = np.maximum(full.fit.changes_mm, 1e-16)
    numbers = np.arange(1.0, len(changes_mm) + 1)
    size = fit_scale(changes_mm, _ACCEPTED_MM, spacing=Spacing.LOGARITHMIC)
    number = fit_scale(numbers)
    axes = PlotAxes(sheet.canvas, sheet.box(), number, size)
    axes.draw_line([number.low, number.high], [_ACCEPTED_MM] * 2, plot_axes.MARK_COLOUR, True)
    axes.draw_line(numbers, changes_mm)
    axes.draw_dots(numbers, changes_mm, plot_axes.FIRST_COLOUR)
    ticks = [Tick(value, f"{value:.0f}") for value in numbers]
    axes.draw_frame(
        "bins first, then every pixel", "iteration", "largest change of height (mm)", ticks
    )
    return sheet.canvas
