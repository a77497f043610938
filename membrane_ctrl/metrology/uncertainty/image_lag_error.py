"""Error of the figure by what each frame still shows of the previous picture."""

import math
from dataclasses import replace

import numpy as np

from membrane_ctrl.metrology.frame_checks.image_lag import ImageLag
from membrane_ctrl.metrology.phase import phase_steps, screen_scale
from membrane_ctrl.metrology.phase.frame_stack import FrameStack
from membrane_ctrl.metrology.phase.gray_code import gray_bit
from membrane_ctrl.metrology.phase.pattern_sequence import AXES, fringe_sequence
from membrane_ctrl.metrology.uncertainty.budget import Source
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench
from membrane_ctrl.model.arrays import FloatArray

_SAYS = "what each frame still shows of the previous picture"


def image_lag_sources(
    bench: TrialBench, stack: FrameStack, used: tuple[list[int], list[int]], lag: ImageLag
) -> list[Source]:
    """Return the rows of the budget for the share of the previous picture left in the frames.

    The panel has the same share in all sets of a bench, and what the model of the share or the
    light over the mirror adds to single frames is also the same: two sets share it frame by frame.
    They do not share the noise.

    Parameters
    ----------
    bench : TrialBench
        Some points of the set.
    stack : FrameStack
        The set's patterns and their order.
    used : two lists of int
        The used sinusoids of x and of y.
    lag : ImageLag
        The share; without an estimate the rows' uncertainty is 0, and so stated.

    Returns
    -------
    list of Source
        The shared part, and the noise.
    """
    left = lag.remaining_sigma if math.isfinite(lag.remaining_sigma) else 0.0
    effect = image_lag_effect(bench, stack, used)
    of_frames = _order_by_fringes(lag.scatter, stack)
    noise = lag.noise if left else 0.0
    # sigma^2 = rest^2 + noise^2 + the frames' own parts.
    rest = math.sqrt(max(left**2 - noise**2 - float(of_frames @ of_frames), 0.0))
    shared = np.outer(effect, [rest, *of_frames])
    own = (noise * effect)[:, None]
    description = "noise of the share of the previous picture"
    return [
        Source("image_lag_share", _SAYS, left, shared, common=False),
        Source("image_lag_noise", description, noise, own, common=False, paired=False),
    ]


def _order_by_fringes(of_frames: FloatArray, stack: FrameStack) -> FloatArray:
    """Parts of single frames, (2 frames,), with the fringes first: a set of fringes alone has them
    at the same place as a full one. None without an estimate.
    """
    if of_frames.size == 0:
        return of_frames
    fringes = [*stack.sinusoids(AXES[0]), *stack.sinusoids(AXES[1])]
    others = [frame for frame in range(len(stack.patterns)) if frame not in fringes]
    rise_and_fall = of_frames.reshape(2, len(stack.patterns)).T
    return np.asarray(rise_and_fall[[*fringes, *others]].ravel())


def image_lag_of_cycles(bench: TrialBench, shifts_rad: FloatArray, lag: ImageLag) -> FloatArray:
    """Return the error that live cycles share: that of their fringes.

    Parameters
    ----------
    bench : TrialBench
        Some points of the cycle.
    shifts_rad : (2, N) array
        Phase steps of x and y.
    lag : ImageLag
        The share; unknown counts as 0.

    Returns
    -------
    (parameters,) array
        Change of the surface's parameters by 1 sigma, mm.
    """
    # The steps of a fringes-only cycle; only their patterns are needed, not their frames.
    patterns = fringe_sequence(bench.optics.pattern)
    shifted = tuple(
        replace(pattern, shift_rad=float(shift))
        for pattern, shift in zip(patterns, shifts_rad.ravel(), strict=True)
    )
    count = len(shifted)
    stack = FrameStack(np.empty((count, 0, 0), np.uint8), shifted, np.full(count, np.nan), {})
    used = (stack.sinusoids(AXES[0]), stack.sinusoids(AXES[1]))

    # The effect of a share of 1, times what is not known of the share.
    effect_mm = image_lag_effect(bench, stack, used)
    if not math.isfinite(lag.remaining_sigma):
        return 0.0 * effect_mm
    return lag.remaining_sigma * effect_mm


def image_lag_effect(
    bench: TrialBench, stack: FrameStack, used: tuple[list[int], list[int]]
) -> FloatArray:
    """Return the change of the surface's parameters per unit of the share.

    The previous frame's light adds to each step, which turns the phase by the part of that light
    that the weights of the steps take for sine and cosine: d phi = -(C sin phi - S cos phi).

    Parameters
    ----------
    bench : TrialBench
        Some points of the set.
    stack : FrameStack
        The set's patterns and their order.
    used : two lists of int
        The used sinusoids of x and of y.

    Returns
    -------
    (parameters,) array
        In mm.
    """
    # Phase of each point in the pattern.
    scale = screen_scale.mm_per_rad(bench.optics.pattern)
    centre_rad = screen_scale.centre_phase_rad(bench.optics.pattern)
    angle = bench.screen_mm / scale + centre_rad

    # Error of the phase of x and of y, frame by frame, as error of the screen points. A share f
    # adds f (previous - own) to a frame; C and S are linear in the frames, with these weights.
    off = np.zeros_like(bench.screen_mm)
    for axis, frames in enumerate(used):
        _, cosine, sine = phase_steps.step_weights(stack.shifts_rad(frames))
        for k, frame in enumerate(frames):
            previous = stack.frame_before(frame)
            if previous < 0:
                continue
            change = _wave(stack, previous, angle) - _wave(stack, frame, angle)
            off[axis] -= (
                scale * change * (cosine[k] * np.sin(angle[axis]) - sine[k] * np.cos(angle[axis]))
            )

    # The surface that such screen points give, less the true one.
    solved = bench.solve(bench.geometry(), off, linear=True)
    return np.asarray(solved - bench.surface.parameters)


def _wave(stack: FrameStack, frame: int, angle: FloatArray) -> FloatArray:
    """Light (n,) of a frame about its mean, over the amplitude of the fringes."""
    pattern = stack.patterns[frame]
    if pattern.role in ("white", "black"):
        return np.full(angle.shape[1], 1.0 if pattern.role == "white" else -1.0)
    along = angle[AXES.index(pattern.axis)]
    if pattern.role == "gray":
        return np.asarray(2.0 * gray_bit(along, pattern.index)[0] - 1.0)
    return np.asarray(np.cos(along + pattern.shift_rad))
