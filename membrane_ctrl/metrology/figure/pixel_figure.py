"""The figure of a checked set from every pixel: slopes, robust fit, and the zonal map of the
residual.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.figure.reflection_fit import (
    ReflectionFit,
    fit_reflections,
    remove_reflections,
)
from membrane_ctrl.metrology.figure.set_motion import FilmMotion, combine_axis_steps
from membrane_ctrl.metrology.figure.set_quality import set_quality
from membrane_ctrl.metrology.figure.surface_map import SurfaceMap
from membrane_ctrl.metrology.frame_checks import pixel_noise
from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.numerics.vectors import vector_lengths
from membrane_ctrl.metrology.phase import full_decoder, pattern_sequence, phase_steps, screen_scale
from membrane_ctrl.metrology.phase.frame_stack import FrameStack
from membrane_ctrl.metrology.phase.pixel_phases import PixelPhases, pixel_phases
from membrane_ctrl.metrology.rays import ray_tracing
from membrane_ctrl.metrology.rays.film_reflections import map_reflections
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.reconstruction import film_motion, slope_noise, surface_fit, zonal_map
from membrane_ctrl.metrology.reconstruction.normal_matrix import NormalMatrix
from membrane_ctrl.model.arrays import BoolArray, FloatArray, Image, IntArray, Singles
from membrane_ctrl.model.shape_estimate import Quality

_START_SAG_MM = 40.0  # the paper's starting parabola
# Solutions from different starts agree to a hundredth of the last change: 1e-9 mm
_LAST_CHANGE_MM = 1e-7
# Tukey's weight reaches 0 here: noise (5 sigma in millions of pixels) keeps its weight, dust and
# glints have none.
_TUKEY_SIGMAS = 8.0
_EVERY = 7  # residuals between those of which the median is taken
_RAYLEIGH_MEDIAN = 1.177  # median of a Rayleigh distribution, in sigmas
_LEAST_SLOPE = 1e-9  # floor of the residual's scatter: the rounding of a noise-free set
_PART = 1 << 18  # pixels worked on at a time where memory would grow with them
# A slope that is further off than this is not the film's: a wrong fringe order (4.3 mrad), or a
# glint.
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
    noise_adu : float
        Standard deviation of a pixel in one frame, as the frames show it; NaN for three steps.
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
    reflections : ReflectionFit, optional
        What was found and removed of a front film's reflections.
    """

    fit: surface_fit.Fit
    index: IntArray
    weights: FloatArray
    swing_adu: Singles
    noise_adu: float
    grid: zonal_map.ResidualGrid
    fit_grid: zonal_map.ResidualGrid
    residual_mm: FloatArray
    quality: Quality
    moved: bool
    reflections: ReflectionFit | None = None

    @property
    def surface(self) -> Surface:
        """The fitted surface."""
        return self.fit.surface

    def slope_variance(
        self, optics: OpticsConfig, shifts_rad: list[FloatArray], noise_adu: float
    ) -> FloatArray:
        """Variance of an x and of a y slope of one pixel.

        Parameters
        ----------
        optics, shifts_rad, noise_adu
            As of `screen_variance_mm2`.

        Returns
        -------
        (2,) array
            In squared slopes.
        """
        gain = slope_noise.slope_per_screen(
            Geometry.from_config(optics), self.surface.radius_mm, self.surface.sag_mm
        )
        return np.asarray(gain @ self.screen_variance_mm2(optics, shifts_rad, noise_adu))

    def screen_variance_mm2(
        self, optics: OpticsConfig, shifts_rad: list[FloatArray], noise_adu: float
    ) -> FloatArray:
        """Variance (2,) of the screen point that one pixel sees, along x and y.

        Parameters
        ----------
        optics : OpticsConfig
            The bench.
        shifts_rad : two (N,) arrays
            Phase steps of the used frames of x and of y.
        noise_adu : float
            Standard deviation of a pixel in one frame.
        """
        swing_adu = self.quality.modulation_share * (2**optics.camera.bits - 1)
        mm_per_rad = screen_scale.mm_per_rad(optics.pattern)
        sigma_mm = [
            mm_per_rad * phase_steps.phase_sigma_rad(steps_rad, noise_adu, swing_adu)
            for steps_rad in shifts_rad
        ]
        return np.square(sigma_mm)

    @cached_property
    def _fit_on_grid(self) -> FloatArray:
        """Height and slopes (3, m, m) of the fit on `grid.axis_mm`."""
        return self.surface.on_grid(self.grid.axis_mm)

    def height_mm(self) -> FloatArray:
        """Height above the vertex (m, m) on `grid.axis_mm`: the fit plus its residual; NaN where
        not measured.
        """
        return np.asarray(self._fit_on_grid[0] + self.residual_mm)

    def map(self) -> SurfaceMap:
        """The height with the slopes that were measured, as means over the cells."""
        grid = self.grid
        height, slope_x, slope_y = self._fit_on_grid
        height = height + self.residual_mm
        return SurfaceMap(grid.axis_mm, height, slope_x + grid.slope_x, slope_y + grid.slope_y)


@dataclass(frozen=True)
class PixelPoints:
    """Pixels that see the pattern, with their screen points.

    Attributes
    ----------
    index : (n,) int array
        Pixels, counted row by row.
    points : Points
        Their rays and screen points.
    swing_adu : (n,) array
        The smaller of the two fringe amplitudes.
    noise_adu : float
        Standard deviation of a pixel in one frame, as the frames show it; NaN for three steps.
    moved : bool
        Whether the film's motion was corrected.
    reflections : ReflectionFit, optional
        What was found and removed of a front film's reflections.
    """

    index: IntArray
    points: ray_tracing.Points
    swing_adu: Singles
    noise_adu: float
    moved: bool
    reflections: ReflectionFit | None = None


def measure_pixels(optics: OpticsConfig, checked: Checked) -> PixelPoints:
    """Phases and screen points of all pixels in bins that have a phase.

    The film's motion between the frames is corrected if it is worth it.

    Parameters
    ----------
    optics : OpticsConfig
        The bench.
    checked : Checked
        The set.

    Returns
    -------
    PixelPoints
    """
    # Pixels of bins that have a phase, and their rays up to the surface of the bins.
    row, column, in_bin = _list_pixels(checked)
    index = row * checked.stack.size_px[1] + column
    points = _follow_rays(checked, column, row)
    del row, column

    # Their phases, in the period of their bin: screen points. Here, and below, an array is freed
    # before the next one is made: these are the largest of a measurement.
    film = FilmMotion.from_set(checked)
    sensitivity_rad_per_um = _sensitivity_rad_per_um(optics, checked, film, points)
    swing_adu = np.full(index.size, np.inf, np.float32)
    keep = np.ones(index.size, bool)
    for axis in range(2):
        motion_um = film.motion_um[axis] if film.is_worth_correcting else None
        phases = _axis_phases(checked, axis, index, in_bin, sensitivity_rad_per_um[axis], motion_um)
        points.screen_mm[axis] = screen_scale.screen_mm(phases.phase_rad, optics.pattern)
        np.minimum(swing_adu, phases.swing_adu, out=swing_adu)
        keep &= ~phases.saturated
        del phases
    del sensitivity_rad_per_um

    # Without pixels beyond the analysed radius, with a clipped frame or with too weak fringes.
    keep &= swing_adu > full_decoder.FRINGE_SHARE * checked.view.light.reshape(-1)[in_bin]
    del in_bin
    for part, some in points.parts(_PART):
        x_mm, y_mm = checked.tracer.position_mm(some)
        keep[part] &= x_mm**2 + y_mm**2 <= optics.mirror.analysis_radius_mm**2

    # Without the reflections of a front film, and pixels that show their edges.
    reflections = None
    if checked.tracer.geometry.cushion is not None:
        reflections, lost = _remove_reflections(optics, checked, points, keep)
        keep &= ~lost
    place = np.flatnonzero(keep)
    index = index[place]
    swing_adu = swing_adu[place]
    points.keep(place)
    noise_adu = pixel_noise.estimate_pixel_noise_adu(checked.stack, checked.view.used, index)
    moved = film.is_worth_correcting
    return PixelPoints(index, points, swing_adu, noise_adu, moved, reflections)


def _remove_reflections(
    optics: OpticsConfig, checked: Checked, points: ray_tracing.Points, usable: BoolArray
) -> tuple[ReflectionFit | None, BoolArray]:
    """Fit the reflections of a front film to the usable pixels, and remove them from the screen
    points, in place; with the pixels that must be left out.
    """
    tracer = checked.tracer
    surface = checked.state.surface
    lost = np.zeros(usable.size, bool)
    front = optics.mirror.front_film
    images = map_reflections(tracer.geometry, surface, tracer.vertex_z_mm, optics.pattern)
    if front is None or images is None:
        return None, lost

    # The pixels that may show them.
    position_mm = np.array(tracer.position_mm(points))
    place = np.flatnonzero(usable & images.shows_pattern(position_mm))
    some = points.subset(place)
    if not place.size:
        return None, lost
    pixel_mm = float(np.median(some.t_mm)) / tracer.geometry.focal_px
    expected_mm = tracer.predict_screen(some, surface)
    fit = fit_reflections(
        tracer.geometry,
        surface,
        tracer.vertex_z_mm,
        optics.pattern,
        front.bulge_sigma_mm,
        position_mm[:, place],
        some.screen_mm,
        expected_mm,
        pixel_mm,
    )
    if fit is None:
        return None, lost
    seen_mm = some.screen_mm
    lost[place] = remove_reflections(
        fit, optics.pattern, position_mm[:, place], seen_mm, expected_mm, pixel_mm
    )
    points.screen_mm[:, place] = seen_mm
    return fit, lost


def _list_pixels(checked: Checked) -> tuple[IntArray, IntArray, IntArray]:
    """Row, column and bin (n,) of each pixel of bins that have a phase."""
    bin_px = checked.binned.bin_px
    columns = checked.phase_rad.shape[2]
    known = np.isfinite(checked.phase_rad).all(axis=0) & checked.near
    row, column = np.nonzero(np.repeat(np.repeat(known, bin_px, axis=0), bin_px, axis=1))
    in_bin = row // bin_px * columns + column // bin_px
    return row, column, in_bin


def _follow_rays(checked: Checked, column: IntArray, row: IntArray) -> ray_tracing.Points:
    """The points where the rays of pixels meet the surface of the bins; no screen points yet."""
    tracer = checked.tracer
    rays = _trace_pixel_rays(tracer.geometry, column, row)
    points = ray_tracing.Points.from_rays(rays, np.empty((2, column.size)))

    # Newton's steps begin where each ray crosses the plane through the vertex.
    points.t_mm[:] = (tracer.vertex_z_mm - tracer.geometry.pinhole_mm[2]) / points.rays[2]
    tracer.intersect(points, checked.state.surface, newton=4)
    return points


def _sensitivity_rad_per_um(
    optics: OpticsConfig, checked: Checked, film: FilmMotion, points: ray_tracing.Points
) -> FloatArray:
    """Change of the phases (2, n) per µm of the film's motion; 0 if it is not worth correcting.

    Section 7 of docs/explanation/metrology.md.
    """
    if not film.is_worth_correcting:
        return np.zeros((2, points.t_mm.size))
    sensitivity_mm_per_um = film_motion.sensitivity_mm_per_um(
        checked.tracer, points, checked.state.surface
    )
    return np.asarray(sensitivity_mm_per_um / screen_scale.mm_per_rad(optics.pattern))


def _trace_pixel_rays(geometry: Geometry, column: IntArray, row: IntArray) -> FloatArray:
    """Rays of pixels, in parts, because the intermediate results are larger."""
    out = np.empty((3, column.size))
    for start in range(0, column.size, _PART):
        part = slice(start, start + _PART)
        out[:, part] = geometry.rays(column[part], row[part])
    return out


def _axis_phases(
    checked: Checked,
    axis: int,
    index: IntArray,
    in_bin: IntArray,
    sensitivity_rad_per_um: FloatArray,
    motion_um: FloatArray | None,
) -> PixelPhases:
    """Phases of one axis at some pixels, in the period of their bins.

    Parameters
    ----------
    checked : Checked
        The set.
    axis : int
        0 for x, 1 for y.
    index, in_bin : (n,) int arrays
        The pixels, and the bins that they are in.
    sensitivity_rad_per_um : (n,) array
        Change of the phase per µm of the film's displacement.
    motion_um : (N,) array or None
        Displacement of the film at the frames; None: it is not corrected.
    """
    stack = checked.stack
    used = checked.view.used[axis]
    combined = combine_axis_steps(checked, axis, motion_um)

    # The frames of the axis.
    every = stack.sinusoids(pattern_sequence.AXES[axis])
    chosen: slice | list[int] = used
    if used == every:
        chosen = slice(every[0], every[-1] + 1)  # a slice does not copy the frames
    frames = stack.frames[chosen]

    # The phase of its bin chooses each pixel's period.
    reference_rad = checked.phase_rad[axis].reshape(-1)[in_bin]
    gain = None
    if stack.gain is not None:
        gain = stack.gain[used]
    return pixel_phases(
        frames,
        stack.design(used),
        combined,
        index,
        sensitivity_rad_per_um,
        reference_rad,
        checked.binned.clip,
        gain,
        _gather_previous(stack, used),
        stack.lag_shares,
    )


def _gather_previous(stack: FrameStack, used: list[int]) -> Image | None:
    """The frame before each of these, or itself if there is none; None if they show no light of
    it.
    """
    if not any(stack.lag_shares):
        return None
    previous = []
    for frame in used:
        before = stack.frame_before(frame)
        previous.append(frame if before < 0 else before)
    gathered: Image = stack.frames[previous]
    return gathered


def reconstruct_full(
    optics: OpticsConfig,
    checked: Checked,
    pixels: PixelPoints,
    start: ray_tracing.HeightFunction | None = None,
) -> FullResult:
    """Fit the pixels and integrate the residual.

    Derivation: sections 4, 5 and 12 of docs/explanation/metrology.md.

    Parameters
    ----------
    optics : OpticsConfig
        The bench.
    checked : Checked
        The set.
    pixels : PixelPoints
        Its pixels; their weights are replaced.
    start : height function, optional
        The starting shape, by default the paper's parabola of 40 mm.

    Returns
    -------
    FullResult
    """
    tracer = checked.tracer
    points = pixels.points
    radius_mm = optics.mirror.analysis_radius_mm
    tolerance_mm = _LAST_CHANGE_MM * surface_fit.CONTRACTION

    # The bins solve from the start; the pixels continue where that has nearly converged.
    bins = checked.state.points.subset(np.ones(checked.state.index.size, bool))
    begin = start or ray_tracing.make_parabola(_START_SAG_MM, tracer.radius_mm)
    rough = surface_fit.fit_surface(tracer, bins, begin, tolerance_mm=tolerance_mm)

    # Weights by the residual to that surface, then the fit.
    tracer.intersect(points, rough.surface, newton=2)
    residual = np.empty(points.t_mm.size)
    for part, some in points.parts(_PART):
        _, residual[part] = _slope_residual(tracer, some, rough.surface)
    points.weights = tukey_weights(residual)
    normal = NormalMatrix.from_points(tracer, points)
    fit = surface_fit.fit_surface(
        tracer, points, rough.surface, normal=normal, tolerance_mm=tolerance_mm
    )

    # What the terms leave, in cells, integrated.
    tracer.intersect(points, fit.surface)
    cells_of_film = zonal_map.CellSums(points.t_mm.size, radius_mm)
    cells_of_fit = zonal_map.CellSums(points.t_mm.size, radius_mm)
    for _, some in points.parts(_PART):
        field, residual = _slope_residual(tracer, some, fit.surface)
        cells_of_film.add_pixels(field, (residual < _NO_SLOPE).astype(float))
        cells_of_fit.add_pixels(field, some.weights)
    grid = cells_of_film.mean_residual()
    return FullResult(
        fit=replace(fit, changes_mm=(*rough.changes_mm, *fit.changes_mm)),
        index=pixels.index,
        weights=points.weights,
        swing_adu=pixels.swing_adu,
        noise_adu=pixels.noise_adu,
        grid=grid,
        fit_grid=cells_of_fit.mean_residual(),
        residual_mm=zonal_map.integrate_residual(grid),
        quality=set_quality(optics, checked, fit, float(np.median(pixels.swing_adu))),
        moved=pixels.moved,
        reflections=pixels.reflections,
    )


def _slope_residual(
    tracer: ray_tracing.Tracer, points: ray_tracing.Points, surface: Surface
) -> tuple[FloatArray, FloatArray]:
    """Slopes (6, n) of `Tracer.slope_field`, and the distance (n,) of the measured ones from the
    surface's.
    """
    field = tracer.slope_field(points, surface)
    return field, vector_lengths(field[2:4] - field[4:6])


def tukey_weights(residual: FloatArray) -> FloatArray:
    """Tukey's weights (1 - (r / c)^2)^2 of slope residuals r (n,), with c in robust sigmas."""
    # A part of millions of residuals gives their median well enough.
    sigma = float(np.median(residual[::_EVERY])) / _RAYLEIGH_MEDIAN
    reach = _TUKEY_SIGMAS * max(sigma, _LEAST_SLOPE)
    return np.asarray(np.square(np.maximum(1 - np.square(residual / reach), 0.0)))
