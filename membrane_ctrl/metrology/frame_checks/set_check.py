"""Checks the frames of a capture set against each other, and fits a surface to its bins.

Bins of pixels give the fringe orders, a surface, and what each frame should have shown. Frames that
do not belong are left out, one at a time since one bad frame spoils the prediction of the others,
until the rest agree. A set whose frames give no figure is rejected here, with `RejectedSetError`;
verdicts on the figure itself follow from its quality (`model.shape_estimate.judge_quality`).

`figure.pixel_figure` then measures every pixel, its period taken from its bin.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.frame_checks import (
    band_removal,
    bin_view,
    clipping,
    film_image,
    frame_evidence,
    frame_faults,
    frame_inspection,
    image_lag,
    light_response,
    picture_orientation,
    second_reflection,
)
from membrane_ctrl.metrology.frame_checks.bin_orders import absolute_phases_of_bins
from membrane_ctrl.metrology.frame_checks.checked_set import (
    Anchor,
    Checked,
    RejectedSetError,
    vertex_z_mm,
)
from membrane_ctrl.metrology.frame_checks.order_check import confirm_orders
from membrane_ctrl.metrology.phase import frame_stack
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
from membrane_ctrl.metrology.phase.screen_scale import centre_phase_rad, inside_pattern, mm_per_rad
from membrane_ctrl.metrology.rays import ray_tracing
from membrane_ctrl.metrology.rays.film_reflections import find_reflecting_rays
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.reconstruction import bin_grid, tracked_points
from membrane_ctrl.model.arrays import BoolArray, FloatArray
from membrane_ctrl.model.shape_estimate import RESIDUAL_REJECTED_URAD

_ROUNDS = 8  # of fit and inspection; each leaves out one frame or more
_EXCHANGE_ROUNDS = 2  # of a set with two frames exchanged
_MANY_BLAMED = (
    3  # sinusoids that differ from the prediction: it may be the prediction that is wrong
)
# Steps of an axis up to which an exchanged pair cannot be named by what its frames show.
_FEW_STEPS = 3
# Largest difference of light that is called even: it leaves 0.02 µm in the figure, and a blurred
# set seems to differ by as much.
_UNEVEN = 2e-3
_LIGHT_KNOWN = 3e-4  # the same, once the light of the frames is part of the fit
# Bins nearer than this to the pattern's edge are not used to find a frame's light: the edge is
# blurred there.
_BLURRED_RAD = 2.0
_LEAST_INNER = 1 / 2  # share of the bins that must be far enough from the edge
# A ray meets the film this far at most from where it crosses the ring's plane.
_FILM_BESIDE_PLANE_MM = 25.0


def check_set(
    stack: frame_stack.FrameStack, optics: OpticsConfig, anchor: Anchor | None = None
) -> Checked:
    """Check the frames of a set and fit a surface to its bins.

    Derivation: section 12 of docs/explanation/metrology.md.

    Parameters
    ----------
    stack : FrameStack
        The set.
    optics : OpticsConfig
        The bench; `camera.bits` sets saturation.
    anchor : Anchor, optional
        Gives a set without Gray code its fringe orders.

    Returns
    -------
    Checked
        The set without the frames that do not belong, and with swapped ones put back.

    Raises
    ------
    RejectedSetError
        The frames give no figure: too few of them agree, they are clipped, or pictures or pattern
        are turned or mirrored.
    """
    # Bins without the bands of the backlight.
    full_scale_adu = 2**optics.camera.bits - 1
    stack, binned, _ = band_removal.remove_bands(
        stack, frame_stack.bin_frames(stack, full_scale_adu)
    )
    try:
        # Rounds without the frames that do not belong; if these leave no figure, two frames may be
        # exchanged.
        found = _check_rounds(stack, binned, optics, anchor)
    except RejectedSetError as error:
        put_back = _put_back(stack, binned, optics, anchor)
        if put_back is None:
            phase_rad = _phases_alone(stack, binned, optics, anchor)
            _require_stated_orientation(optics, stack, phase_rad, binned.bin_px)
            reason = str(error) + _find_doubt(stack, error.flags)
            raise RejectedSetError(reason, error.flags, error.saturated_fraction) from None
        found = put_back

    # Frames that agree but fit no surface may be exchanged, too.
    if not _is_one_surface(found):
        found = _put_back(stack, binned, optics, anchor) or found
    _require_stated_orientation(optics, stack, found.phase_rad, binned.bin_px)
    return found


def _phases_alone(
    stack: frame_stack.FrameStack,
    binned: frame_stack.Binned,
    optics: OpticsConfig,
    anchor: Anchor | None,
) -> FloatArray | None:
    """Absolute phases (2, rows, columns) of the bins by the frames alone; None if they give none.

    For a set whose frames contradict the geometry: no frame is left out because of it.
    """
    excluded = set(stack.unusable)
    excluded |= {flag.frame for flag in frame_inspection.find_obvious_faults(stack, binned)}
    light = None
    if anchor is not None:
        light = anchor.light
    try:
        view = bin_view.combine_frames(stack, binned, excluded, light)
        return absolute_phases_of_bins(stack, binned, view, anchor, optics)
    except (bin_view.NoFigureError, ValueError):
        return None


def _require_stated_orientation(
    optics: OpticsConfig, stack: frame_stack.FrameStack, phase_rad: FloatArray | None, bin_px: int
) -> None:
    """Raise RejectedSetError if pictures or pattern are turned or mirrored."""
    if phase_rad is None:
        return
    row, column = np.indices(phase_rad.shape[1:]).reshape(2, -1)
    places_px = np.asarray(bin_px * np.stack([column, row]) + (bin_px - 1) / 2, float)
    at_z_mm = vertex_z_mm(optics, stack.mean_reading_um)
    orientation = picture_orientation.find_orientation(
        optics, at_z_mm, places_px, phase_rad.reshape(2, -1)
    )
    if orientation is not None:
        raise RejectedSetError(orientation.describe(), ())


def _find_doubt(stack: frame_stack.FrameStack, flags: tuple[frame_faults.Flag, ...]) -> str:
    """The doubt that the geometry is wrong, if many frames differ from what it predicts; else "".

    Pictures that are the same, unreadable or dark need no prediction.
    """
    blamed = [flag for flag in _of_sinusoids(stack, flags) if flag.defect.is_found_by_prediction]
    if len(blamed) < _MANY_BLAMED:
        return ""
    return "; with this many frames blamed, check the geometry and the axes of these pictures"


def _is_one_surface(checked: Checked) -> bool:
    """Whether the slopes are those of one surface.

    Phase steps that run backwards agree with each other, but their slopes fit no surface.
    """
    field = checked.tracer.slope_field(checked.state.points, checked.state.surface)
    measured = field[2:4]
    fitted = field[4:6]
    residual_urad = 1e6 * float(np.sqrt(np.mean(np.square(measured - fitted))))
    return residual_urad <= RESIDUAL_REJECTED_URAD


def _put_back(
    stack: frame_stack.FrameStack,
    binned: frame_stack.Binned,
    optics: OpticsConfig,
    anchor: Anchor | None,
) -> Checked | None:
    """The set with two sinusoids of an axis exchanged, if one exchange alone makes all frames
    agree.

    Three steps that run backwards predict every frame wrongly, so no frame can be blamed for what
    it shows. The Gray code and the surface decide: of all exchanges only the right one leaves no
    frame to be flagged. Of four steps, the good ones show which two are swapped.
    """
    if stack.unusable or len(stack.sinusoids(AXES[0])) > _FEW_STEPS:
        return None

    # Each exchange of two sinusoids of an axis is tried.
    found: list[Checked] = []
    pairs = [pair for axis in AXES for pair in combinations(stack.sinusoids(axis), 2)]
    for a, b in pairs:
        order = _exchange(len(stack.patterns), a, b)
        try:
            checked = _check_rounds(
                stack.exchange_frames(order),
                binned.exchange_frames(order),
                optics,
                anchor,
                _EXCHANGE_ROUNDS,
            )
        except RejectedSetError:
            continue
        if not checked.flags and _is_one_surface(checked):
            # The two frames are named; the set itself is sound.
            flags = (
                _flag_swapped(a, stack.patterns[b].name, b),
                _flag_swapped(b, stack.patterns[a].name, a),
            )
            found.append(replace(checked, flags=flags))

    # Only a unique one is the cause.
    if len(found) == 1:
        return found[0]
    return None


def _exchange(count: int, a: int, b: int) -> list[int]:
    """The order of so many frames with two of them exchanged."""
    order = list(range(count))
    order[a] = b
    order[b] = a
    return order


def _flag_swapped(frame: int, shown: str, swapped_with: int) -> frame_faults.Flag:
    return frame_faults.Flag(
        frame, frame_faults.FrameDefect.SWAPPED, f"swapped with {shown}", math.inf, swapped_with
    )


def _check_rounds(
    stack: frame_stack.FrameStack,
    binned: frame_stack.Binned,
    optics: OpticsConfig,
    anchor: Anchor | None,
    rounds: int = _ROUNDS,
) -> Checked:
    """Fit, inspect and leave out in a limited number of rounds. Raises RejectedSetError.

    A round ends in one of four ways: it leaves out frames, it exchanges two, it repeats the fit
    with the light that each frame had, or it accepts the set.
    """
    bench = _Bench.from_optics(optics, binned.bin_px, anchor)
    taken = binned  # as the camera took them

    # Frames that are bad without any prediction.
    known = {
        frame: frame_faults.flag_unreadable(frame, reason)
        for frame, reason in stack.unusable.items()
    }
    known |= {flag.frame: flag for flag in frame_inspection.find_obvious_faults(stack, binned)}
    excluded = set(known)

    flags: list[frame_faults.Flag] = []
    for done in range(rounds + 1):
        # Fit the surface without the excluded frames.
        try:
            stack, binned, attempt, lag = _attempt_without_lag(stack, taken, bench, excluded)
        except (bin_view.NoFigureError, ValueError) as error:
            named = _merge_flags(_keep_believable(stack, flags), known)
            raise _explain_no_figure(stack, binned, bench, excluded, named, error) from None

        # Compare every frame with what that surface predicts.
        readable = [k for k in range(len(stack.patterns)) if k not in stack.unusable]
        evidence = frame_evidence.measure_frames(stack, binned, attempt.scene, readable)
        flags = frame_inspection.inspect_frames(stack, evidence, excluded)
        fresh = [flag for flag in flags if flag.frame not in excluded]

        if not fresh:
            # All frames agree. If their light differs, repeat the fit with the light of each.
            seen = _estimate_light_and_film(stack, binned, attempt, optics)
            light_error = seen.light - (1.0 if stack.light is None else stack.light)
            allowed = _UNEVEN
            if stack.light is not None:
                allowed = _LIGHT_KNOWN
            if np.abs(light_error).max() > allowed and done < rounds:
                stack = replace(stack, light=seen.light)
                continue
            named = _merge_flags(flags, known)
            confirm_orders(stack, attempt.phase_rad, binned, attempt.view, excluded, named)
            used = [k for frames in attempt.view.used for k in frames]
            checked = Checked(
                stack,
                binned,
                attempt.view,
                attempt.phase_rad,
                bench.near.reshape(attempt.view.mask.shape),
                attempt.tracer,
                attempt.state,
                named,
                seen.film_um,
                seen.film_noise_um,
                seen.shifts,
                light_left=float(np.sqrt(np.mean(np.square(light_error[:, used])))),
                lag=lag,
            )
            return _measure_light_path(checked, attempt.scene, excluded, optics, anchor)

        # Two frames that show each other's pictures are exchanged, and both stay in use.
        pair = _find_swapped_pair(fresh, known)
        if pair is not None:
            order = _exchange(len(stack.patterns), *pair)
            stack = stack.exchange_frames(order)
            taken = taken.exchange_frames(order)
            known |= {flag.frame: flag for flag in flags if flag.frame in pair}
            continue

        # The worst sinusoid alone may spoil the predictions of the others.
        worst = _of_sinusoids(stack, fresh)[:1]
        chosen = {flag.frame: flag for flag in worst or fresh}
        known |= chosen
        excluded |= set(chosen)
    reason = "the frames do not agree, whichever are left out"
    raise RejectedSetError(reason, _merge_flags(_keep_believable(stack, flags), known))


def _explain_no_figure(
    stack: frame_stack.FrameStack,
    binned: frame_stack.Binned,
    bench: "_Bench",
    excluded: set[int],
    flags: tuple[frame_faults.Flag, ...],
    error: Exception,
) -> RejectedSetError:
    """The rejection of a set that has no fit: clipped bins are the cause if there are many."""
    used = [k for axis in AXES for k in stack.sinusoids(axis) if k not in excluded]
    near = bench.near.reshape(binned.means[0].shape)
    clipped = clipping.clipped_shares_of_lit(binned, used, near)
    return RejectedSetError(clipped.cause or str(error), flags, clipped.white)


def _estimate_light_and_film(
    stack: frame_stack.FrameStack,
    binned: frame_stack.Binned,
    attempt: "_Attempt",
    optics: OpticsConfig,
) -> frame_evidence.LightAndFilm:
    """As `frame_evidence.estimate_light_and_film`, away from the pattern's edge where possible."""
    scene = attempt.scene
    is_inner = np.all(inside_pattern(scene.phase_rad, optics.pattern, _BLURRED_RAD), axis=0)
    if np.mean(is_inner) > _LEAST_INNER:
        scene = scene.select_bins(is_inner)
    phase_rad = attempt.phase_rad.reshape(2, -1)
    return frame_evidence.estimate_light_and_film(
        stack, binned, scene, attempt.view.used, phase_rad
    )


def _measure_light_path(
    checked: Checked,
    scene: frame_evidence.SampledBins,
    excluded: set[int],
    optics: OpticsConfig,
    anchor: Anchor | None,
) -> Checked:
    """The set with what its frames show of second images, and of the response to light."""
    second = second_reflection.find_second_reflection(
        checked.stack, checked.binned, scene, excluded, optics.pattern
    )
    position_mm = np.array(checked.tracer.position_mm(checked.state.points))
    response = light_response.estimate_response(
        checked.stack,
        checked.binned,
        checked.state.index,
        position_mm / optics.mirror.radius_mm,
        excluded,
        checked.view.used,
    )
    image = _find_film_image(checked, excluded, optics, anchor)
    return replace(checked, second=second, response=response, image=image)


def _find_film_image(
    checked: Checked, excluded: set[int], optics: OpticsConfig, anchor: Anchor | None
) -> film_image.FilmImage:
    """A second reflection of the screen in a part of the mirror, if the bench has no front film.

    By white and black of the set, or of the set that it refers to, or else by the mean light of
    its fringes.
    """
    geometry = checked.tracer.geometry
    if geometry.cushion is not None:
        return film_image.NO_FILM_IMAGE
    pair = checked.stack.white_and_black(excluded)
    if pair is not None:
        white, black = pair
        light = checked.binned.means[white].astype(float) - checked.binned.means[black]
        evidence = film_image.ImageEvidence.WHITE_AND_BLACK
    elif anchor is not None and anchor.image.evidence is film_image.ImageEvidence.WHITE_AND_BLACK:
        return anchor.image
    else:
        light = checked.view.light
        evidence = film_image.ImageEvidence.MEAN_LIGHT

    # Bins on the mirror, about where their rays cross the middle of the bowl's depth.
    index = np.flatnonzero(checked.view.mask & checked.near)
    rays = geometry.rays(*checked.places_px(index))
    depth_mm = checked.state.surface.sag_mm / 2
    t = (depth_mm - geometry.pinhole_mm[2]) / rays[2]
    position_mm = geometry.pinhole_mm[:2, None] + t * rays[:2]
    on_film = np.hypot(*position_mm) < optics.mirror.analysis_radius_mm
    index = index[on_film]
    swing = checked.view.swing_adu.mean(axis=0)
    return film_image.find_film_image(
        (light.shape[0], light.shape[1]),
        index,
        position_mm[:, on_film],
        light.reshape(-1)[index],
        swing.reshape(-1)[index],
        evidence,
    )


def _find_swapped_pair(
    fresh: list[frame_faults.Flag], known: dict[int, frame_faults.Flag]
) -> tuple[int, int] | None:
    """The first two frames that show each other's pictures, unless one has been flagged before."""
    for flag in fresh:
        if flag.swapped_with is not None:
            pair = (flag.frame, flag.swapped_with)
            if set(pair) & set(known):
                return None
            return pair
    return None


@dataclass(frozen=True)
class _Attempt:
    """One fit of the bins.

    Attributes
    ----------
    view : BinView
        What the usable frames show of each bin.
    phase_rad : (2, rows, columns) array
        Absolute phases of the bins.
    tracer : Tracer
        The bench.
    state : TrackedPoints
        The bins on the mirror, and their surface.
    scene : SampledBins
        The same bins, with the phases that this surface predicts.
    """

    view: bin_view.BinView
    phase_rad: FloatArray
    tracer: ray_tracing.Tracer
    state: tracked_points.TrackedPoints
    scene: frame_evidence.SampledBins


@dataclass(frozen=True)
class _Bench:
    """What all attempts to fit a set share.

    Attributes
    ----------
    near : (bins,) bool array
        Bins whose rays may meet the mirror.
    reflecting : (bins,) bool array
        Bins in which a front film may show the pattern again: the surface is fitted without them.
    """

    optics: OpticsConfig
    geometry: Geometry
    grid: bin_grid.BinGrid
    near: BoolArray
    reflecting: BoolArray
    anchor: Anchor | None

    @classmethod
    def from_optics(cls, optics: OpticsConfig, bin_px: int, anchor: Anchor | None) -> "_Bench":
        """Return the bench of sets with bins of this side.

        Parameters
        ----------
        optics : OpticsConfig
            The stated bench.
        bin_px : int
            Side of the bins.
        anchor : Anchor or None
            Fringe orders of another set.
        """
        geometry = Geometry.from_config(optics)
        grid = bin_grid.BinGrid(geometry, optics.camera, bin_px)
        near = grid.near_mirror(optics.mirror.analysis_radius_mm + _FILM_BESIDE_PLANE_MM)
        reflecting = find_reflecting_rays(geometry, optics, grid.rays)
        return cls(optics, geometry, grid, near, reflecting, anchor)


def _attempt_without_lag(
    stack: frame_stack.FrameStack,
    taken: frame_stack.Binned,
    bench: _Bench,
    excluded: set[int],
) -> tuple[frame_stack.FrameStack, frame_stack.Binned, _Attempt, image_lag.ImageLag]:
    """Fit the bins without what the frames show of the previous ones.

    Returns the stack that states those shares, the bins without them, the fit, and the shares.
    Raises NoFigureError or ValueError if there is no fit.
    """
    stack = replace(stack, lag_shares=(0.0, 0.0))
    binned = taken
    lag = image_lag.ImageLag.unknown()
    attempt = _attempt_fit(stack, binned, bench, excluded)
    for _ in range(image_lag.ROUNDS):
        # The light and the phases to compare with contain the lag, too: each fit finds a part of
        # it.
        found = image_lag.estimate_image_lag(stack, binned, attempt.scene, excluded)
        lag = image_lag.add_image_lag(lag, found)
        if not lag.corrected or not image_lag.is_worth_another_round(found):
            break
        if not any(stack.lag_shares):
            stack = image_lag.add_first_predecessor(stack, taken, attempt.scene, lag)
        stack = replace(stack, lag_shares=(lag.rise, lag.fall))
        binned = image_lag.remove_image_lag(stack, taken, lag)
        attempt = _attempt_fit(stack, binned, bench, excluded)
    return stack, binned, attempt, lag


def _attempt_fit(
    stack: frame_stack.FrameStack,
    binned: frame_stack.Binned,
    bench: _Bench,
    excluded: set[int],
) -> _Attempt:
    """Fit the bins without the excluded frames. Raises NoFigureError or ValueError if that
    fails.
    """
    optics = bench.optics
    anchor = bench.anchor
    vertex_mm = vertex_z_mm(optics, stack.mean_reading_um)
    tracer = ray_tracing.Tracer(bench.geometry, optics.mirror.radius_mm, vertex_mm)

    # Light, wrapped and absolute phases of the bins.
    light_of_anchor = None
    if anchor is not None:
        light_of_anchor = anchor.light
    view = bin_view.combine_frames(stack, binned, excluded, light_of_anchor)
    phase_rad = absolute_phases_of_bins(stack, binned, view, anchor, optics)

    # The surface that explains them.
    candidates = np.flatnonzero(bench.near & ~bench.reflecting)
    phase_of_candidates_rad = phase_rad.reshape(2, -1)[:, candidates]
    state = tracked_points.select_points(
        bench.grid,
        tracer,
        candidates,
        phase_of_candidates_rad,
        optics.pattern,
        optics.mirror.analysis_radius_mm,
    )

    # What it predicts.
    screen_mm = tracer.predict_screen(state.points, state.surface)
    predicted_rad = screen_mm / mm_per_rad(optics.pattern) + centre_phase_rad(optics.pattern)
    light = view.light.reshape(-1)[state.index]
    places_px = np.stack([bench.grid.column_px, bench.grid.row_px])[:, state.index]
    scene = frame_evidence.SampledBins(
        state.index, light, predicted_rad, state.sensitivity_rad_per_um, places_px
    )
    return _Attempt(view, phase_rad, tracer, state, scene)


def _of_sinusoids(
    stack: frame_stack.FrameStack, flags: Iterable[frame_faults.Flag]
) -> list[frame_faults.Flag]:
    """The flags of sinusoids."""
    return [flag for flag in flags if stack.patterns[flag.frame].role == "sin"]


def _keep_believable(
    stack: frame_stack.FrameStack, flags: list[frame_faults.Flag]
) -> list[frame_faults.Flag]:
    """While sinusoids are wrong the prediction may be wrong too: then only they are named."""
    return _of_sinusoids(stack, flags) or flags


def _merge_flags(
    flags: list[frame_faults.Flag], known: dict[int, frame_faults.Flag]
) -> tuple[frame_faults.Flag, ...]:
    """All flags in the order of the frames.

    The latest inspection takes precedence, except over frames that were exchanged; earlier findings
    remain.
    """
    named = dict(known)
    for flag in flags:
        if known.get(flag.frame, flag).swapped_with is None:
            named[flag.frame] = flag
    return tuple(named[frame] for frame in sorted(named))
