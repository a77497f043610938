"""Fits and inspections of a capture set in rounds, until the frames that are left agree.

One bad frame spoils the prediction of the others, so frames are left out one at a time.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.frame_checks import (
    bin_view,
    clipping,
    frame_evidence,
    frame_faults,
    frame_inspection,
    light_and_film,
)
from membrane_ctrl.metrology.frame_checks.checked_set import Anchor, Checked, RejectedSetError
from membrane_ctrl.metrology.frame_checks.light_path import measure_light_path
from membrane_ctrl.metrology.frame_checks.order_check import confirm_orders
from membrane_ctrl.metrology.frame_checks.set_fit import SetBench, SetFit, fit_without_lag
from membrane_ctrl.metrology.phase import frame_stack
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
from membrane_ctrl.metrology.phase.screen_scale import inside_pattern

_MOST_ROUNDS = 8  # of fit and inspection; each leaves out one frame or more
# Largest difference of light that is called even: it leaves 0.02 µm in the figure, and a blurred
# set seems to differ by as much.
_UNEVEN = 2e-3
_LIGHT_KNOWN = 3e-4  # the same, once the light of the frames is part of the fit
# Bins nearer than this to the pattern's edge are not used to find a frame's light: the edge is
# blurred there.
_BLURRED_RAD = 2.0
_LEAST_INNER = 1 / 2  # share of the bins that must be far enough from the edge


def exclude_bad_frames(
    stack: frame_stack.FrameStack,
    binned: frame_stack.Binned,
    optics: OpticsConfig,
    anchor: Anchor | None,
    rounds: int = _MOST_ROUNDS,
) -> Checked:
    """Fit, inspect and leave out frames in a limited number of rounds.

    A round ends in one of four ways: it leaves out frames, it exchanges two, it repeats the fit
    with the light that each frame had, or it accepts the set.

    Parameters
    ----------
    stack, binned : FrameStack, Binned
        The set, and its frames as means over bins.
    optics : OpticsConfig
        The bench.
    anchor : Anchor or None
        Gives a set without Gray code its fringe orders.
    rounds : int
        How often frames may be left out.

    Returns
    -------
    Checked
        The accepted set.

    Raises
    ------
    RejectedSetError
        No figure is left, or the frames do not agree whichever are left out.
    """
    bench = SetBench.from_optics(optics, binned.bin_px, anchor)
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
            stack, binned, fit, lag = fit_without_lag(stack, taken, bench, excluded)
        except (bin_view.NoFigureError, ValueError) as error:
            named = _merge_flags(_keep_believable(stack, flags), known)
            raise _explain_no_figure(stack, binned, bench, excluded, named, error) from None

        # Compare every frame with what that surface predicts.
        readable = [k for k in range(len(stack.patterns)) if k not in stack.unusable]
        evidence = frame_evidence.measure_frames(stack, binned, fit.scene, readable)
        flags = frame_inspection.inspect_frames(stack, evidence, excluded)
        fresh = [flag for flag in flags if flag.frame not in excluded]

        if not fresh:
            # All frames agree. If their light differs, repeat the fit with the light of each.
            seen = _estimate_light_and_film(stack, binned, fit, optics)
            light_error = seen.light - (1.0 if stack.light is None else stack.light)
            allowed = _UNEVEN
            if stack.light is not None:
                allowed = _LIGHT_KNOWN
            if np.abs(light_error).max() > allowed and done < rounds:
                stack = replace(stack, light=seen.light)
                continue
            named = _merge_flags(flags, known)
            confirm_orders(stack, fit.phase_rad, binned, fit.view, excluded, named)
            used = [k for frames in fit.view.used for k in frames]
            light_left = float(np.sqrt(np.mean(np.square(light_error[:, used]))))
            checked = Checked(
                stack=stack,
                binned=binned,
                view=fit.view,
                phase_rad=fit.phase_rad,
                near=bench.near.reshape(fit.view.mask.shape),
                tracer=fit.tracer,
                state=fit.state,
                flags=named,
                film_um=seen.film_um,
                film_noise_um=seen.film_noise_um,
                shifts=seen.shifts,
                light_left=light_left,
                lag=lag,
            )
            return measure_light_path(checked, fit.scene, excluded, optics, anchor)

        # Two frames that show each other's pictures are exchanged, and both stay in use.
        pair = _find_swapped_pair(fresh, known)
        if pair is not None:
            order = exchange_order(len(stack.patterns), *pair)
            stack = stack.exchange_frames(order)
            taken = taken.exchange_frames(order)
            known |= {flag.frame: flag for flag in flags if flag.frame in pair}
            continue

        # The worst sinusoid alone may spoil the predictions of the others.
        worst = flags_of_sinusoids(stack, fresh)[:1]
        chosen = {flag.frame: flag for flag in worst or fresh}
        known |= chosen
        excluded |= set(chosen)
    reason = "the frames do not agree, whichever are left out"
    raise RejectedSetError(reason, _merge_flags(_keep_believable(stack, flags), known))


def _explain_no_figure(
    stack: frame_stack.FrameStack,
    binned: frame_stack.Binned,
    bench: SetBench,
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
    fit: SetFit,
    optics: OpticsConfig,
) -> light_and_film.LightAndFilm:
    """As `light_and_film.estimate_light_and_film`, away from the pattern's edge where possible."""
    scene = fit.scene
    is_inner = np.all(inside_pattern(scene.phase_rad, optics.pattern, _BLURRED_RAD), axis=0)
    if np.mean(is_inner) > _LEAST_INNER:
        scene = scene.select_bins(is_inner)
    phase_rad = fit.phase_rad.reshape(2, -1)
    return light_and_film.estimate_light_and_film(stack, binned, scene, fit.view.used, phase_rad)


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


def exchange_order(count: int, a: int, b: int) -> list[int]:
    """Return the order of frames in which two of them are exchanged.

    Parameters
    ----------
    count : int
        Number of frames.
    a, b : int
        Numbers of the two, from 0.

    Returns
    -------
    list of int
        For each place, the number of the frame there.
    """
    order = list(range(count))
    order[a] = b
    order[b] = a
    return order


def flags_of_sinusoids(
    stack: frame_stack.FrameStack, flags: Iterable[frame_faults.Flag]
) -> list[frame_faults.Flag]:
    """Return the flags of sinusoids, in their order.

    Parameters
    ----------
    stack : FrameStack
        The set.
    flags : iterable of Flag
        Flags of its frames.
    """
    return [flag for flag in flags if stack.patterns[flag.frame].role == "sin"]


def _keep_believable(
    stack: frame_stack.FrameStack, flags: list[frame_faults.Flag]
) -> list[frame_faults.Flag]:
    """While sinusoids are wrong the prediction may be wrong too: then only they are named."""
    return flags_of_sinusoids(stack, flags) or flags


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
