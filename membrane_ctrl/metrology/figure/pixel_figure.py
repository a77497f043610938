"""The full result of a checked set: slopes at every pixel, robust fit, and the zonal map of the
residual.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.figure.quantities import SurfaceMap
from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.phase import (
    full_decoder,
    pattern_sequence,
    phase_change,
    phase_steps,
    screen_scale,
)
from membrane_ctrl.metrology.phase.pixel_phases import PixelPhases, pixel_phases
from membrane_ctrl.metrology.rays import ray_tracing
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.reconstruction import film_motion, slope_noise, surface_fit, zonal_map
from membrane_ctrl.metrology.reconstruction.normal_matrix import NormalMatrix
from membrane_ctrl.model.arrays import FloatArray, IntArray, Singles
from membrane_ctrl.model.shape_estimate import Quality

LASER_NOISE_UM = 1.0  # repeatability of the bench's laser
# standard deviation of the film's place: less is hardly seen, and leaves 0.06 µm in the figure
_STILL_UM = 0.2
# motion from x to y over its RMS among the frames of an axis: 3.3 for a random walk, 7.2 for a
# drift, of four steps
X_TO_Y = 5.0
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
    """Everything of one set."""

    # the surface: Hencky excess and Zernike terms; `changes_mm` of all iterations from the start
    fit: surface_fit.Fit
    index: IntArray  # (n,): pixels inside the analysis radius that gave slopes, counted row by row
    weights: FloatArray  # (n,): weight in the fit
    swing_adu: Singles  # (n,): the smaller of the two fringe amplitudes
    # (n,): residual of the frames after the sinusoids: noise, motion, the display's harmonics
    rest_adu: Singles
    grid: zonal_map.ResidualGrid  # mean slope residuals in cells
    residual_mm: (
        FloatArray  # (m, m): height over the fit, 0 at the vertex; NaN where nothing was measured
    )
    quality: Quality  # for the verdict
    moved: bool  # whether the film's motion was corrected

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


def motion_share(within_um: float, noise_um: float) -> float:
    """Share of what a laser tells of the motion from x to y that is motion, if it is so large
    within an axis.
    """
    return (X_TO_Y * within_um) ** 2 / ((X_TO_Y * within_um) ** 2 + noise_um**2)


@dataclass(frozen=True)
class FilmMotion:
    """The film during a set, as laser and fringes tell it."""

    told_um: tuple[
        FloatArray, FloatArray
    ]  # at the used sinusoids of x and of y, about the mean of both
    x_to_y_sigma_um: (
        float  # 1 sigma of the difference between the means of x and of y; NaN without a laser
    )
    noise_um: float  # 1 sigma of the fringes' part in each of these places

    @classmethod
    def of(cls, checked: Checked) -> "FilmMotion":
        """Of a checked set.

        The fringes see the motion from frame to frame of one axis, to a tenth of a micrometre,
        where the laser's noise is one. Of a difference between the axes they make a figure: there
        the laser counts, as far as a film that moves so much from frame to frame moves from one
        axis to the other. What the fringes tell is in part
        noise: only what their scatter has beyond it is motion.
        """
        x, y = checked.view.used
        seen = [axis - axis.mean() for axis in np.split(checked.film_um, [len(x)])]
        within_um2 = float(np.var(np.concatenate(seen)))
        noise_um2 = checked.film_noise_um**2 * (
            1 - 2 / (len(x) + len(y))
        )  # the means of both axes are taken off
        moving = max(1 - noise_um2 / max(within_um2, 1e-12), 0.0)
        readings_um, laser_um = (
            checked.stack.displacement_um,
            LASER_NOISE_UM * math.sqrt(1 / len(x) + 1 / len(y)),
        )
        x_to_y_um = float(readings_um[x].mean() - readings_um[y].mean())
        least, most = (
            motion_share(math.sqrt(part * within_um2), laser_um) for part in (moving, 1.0)
        )
        # noise may hide a motion, which the laser tells by itself where it is beyond 2 sigma
        share = float(np.clip(1 - (2 * laser_um) ** 2 / max(x_to_y_um**2, 1e-12), least, most))
        # the figure is that of all readings' mean, also where a frame is left out
        about_um = readings_um[[*x, *y]].mean() - checked.stack.mean_reading_um
        parts = np.nan_to_num(
            about_um + share * x_to_y_um * np.array([len(y), -len(x)]) / (len(x) + len(y))
        )
        told_um = (moving * seen[0] + parts[0], moving * seen[1] + parts[1])
        sigma_um = math.hypot(math.sqrt(most) * laser_um, (most - share) * x_to_y_um)
        return cls(told_um, sigma_um, checked.film_noise_um)

    @property
    def moved_um(self) -> float:
        """RMS motion."""
        return float(np.std(np.concatenate(self.told_um)))

    @property
    def worth_correcting(self) -> bool:
        """Whether the film moved."""
        return self.moved_um > _STILL_UM


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
    points = ray_tracing.Points.of(_rays(tracer.geometry, column, row), np.empty((2, index.size)))
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


def _rays(geometry: Geometry, column: IntArray, row: IntArray) -> FloatArray:
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
    combined = _combination(checked, axis, told_um)
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
        2**optics.camera.bits - 1,
        gain,
    )


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
    begin = start or ray_tracing.parabola(_START_SAG_MM, tracer.radius_mm)
    rough = surface_fit.solve(tracer, rough_points, begin, tolerance_mm=tolerance)
    tracer.intersect(points, rough.surface, newton=2)
    points.weights[:] = tukey(_slopes_left(tracer, points, rough.surface)[1])
    fit = surface_fit.solve(
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
    return FullResult(
        fit=replace(fit, changes_mm=(*rough.changes_mm, *fit.changes_mm)),
        index=pixels.index,
        weights=points.weights,
        swing_adu=pixels.swing_adu,
        rest_adu=pixels.rest_adu,
        grid=grid,
        residual_mm=zonal_map.integrate(grid),
        quality=_quality(optics, checked, fit, float(np.median(pixels.swing_adu))),
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


def tukey(residual: FloatArray) -> FloatArray:
    """Tukey's weights (1 - (r / c)^2)^2, with c in robust sigmas (median of a Rayleigh
    distribution: 1.177 sigma).
    """
    # every 7th gives the median of millions well enough; the floor is the rounding of a noise-free
    # set
    reach = _TUKEY_SIGMAS * max(float(np.median(residual[::7])) / 1.177, 1e-9)
    return np.asarray(np.square(np.maximum(1 - np.square(residual / reach), 0.0)))


def _quality(
    optics: OpticsConfig, checked: Checked, fit: surface_fit.Fit, swing_adu: float
) -> Quality:
    area = math.pi * optics.mirror.analysis_radius_mm**2
    used = [k for axis in checked.view.used for k in axis]
    saturated = checked.binned.saturated[used].any(axis=0) & checked.near
    seen = (checked.view.mask & checked.near) | saturated
    return Quality(
        modulation_share=swing_adu / (2**optics.camera.bits - 1),
        saturated_fraction=float(np.mean(saturated[seen])) if seen.any() else 0.0,
        valid_fraction=min(1.0, float(np.sum(checked.state.area_mm2)) / area),
        residual_urad=1e6 * math.hypot(fit.residual_x, fit.residual_y) / math.sqrt(2),
        converged=fit.converged,
    )


# The figure of a checked set from its bins, for the analysis of many sets: for Zernike terms the
# bins carry as much as the pixels, at a sixteenth of the cost (decision 41).


@dataclass(frozen=True)
class BinFigure:
    """Surface through the bins of one set."""

    fit: surface_fit.Fit  # Hencky excess and Zernike terms
    points: ray_tracing.Points  # the bins' rays and screen points, standing on the surface
    index: IntArray  # (n,): their bins
    sigma_mm: FloatArray  # (2, n): 1 sigma of the screen points from the noise of the pixels
    quality: Quality  # for the verdict


def bin_figure(optics: OpticsConfig, checked: Checked, film: FilmMotion | None = None) -> BinFigure:
    """Phases of the bins, corrected for the film's motion, and the surface fitted to them."""
    stack, state, film = checked.stack, checked.state, film or FilmMotion.of(checked)
    sums = [checked.binned.means[used].reshape(len(used), -1) for used in checked.view.used]
    told_um = film.told_um if film.worth_correcting else (None, None)
    steps = [_combination(checked, axis, told) for axis, told in enumerate(told_um)]
    followed = np.empty_like(state.accepted)
    # the loop takes any numbers: here means over the bins, hence a bin side of 1 in the
    # combinations
    phase_change.track(
        sums, state.index, steps, state.sensitivity_rad_per_um, state.accepted, followed
    )
    scale = screen_scale.mm_per_rad(optics.pattern)
    points = state.points.subset(np.ones(state.index.size, bool))
    points.screen_mm[:] = followed[:, 0] * scale - state.offset_mm
    fit = surface_fit.solve(checked.tracer, points, state.surface)
    checked.tracer.intersect(points, fit.surface)
    swing = followed[:, 4]
    noise = slope_noise.pixel_sigma_adu(optics.camera.noise_adu) / checked.binned.bin_px
    shifts = [stack.shifts_rad(used) for used in checked.view.used]
    sigma = np.stack(
        [phase_steps.phase_sigma_rad(d, noise, 1.0) / b for d, b in zip(shifts, swing, strict=True)]
    )
    quality = _quality(optics, checked, fit, float(np.median(swing.min(axis=0))))
    return BinFigure(fit, points, state.index, scale * sigma, quality)


def _combination(
    checked: Checked, axis: int, motion_um: FloatArray | None
) -> phase_change.StepCombination:
    """How the means of the usable frames of an axis combine, whose film moved so."""
    used = checked.view.used[axis]
    shifts = checked.stack.shifts_rad(used)
    return film_motion.combine_steps(checked.stack.weights(used), shifts, 1, motion_um)
