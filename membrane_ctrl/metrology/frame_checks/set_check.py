"""The full result of a capture set: frames checked, every pixel's phase and slopes, the fit, and
the zonal map.

Bins come first: they give the fringe orders, a surface, and what each frame should have shown.
Frames that do not belong are left out, one at a time since one bad frame spoils the prediction of
the others, until the rest agree. Then every pixel is measured, its period taken from its bin.
"""

import math
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.frame_checks import (
    band_removal,
    bin_view,
    clipping,
    frame_evidence,
    frame_faults,
    frame_inspection,
    held_light,
    light_response,
    picture_orientation,
    second_reflection,
)
from membrane_ctrl.metrology.frame_checks.bin_orders import absolute_phases_of_bins, confirm_orders
from membrane_ctrl.metrology.frame_checks.checked_set import (
    Anchor,
    Checked,
    RejectedSetError,
    vertex_z_mm,
)
from membrane_ctrl.metrology.phase import frame_stack
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
from membrane_ctrl.metrology.phase.screen_scale import centre_phase_rad, inside_pattern, mm_per_rad
from membrane_ctrl.metrology.rays import ray_tracing
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.reconstruction import bin_grid, tracked_points
from membrane_ctrl.model.arrays import BoolArray, FloatArray
from membrane_ctrl.model.shape_estimate import RESIDUAL_REJECTED_URAD

_ROUNDS = 8
_MANY_BLAMED = 3
# Below, the light is called even: it leaves 0.02 µm in the figure, and a blurred set seems to
# differ by as much.
_UNEVEN = 2e-3
# from the pattern's edge: a blurred picture of it says nothing of a frame's light
_BLURRED_RAD = 2.0
_LIGHT_KNOWN = 3e-4  # what another round would change, once it is not even
# the ring's plane is crossed this far at most from where the ray meets the film
_FILM_BESIDE_PLANE_MM = 25.0


def check_set(
    stack: frame_stack.FrameStack, optics: OpticsConfig, anchor: Anchor | None = None
) -> Checked:
    """Check the frames and fit the bins. Raises RejectedSetError if the frames do not give a
    figure.

    `anchor` gives a set without Gray code its fringe orders; `camera.bits` of the optics sets
    saturation.
    """
    stack, binned, _ = band_removal.remove_bands(
        stack, frame_stack.bin_frames(stack, 2**optics.camera.bits - 1)
    )
    try:
        found = _check_rounds(stack, binned, optics, anchor)
    except RejectedSetError as error:
        put_back = _put_back(stack, binned, optics, anchor)
        if put_back is None:
            phase_rad = _phases_alone(stack, binned, optics, anchor)
            _require_stated_orientation(optics, stack, phase_rad, binned.bin_px)
            reason = str(error) + _find_doubt(stack, error.flags)
            raise RejectedSetError(reason, error.flags, error.saturated_fraction) from None
        found = put_back
    if not _believable_surface(found):
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
    light = None if anchor is None else anchor.light
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
    """Where many frames differ from the prediction, the doubt that the prediction, that is the
    geometry, is wrong.

    Pictures that are the same, unreadable or dark need no prediction.
    """
    sinusoids = [flag for flag in flags if stack.patterns[flag.frame].role == "sin"]
    blamed = [flag for flag in sinusoids if flag.defect in frame_faults.FOUND_BY_PREDICTION]
    if len(blamed) < _MANY_BLAMED:
        return ""
    return "; with this many frames blamed, check the geometry and the axes of these pictures"


def _believable_surface(checked: Checked) -> bool:
    """Whether the slopes are those of one surface: steps that run backwards agree with every frame,
    not with it.
    """
    field = checked.tracer.slope_field(checked.state.points, checked.state.surface)
    return (
        1e6 * float(np.sqrt(np.mean(np.square(field[2:4] - field[4:6])))) <= RESIDUAL_REJECTED_URAD
    )


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
    frame to be flagged.
    """
    if (
        stack.unusable or len(stack.sinusoids(AXES[0])) > 3
    ):  # the good ones of four steps name a swapped pair
        return None
    found: list[Checked] = []
    for axis in AXES:
        for a, b in combinations(stack.sinusoids(axis), 2):
            order = list(range(len(stack.patterns)))
            order[a], order[b] = b, a
            try:
                checked = _check_rounds(
                    stack.reordered(order), binned.reordered(order), optics, anchor, rounds=2
                )
            except RejectedSetError:
                continue
            if not checked.flags and _believable_surface(checked):
                pair = ((a, b), (b, a))
                flags = tuple(_flag_swapped(k, stack.patterns[j].name, j) for k, j in pair)
                found.append(replace(checked, flags=flags))
    return found[0] if len(found) == 1 else None


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
    """The set as it is, without frames that do not belong, in a limited number of rounds. Raises
    RejectedSetError.
    """
    geometry = Geometry.from_config(optics)
    grid = bin_grid.BinGrid(geometry, optics.camera, binned.bin_px)
    near = grid.near_mirror(optics.mirror.analysis_radius_mm + _FILM_BESIDE_PLANE_MM)
    known = {
        frame: frame_faults.flag_unreadable(frame, reason)
        for frame, reason in stack.unusable.items()
    }
    known |= {flag.frame: flag for flag in frame_inspection.find_obvious_faults(stack, binned)}
    excluded = set(known)
    flags: list[frame_faults.Flag] = []
    taken = binned  # as the camera took them
    for done in range(rounds + 1):
        try:
            bench = _Bench(optics, geometry, grid, near, anchor)
            stack, binned, attempt, held = _attempt_without_held(stack, taken, bench, excluded)
        except (bin_view.NoFigureError, ValueError) as error:
            used = [k for axis in AXES for k in stack.sinusoids(axis) if k not in excluded]
            clipped = clipping.clipped_shares_of_lit(
                binned, used, near.reshape(binned.means[0].shape)
            )
            named = _merge_flags(_keep_believable(stack, flags), known)
            raise RejectedSetError(clipped.cause or str(error), named, clipped.white) from None
        readable = [k for k in range(len(stack.patterns)) if k not in stack.unusable]
        seen = frame_evidence.measure_frames(stack, binned, attempt.scene, readable)
        flags = frame_inspection.inspect_frames(stack, seen, excluded)
        fresh = [flag for flag in flags if flag.frame not in excluded]
        if not fresh:
            inner = np.all(
                inside_pattern(attempt.scene.phase_rad, optics.pattern, _BLURRED_RAD), axis=0
            )
            scene = attempt.scene.part(inner) if np.mean(inner) > 1 / 2 else attempt.scene
            flat = attempt.phase_rad.reshape(2, -1)
            light, film_um, noise_um = frame_evidence.estimate_light_and_film(
                stack, binned, scene, attempt.view.used, flat
            )
            left = light - (1.0 if stack.light is None else stack.light)
            if (
                np.abs(left).max() > (_UNEVEN if stack.light is None else _LIGHT_KNOWN)
                and done < rounds
            ):
                stack = replace(stack, light=light)  # a round with the light that each frame had
                continue
            confirm_orders(
                stack, attempt.phase_rad, binned, attempt.view, excluded, _merge_flags(flags, known)
            )
            shape = attempt.view.mask.shape
            fitted = (
                attempt.view,
                attempt.phase_rad,
                near.reshape(shape),
                attempt.tracer,
                attempt.state,
            )
            light_left = float(
                np.sqrt(
                    np.mean(np.square(left[:, [k for axis in attempt.view.used for k in axis]]))
                )
            )
            second = second_reflection.find_second_reflection(
                stack, binned, attempt.scene, excluded, optics.pattern
            )
            place = np.array(attempt.tracer.position_mm(attempt.state.points))
            response = light_response.estimate_response(
                stack,
                binned,
                attempt.state.index,
                place / optics.mirror.radius_mm,
                excluded,
                attempt.view.used,
            )
            return Checked(
                stack,
                binned,
                *fitted,
                _merge_flags(flags, known),
                film_um,
                noise_um,
                light_left,
                held,
                second,
                response,
            )
        pair = next((flag for flag in fresh if flag.swapped_with is not None), None)
        if (
            pair is not None
            and pair.swapped_with is not None
            and not {pair.frame, pair.swapped_with} & set(known)
        ):
            order = list(range(len(stack.patterns)))
            order[pair.frame], order[pair.swapped_with] = pair.swapped_with, pair.frame
            stack, taken = stack.reordered(order), taken.reordered(order)
            known |= {
                flag.frame: flag for flag in flags if flag.frame in (pair.frame, pair.swapped_with)
            }
            continue
        # the worst sinusoid alone may spoil the predictions of the others
        chosen = {flag.frame: flag for flag in _of_sinusoids(stack, fresh)[:1] or fresh}
        known |= chosen
        excluded |= set(chosen)
    reason = "the frames do not agree, whichever are left out"
    raise RejectedSetError(reason, _merge_flags(_keep_believable(stack, flags), known))


@dataclass(frozen=True)
class _Attempt:
    view: bin_view.BinView
    phase_rad: FloatArray
    tracer: ray_tracing.Tracer
    state: tracked_points.TrackedPoints
    scene: frame_evidence.SampledBins


@dataclass(frozen=True)
class _Bench:
    """What all attempts to fit a set share."""

    optics: OpticsConfig
    geometry: Geometry
    grid: bin_grid.BinGrid
    near: BoolArray
    anchor: Anchor | None


def _attempt_without_held(
    stack: frame_stack.FrameStack,
    taken: frame_stack.Binned,
    bench: _Bench,
    excluded: set[int],
) -> tuple[frame_stack.FrameStack, frame_stack.Binned, _Attempt, held_light.HeldLight]:
    """Fit the bins without what the frames show of the previous ones.

    Returns the stack that states those shares, the bins without them, the fit, and the shares.
    Raises NoFigureError or ValueError if there is no fit.
    """
    stack = replace(stack, held_shares=(0.0, 0.0))
    binned, held = taken, held_light.UNKNOWN
    attempt = _attempt_fit(stack, binned, bench, excluded)
    for _ in range(held_light.ROUNDS):
        found = held_light.estimate_held_light(stack, binned, attempt.scene, excluded)
        held = held_light.add_held_light(held, found)
        if not held.corrected or not held_light.is_worth_another_round(found):
            break
        if not any(stack.held_shares):
            stack = held_light.add_first_predecessor(stack, taken, attempt.scene, held)
        stack = replace(stack, held_shares=(held.rise, held.fall))
        binned = held_light.remove_held_light(stack, taken, held)
        attempt = _attempt_fit(stack, binned, bench, excluded)
    return stack, binned, attempt, held


def _attempt_fit(
    stack: frame_stack.FrameStack,
    binned: frame_stack.Binned,
    bench: _Bench,
    excluded: set[int],
) -> _Attempt:
    """Fit the bins without the excluded frames. Raises NoFigureError
    or ValueError if that fails.
    """
    optics, anchor = bench.optics, bench.anchor
    tracer = ray_tracing.Tracer(
        bench.geometry, optics.mirror.radius_mm, vertex_z_mm(optics, stack.mean_reading_um)
    )
    view = bin_view.combine_frames(
        stack, binned, excluded, None if anchor is None else anchor.light
    )
    phase = absolute_phases_of_bins(stack, binned, view, anchor, optics)
    candidates = np.flatnonzero(bench.near)
    flat = phase.reshape(2, -1)[:, candidates]
    state = tracked_points.select_points(
        bench.grid, tracer, candidates, flat, optics.pattern, optics.mirror.analysis_radius_mm
    )
    predicted = tracer.predict_screen(state.points, state.surface) / mm_per_rad(optics.pattern)
    light = view.light.reshape(-1)[state.index]
    at = predicted + centre_phase_rad(optics.pattern)
    scene = frame_evidence.SampledBins(state.index, light, at, state.sensitivity_rad_per_um)
    return _Attempt(view, phase, tracer, state, scene)


def _of_sinusoids(
    stack: frame_stack.FrameStack, flags: list[frame_faults.Flag]
) -> list[frame_faults.Flag]:
    return [flag for flag in flags if stack.patterns[flag.frame].role == "sin"]


def _keep_believable(
    stack: frame_stack.FrameStack, flags: list[frame_faults.Flag]
) -> list[frame_faults.Flag]:
    """While sinusoids are wrong the prediction may be wrong too: then only they are named."""
    return _of_sinusoids(stack, flags) or flags


def _merge_flags(
    flags: list[frame_faults.Flag], known: dict[int, frame_faults.Flag]
) -> tuple[frame_faults.Flag, ...]:
    """All flags in the order of the frames; the latest inspection takes precedence, earlier
    findings remain.
    """
    named = {
        **known,
        **{flag.frame: flag for flag in flags if known.get(flag.frame, flag).swapped_with is None},
    }
    return tuple(named[frame] for frame in sorted(named))
