"""The figure of a checked set from every pixel: slopes, robust fit, and the zonal map of the
residual.
"""

from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.figure.set_motion import FilmMotion, combine_axis_steps
from membrane_ctrl.metrology.figure.set_quality import set_quality
from membrane_ctrl.metrology.figure.surface_map import SurfaceMap
from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.phase import (
    full_decoder,
    pattern_sequence,
    phase_steps,
    screen_scale,
)
from membrane_ctrl.metrology.phase.frame_stack import FrameStack
from membrane_ctrl.metrology.phase.pixel_phases import PixelPhases, pixel_phases
from membrane_ctrl.metrology.rays import ray_tracing
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.reconstruction import film_motion, slope_noise, surface_fit, zonal_map
from membrane_ctrl.metrology.reconstruction.normal_matrix import NormalMatrix
from membrane_ctrl.model.arrays import FloatArray, Image, IntArray, Singles
from membrane_ctrl.model.shape_estimate import Quality

_START_SAG_MM = 40.0  # the paper's starting parabola
# Solutions from different starts agree to a hundredth of the last change: 1e-9 mm
_LAST_CHANGE_MM = 1e-7
# Tukey's weight reaches 0 here: noise (5 sigma in millions of pixels) keeps its weight, dust and
# glints have none
_TUKEY_SIGMAS = 8.0
_PART = 1 << 18  # pixels worked on at a time where memory would grow with them
# A slope this far off is not the film's but a wrong fringe order (4.3 mrad) or a glint
_NO_SLOPE = 4e-3


@dataclass(frozen=True)
class FullResult:
    """The figure of one set, from all of its pixels.

    Attributes
    ----------
    fit : surface_fit.Fit
        The surface: Hencky excess and Zernike terms; `changes_mm` of all iterations from the start.
    index : (n,) int array
        Pixels inside the analysis radius that gave slopes, counted row by row.
    weights : (n,) array
        Weight in the fit.
    swing_adu : (n,) array
        The smaller of the two fringe amplitudes.
    rest_adu : (n,) array
        Residual of the frames after the sinusoids: noise, motion, the display's harmonics.
    grid : zonal_map.ResidualGrid
        Mean slope residuals in cells.
    fit_grid : zonal_map.ResidualGrid
        The same, each pixel with its weight in the fit.
    residual_mm : (m, m) array
        Height over the fit, 0 at the vertex; NaN where nothing was measured.
    quality : Quality
        Quality of the fit, for the verdict.
    moved : bool
        Whether the film's motion was corrected.
    """

    fit: surface_fit.Fit
    index: IntArray
    weights: FloatArray
    swing_adu: Singles
    rest_adu: Singles
    grid: zonal_map.ResidualGrid
    fit_grid: zonal_map.ResidualGrid
    residual_mm: FloatArray
    quality: Quality
    moved: bool

    @property
    def surface(self) -> Surface:
        """The fitted surface."""
        return self.fit.surface

    def slope_variance(
        self, optics: OpticsConfig, shifts_rad: list[FloatArray], noise_adu: float
    ) -> FloatArray:
        """(2,) variance of an x and of a y slope of one pixel, from the noise of a pixel in a
        frame.
        """
        swing = self.quality.modulation_share * (2**optics.camera.bits - 1)
        sigma_mm = [
            screen_scale.mm_per_rad(optics.pattern)
            * phase_steps.phase_sigma_rad(d, noise_adu, swing)
            for d in shifts_rad
        ]
        gain = slope_noise.slope_per_screen(
            Geometry.from_config(optics), self.surface.radius_mm, self.surface.sag_mm
        )
        return np.asarray(gain @ np.square(sigma_mm))

    def height_mm(self) -> FloatArray:
        """Height above the vertex (m, m) on `grid.axis_mm`: the fit plus its residual; NaN where
        not measured.
        """
        return np.asarray(self.surface.on_grid(self.grid.axis_mm)[0] + self.residual_mm)

    def map(self) -> SurfaceMap:
        """The height with the slopes that were measured, as means over the cells."""
        height, slope_x, slope_y = self.surface.on_grid(self.grid.axis_mm)
        grid = self.grid
        return SurfaceMap(
            grid.axis_mm, height + self.residual_mm, slope_x + grid.slope_x, slope_y + grid.slope_y
        )


@dataclass(frozen=True)
class PixelPoints:
    """Pixels that see the pattern, with their screen points."""

    index: IntArray
    points: ray_tracing.Points
    swing_adu: Singles
    rest_adu: Singles
    moved: bool


def measure_pixels(optics: OpticsConfig, checked: Checked) -> PixelPoints:
    """Phases of all pixels in bins that have one, corrected for the film's motion between the
    frames.
    """
    stack = checked.stack
    bin_px, columns = checked.binned.bin_px, checked.phase_rad.shape[2]
    known = np.isfinite(checked.phase_rad).all(axis=0) & checked.near
    row, column = np.nonzero(np.repeat(np.repeat(known, bin_px, axis=0), bin_px, axis=1))
    index = row * stack.size_px[1] + column
    in_bin = row // bin_px * columns + column // bin_px
    tracer, surface = checked.tracer, checked.state.surface
    points = ray_tracing.Points.of(
        _trace_pixel_rays(tracer.geometry, column, row), np.empty((2, index.size))
    )
    del row, column
    points.t_mm[:] = (tracer.vertex_z_mm - tracer.geometry.pinhole_mm[2]) / points.rays[2]
    tracer.intersect(points, surface, newton=4)
    film = FilmMotion.of(checked)
    moved, sensitivity = film.worth_correcting, np.zeros((2, index.size))
    if moved:
        sensitivity = film_motion.sensitivity_mm_per_um(
            tracer, points, surface
        ) / screen_scale.mm_per_rad(optics.pattern)
    told_um = film.told_um if moved else (None, None)
    axes = [
        _axis_phases(optics, checked, k, index, in_bin, sensitivity[k], told_um[k])
        for k in range(2)
    ]
    points.screen_mm[:] = screen_scale.screen_mm(
        np.stack([a.phase_rad for a in axes]), optics.pattern
    )
    swing = np.minimum(axes[0].swing_adu, axes[1].swing_adu)
    x, y = tracer.position_mm(points)
    keep = (x**2 + y**2 <= optics.mirror.analysis_radius_mm**2) & ~(
        axes[0].saturated | axes[1].saturated
    )
    keep &= swing > full_decoder.FRINGE_SHARE * checked.view.light.reshape(-1)[in_bin]
    rest = np.hypot(axes[0].rest_adu, axes[1].rest_adu)[keep]
    index, swing = index[keep], swing[keep]
    del (
        axes,
        x,
        y,
        in_bin,
        sensitivity,
    )  # the copies of the points follow, the most memory of a measurement
    return PixelPoints(index, points.subset(keep), swing, rest, moved)


def _trace_pixel_rays(geometry: Geometry, column: IntArray, row: IntArray) -> FloatArray:
    """Rays of pixels, in parts, because the intermediate results are larger."""
    out = np.empty((3, column.size))
    for start in range(0, column.size, _PART):
        part = slice(start, start + _PART)
        out[:, part] = geometry.rays(column[part], row[part])
    return out


def _axis_phases(
    optics: OpticsConfig,
    checked: Checked,
    axis: int,
    index: IntArray,
    in_bin: IntArray,
    sensitivity: FloatArray,
    told_um: FloatArray | None,
) -> PixelPhases:
    stack, used = checked.stack, checked.view.used[axis]
    combined = combine_axis_steps(checked, axis, told_um)
    every = stack.sinusoids(pattern_sequence.AXES[axis])
    # a slice does not copy the frames; a list does
    frames = stack.frames[every[0] : every[-1] + 1] if used == every else stack.frames[used]
    reference = checked.phase_rad[axis].reshape(-1)[in_bin]
    gain = None if stack.gain is None else stack.gain[used]
    return pixel_phases(
        frames,
        stack.design(used),
        combined,
        index,
        sensitivity,
        reference,
        checked.binned.clip,
        gain,
        _gather_previous(stack, used),
        stack.held_shares,
    )


def _gather_previous(stack: FrameStack, used: list[int]) -> Image | None:
    """The frame before each of these, itself without one; None if they hold nothing of it."""
    if not any(stack.held_shares):
        return None
    previous = [stack.before_of(frame) for frame in used]
    gathered: Image = stack.frames[
        [frame if before < 0 else before for frame, before in zip(used, previous, strict=True)]
    ]
    return gathered


def reconstruct_full(
    optics: OpticsConfig,
    checked: Checked,
    pixels: PixelPoints,
    start: ray_tracing.HeightFunction | None = None,
) -> FullResult:
    """Fit the pixels and integrate the residual.

    `start` is the starting shape, by default the paper's parabola of 40 mm.
    """
    tracer, points = checked.tracer, pixels.points
    # the bins solve from the start; the pixels continue where that has nearly converged
    rough_points = checked.state.points.subset(np.ones(checked.state.index.size, bool))
    tolerance = _LAST_CHANGE_MM * surface_fit.CONTRACTION
    begin = start or ray_tracing.make_parabola(_START_SAG_MM, tracer.radius_mm)
    rough = surface_fit.fit_surface(tracer, rough_points, begin, tolerance_mm=tolerance)
    tracer.intersect(points, rough.surface, newton=2)
    points.weights[:] = tukey_weights(_slopes_left(tracer, points, rough.surface)[1])
    fit = surface_fit.fit_surface(
        tracer,
        points,
        rough.surface,
        normal=NormalMatrix.from_points(tracer, points),
        tolerance_mm=tolerance,
    )
    tracer.intersect(points, fit.surface)
    field, left = _slopes_left(tracer, points, fit.surface)
    grid = zonal_map.residual_grid(
        field, (left < _NO_SLOPE).astype(float), optics.mirror.analysis_radius_mm
    )
    fit_grid = zonal_map.residual_grid(field, points.weights, optics.mirror.analysis_radius_mm)
    return FullResult(
        fit=replace(fit, changes_mm=(*rough.changes_mm, *fit.changes_mm)),
        index=pixels.index,
        weights=points.weights,
        swing_adu=pixels.swing_adu,
        rest_adu=pixels.rest_adu,
        grid=grid,
        fit_grid=fit_grid,
        residual_mm=zonal_map.integrate_residual(grid),
        quality=set_quality(optics, checked, fit, float(np.median(pixels.swing_adu))),
        moved=pixels.moved,
    )


def _slopes_left(
    tracer: ray_tracing.Tracer, points: ray_tracing.Points, surface: Surface
) -> tuple[FloatArray, FloatArray]:
    """Slopes (6, n) of `Tracer.slope_field`, and how far (n,) the measured ones are from the
    surface's.
    """
    field = tracer.slope_field(points, surface)
    return field, np.hypot(field[2] - field[4], field[3] - field[5])


def tukey_weights(residual: FloatArray) -> FloatArray:
    """Tukey's weights (1 - (r / c)^2)^2, with c in robust sigmas (median of a Rayleigh
    distribution: 1.177 sigma).
    """
    # every 7th gives the median of millions well enough; the floor is the rounding of a noise-free
    # set
    reach = _TUKEY_SIGMAS * max(float(np.median(residual[::7])) / 1.177, 1e-9)
    return np.asarray(np.square(np.maximum(1 - np.square(residual / reach), 0.0)))
