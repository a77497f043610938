"""The error budget of one set, widened by the set's own consistency checks."""

import math
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.config.optics import OpticsConfig, SigmasConfig
from membrane_ctrl.metrology.figure.pixel_figure import FullResult
from membrane_ctrl.metrology.figure.set_motion import (
    LASER_NOISE_UM,
    FilmMotion,
)
from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.phase import screen_scale
from membrane_ctrl.metrology.rays.rim_outline import Outline
from membrane_ctrl.metrology.uncertainty import (
    bench_sources,
    budget,
    frame_effects,
    image_blur,
    residual_patches,
    trial_bench,
)
from membrane_ctrl.metrology.uncertainty.film_shape_error import film_shape_sources
from membrane_ctrl.metrology.uncertainty.geometry_spread import GeometrySpread
from membrane_ctrl.metrology.uncertainty.held_light_error import held_light_source
from membrane_ctrl.metrology.uncertainty.image_blur import estimate_blur_px
from membrane_ctrl.metrology.uncertainty.laser_errors import vertex_um
from membrane_ctrl.metrology.uncertainty.pair_motion import PairMotion
from membrane_ctrl.metrology.uncertainty.rim_check import RimMisfit, measure_rim_misfit
from membrane_ctrl.metrology.uncertainty.second_reflection_error import second_reflection_source
from membrane_ctrl.metrology.uncertainty.set_moment import moment_source
from membrane_ctrl.metrology.uncertainty.slope_misfit import SlopeMisfit, measure_slope_misfit
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench
from membrane_ctrl.metrology.uncertainty.unseen_motion import (
    UnseenMotion,
    estimate_unseen_motion,
)

_BLUR_UM = 0.5  # RMS of the height: a picture is out of focus, not only seen through a lens
# the fringes' error in the film's place at a frame, the share of a motion within an axis that its
# correction leaves, and that of a motion from x to y: a lens of a data sheet is 1 % off
_SEEN_UM, _SEEN_SHARE, _TOLD_SHARE = 0.1, 0.05, 0.02


@dataclass(frozen=True)
class SetBudget:
    """Budget of a figure, and what makes it doubtful.

    Attributes
    ----------
    budget : Budget
        The rows.
    doubts : tuple of str
        What the frames say against the figure, and what to do.
    rim : RimMisfit or None
        What the rim says of the geometry; None if the picture does not show it.
    slopes : SlopeMisfit
        Slopes that belong to no surface.
    """

    budget: budget.Budget
    doubts: tuple[str, ...]
    rim: RimMisfit | None
    slopes: SlopeMisfit


def assemble_budget(
    optics: OpticsConfig,
    checked: Checked,
    full: FullResult,
    spread: GeometrySpread,
    noise_adu: float,
    outline: Outline | None,
) -> SetBudget:
    """The budget, widened by what the set says of itself. Raises ArithmeticError if the spread is
    too wide.
    """
    state, shifts = checked.state, [checked.stack.shifts_rad(used) for used in checked.view.used]
    exact, places_px = np.zeros((2, state.index.size)), checked.places_px(state.index)
    bench = TrialBench.of_points(
        optics,
        checked.tracer,
        state.surface,
        state.points,
        places_px,
        exact,
        trial_bench.TRIAL_POINTS,
    )
    sigmas = optics.geometry.sigmas or SigmasConfig()
    moved = FilmMotion.of(checked)
    unseen = None
    if not math.isfinite(moved.x_to_y_sigma_um):
        unseen = estimate_unseen_motion(bench, spread)
    film, doubts = _film_source(bench, moved, unseen)
    blur = image_blur.blur_source(bench, _blur_px(optics, checked))
    disc = optics.mirror.analysis_radius_mm / optics.mirror.radius_mm
    rim = None if outline is None else measure_rim_misfit(bench, spread, outline)
    slopes = measure_slope_misfit(bench, spread, full.grid, full.residual_mm)
    # Contrast is compared with the slopes of the fitted surface: where these are not those of a
    # surface, it shows no blur.
    is_blurred = budget.Budget((blur,), disc).total()["height_rms_um"] > _BLUR_UM
    if is_blurred and not slopes.contradicts:
        doubts.append(f"the picture is blurred by {blur.sigma:.1f} px (1 sigma): focus the camera")
    slope_variance = full.slope_variance(optics, shifts, noise_adu)
    sources = [
        *bench_sources.geometry_sources(bench, spread, 1.0 if rim is None else rim.widening),
        *bench_sources.bench_sources(bench, sigmas),
        *film,
        *filter(None, [moment_source(checked, moved, unseen, optics.mirror.radius_mm)]),
        _vertex_source(bench, sigmas, checked, film[0].sigma),
        *film_shape_sources(full, slope_variance),
        blur,
        *frame_effects.frame_sources(
            bench,
            optics,
            shifts,
            _film_um(moved),
            math.hypot(frame_effects.LIGHT, checked.light_left),
        ),
        second_reflection_source(bench, checked.second),
        held_light_source(bench, checked.stack, checked.view.used, checked.held),
        *residual_patches.pixel_sources(full, slope_variance, noise_adu),
    ]
    whole = budget.Budget(tuple(sources), disc, PairMotion.of(bench))
    return SetBudget(whole, tuple(doubts), rim, slopes)


def _blur_px(optics: OpticsConfig, checked: Checked) -> float:
    state, shape = checked.state, checked.phase_rad.shape[1:]
    screen_mm = checked.tracer.predict_screen(state.points, state.surface)
    predicted_rad = screen_mm / screen_scale.mm_per_rad(optics.pattern)
    swings = checked.view.swing_adu.reshape(2, -1)[:, state.index]
    return estimate_blur_px(
        predicted_rad, swings, state.index, (shape[0], shape[1]), checked.binned.bin_px
    )


def _vertex_source(
    bench: TrialBench, sigmas: SigmasConfig, checked: Checked, moved_um: float
) -> budget.Source:
    """Where the vertex is: by the laser, or nobody knows; half a motion from x to y is in the
    frames' mean.
    """
    readings = checked.stack.readings_um
    noise_um = vertex_um(readings, LASER_NOISE_UM)
    if not np.isfinite(readings).all():
        return bench_sources.vertex_source(
            bench, math.hypot(noise_um, moved_um / 2), "place of the vertex, without a laser"
        )
    scale_um = 1e3 * sigmas.laser_relative * abs(bench.vertex_z_mm)
    says = "place of the vertex, by the laser's noise and scale"
    return bench_sources.vertex_source(bench, math.hypot(noise_um, scale_um), says)


def _film_um(film: FilmMotion) -> float:
    """RMS motion of the film left in the phases of the frames."""
    left = (_SEEN_UM, _SEEN_SHARE * film.moved_um) if film.worth_correcting else (film.moved_um,)
    return math.hypot(*left, film.noise_um)


def _film_source(
    bench: TrialBench, film: FilmMotion, moved: UnseenMotion | None
) -> tuple[list[budget.Source], list[str]]:
    """The film's motion from x to y: by the laser, else by the fringes."""
    if moved is None:
        left = _TOLD_SHARE if film.worth_correcting else 1.0
        sigma_um = math.hypot(
            film.x_to_y_sigma_um, left * float(film.told_um[0].mean() - film.told_um[1].mean())
        )
        says = "motion of the film from x to y, by the laser"
        return [bench_sources.film_source(bench, (sigma_um,), says, paired=False)], []
    says = "motion of the film from x to y, without a laser"
    source = bench_sources.film_source(bench, (moved.moved_um, moved.shared_um), says, paired=True)
    says = "noise of the fringes that show the film's motion from x to y"
    noise = replace(
        bench_sources.film_source(bench, (moved.noise_um,), says, paired=False), name="film_seen_um"
    )
    if not moved.sure:
        return [source, noise], []
    says = (
        f"the film moved by {moved.moved_um:+.0f} +- {moved.sigma_um:.0f} µm from the x to the y "
        "frames"
    )
    return [source, noise], [f"{says}, seen in the fringes: record the laser's readings"]
