"""The error budget of one set, widened by the set's own consistency checks."""

import math
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.config.optics import OpticsConfig, SigmasConfig
from membrane_ctrl.metrology.figure.pixel_figure import FullResult
from membrane_ctrl.metrology.figure.set_motion import LASER_NOISE_UM
from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
from membrane_ctrl.metrology.rays.rim_outline import Outline
from membrane_ctrl.metrology.uncertainty import (
    bench_sources,
    budget,
    frame_effects,
    image_blur,
    residual_patches,
    trial_bench,
)
from membrane_ctrl.metrology.uncertainty.film_motion_rows import find_film_motion_rows
from membrane_ctrl.metrology.uncertainty.film_shape_error import film_shape_sources
from membrane_ctrl.metrology.uncertainty.front_film_error import front_film_sources
from membrane_ctrl.metrology.uncertainty.geometry_spread import GeometrySpread
from membrane_ctrl.metrology.uncertainty.image_lag_error import image_lag_sources
from membrane_ctrl.metrology.uncertainty.laser_errors import vertex_um
from membrane_ctrl.metrology.uncertainty.pair_motion import PairMotion, motion_changes
from membrane_ctrl.metrology.uncertainty.phase_drift_error import phase_drift_source
from membrane_ctrl.metrology.uncertainty.reflection_error import find_reflection_error
from membrane_ctrl.metrology.uncertainty.response_harmonics import find_response_harmonics
from membrane_ctrl.metrology.uncertainty.response_wave_error import estimate_response_waves
from membrane_ctrl.metrology.uncertainty.rim_check import RimMisfit, measure_rim_misfit
from membrane_ctrl.metrology.uncertainty.second_reflection_error import second_reflection_source
from membrane_ctrl.metrology.uncertainty.set_moment import moment_source
from membrane_ctrl.metrology.uncertainty.slope_misfit import SlopeMisfit, measure_slope_misfit
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench

_BLUR_UM = 0.5  # RMS of the height beyond which a picture is out of focus


@dataclass(frozen=True)
class SetBudget:
    """Budget of a figure, and the results of its consistency checks.

    Attributes
    ----------
    budget : Budget
        The rows.
    doubts : tuple of str
        Why the figure is degraded, and what to do, for people.
    rim : RimMisfit or None
        The rim against the geometry's prediction; None if the picture does not show it.
    slopes : SlopeMisfit
        Slopes that belong to no surface.
    zero_reflections_um : float
        1 sigma of the map's zero by a front film's reflections.
    """

    budget: budget.Budget
    doubts: tuple[str, ...]
    rim: RimMisfit | None
    slopes: SlopeMisfit
    zero_reflections_um: float = 0.0


def assemble_budget(
    optics: OpticsConfig,
    checked: Checked,
    full: FullResult,
    spread: GeometrySpread,
    noise_adu: float,
    outline: Outline | None,
) -> SetBudget:
    """Assemble the error budget of a measured set.

    Parameters
    ----------
    optics : OpticsConfig
        The bench.
    checked : Checked
        The set.
    full : FullResult
        Its figure.
    spread : GeometrySpread
        Covariance of the geometry; the budget is widened if the rim contradicts it.
    noise_adu : float
        Noise of a pixel.
    outline : Outline or None
        The rim in the picture, if it is visible.

    Returns
    -------
    SetBudget

    Raises
    ------
    ArithmeticError
        If the spread is so wide that a fit does not converge.
    """
    shifts = [checked.stack.shifts_rad(used) for used in checked.view.used]
    bench = _make_bench(optics, checked)
    sigmas = optics.geometry.sigmas or SigmasConfig()
    disc = optics.mirror.analysis_radius_mm / optics.mirror.radius_mm

    # Motion of the film from x to y, and from frame to frame.
    noise_mm2 = full.screen_variance_mm2(optics, shifts, noise_adu) / checked.binned.bin_px**2
    film = find_film_motion_rows(bench, checked, spread, sigmas.laser_relative, noise_mm2)
    doubts = list(film.doubts)
    moment = moment_source(checked, film.motion, film.unseen, optics.mirror.radius_mm)
    moment_rows = [] if moment is None else [moment]

    # The geometry against the rim in the picture, and against slopes that no surface has.
    rim = None
    widening = 1.0
    if outline is not None:
        rim = measure_rim_misfit(bench, spread, outline)
        widening = rim.widening
    slopes = measure_slope_misfit(bench, spread, full.grid, full.residual_mm)
    used = [len(frames) for frames in checked.view.used]
    taken = [len(checked.stack.sinusoids(axis)) for axis in AXES]
    exponent = checked.response.exponent
    slopes = replace(slopes, harmonics=find_response_harmonics(bench, used, taken, exponent))

    # Blur. It follows from the contrast and the slopes of the fitted surface: if these are not
    # those of a surface, the contrast shows no blur; nor if it has waves of the response, because a
    # frame is left out.
    blur = image_blur.blur_source(bench, checked.blur_px)
    is_blurred = budget.Budget((blur,), disc).total()["height_rms_um"] > _BLUR_UM
    shows_blur = not slopes.contradicts and slopes.harmonics is None
    if is_blurred and shows_blur:
        doubts.append(f"the picture is blurred by {blur.sigma:.1f} px (1 sigma): focus the camera")

    # What is left of a front film's reflections. Where they could not be fitted, the middle is left
    # out, and the zero is where the map begins: as far off as the residual is from the fit.
    reflection_rows = []
    zero_um = 0.0
    if full.reflections is not None:
        left = find_reflection_error(
            full.reflections, checked.tracer, full.surface, full.fit.normal.inverse
        )
        if left is None:
            zero_um = 1e3 * float(np.nanstd(full.residual_mm))
        else:
            reflection_rows.append(left.source)
            zero_um = left.zero_um

    # One row for each input.
    slope_variance = full.slope_variance(optics, shifts, noise_adu)
    light = math.hypot(frame_effects.LIGHT, checked.light_left)
    waves = estimate_response_waves(bench, max(used))
    changes_mm = motion_changes(bench)
    sources = [
        *bench_sources.geometry_sources(bench, spread, widening),
        *bench_sources.bench_sources(bench, sigmas),
        *film.rows,
        *moment_rows,
        phase_drift_source(bench, changes_mm, checked.shifts),
        _vertex_source(bench, sigmas, checked, film.rows[0].sigma),
        *film_shape_sources(full, slope_variance),
        blur,
        *frame_effects.frame_sources(bench, optics, shifts, film.frame_to_frame_um, light),
        second_reflection_source(bench, checked.second),
        *front_film_sources(bench),
        *reflection_rows,
        *image_lag_sources(bench, checked.stack, checked.view.used, checked.lag),
        waves.source,
        *residual_patches.pixel_sources(full, slope_variance, noise_adu, waves.share),
    ]
    whole = budget.Budget(tuple(sources), disc, PairMotion.from_changes(bench, changes_mm))
    return SetBudget(whole, tuple(doubts), rim, slopes, zero_um)


def _make_bench(optics: OpticsConfig, checked: Checked) -> TrialBench:
    """A trial bench of some of the set's bins, without noise, which has a separate row."""
    state = checked.state
    return TrialBench.from_points(
        optics,
        checked.tracer,
        state.surface,
        state.points,
        checked.places_px(state.index),
        np.zeros((2, state.index.size)),
        trial_bench.TRIAL_POINTS,
    )


def _vertex_source(
    bench: TrialBench, sigmas: SigmasConfig, checked: Checked, moved_um: float
) -> budget.Source:
    """The row for the place of the vertex.

    Without a laser, half a motion `moved_um` from x to y is in the frames' mean.
    """
    readings_um = checked.stack.readings_um
    noise_um = vertex_um(readings_um, LASER_NOISE_UM)
    if not np.isfinite(readings_um).all():
        description = "place of the vertex, without a laser"
        return bench_sources.vertex_source(bench, math.hypot(noise_um, moved_um / 2), description)
    scale_um = 1e3 * sigmas.laser_relative * abs(bench.vertex_z_mm)
    description = "place of the vertex, by the laser's noise and scale"
    return bench_sources.vertex_source(bench, math.hypot(noise_um, scale_um), description)
