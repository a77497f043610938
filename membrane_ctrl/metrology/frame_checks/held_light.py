"""Share of the previous picture that each frame still shows: a slow panel, or a camera's lag.

Frame k then shows P_k + f (P_(k-1) - P_k), with P the pictures of a panel at rest. All steps of a
sinusoid but the first follow a step of the same sinusoid, so that their phases turn together by
about f sin(step). No frame disagrees with the others, and the figure tilts: 3.6 µm RMS at 1 %.

Frames that follow another kind of pattern show f: Gray bits after Gray bits or sinusoids, the first
y step after the last x frame, white after a Gray bit. Each of them is fitted by its own pattern and
by the difference from the previous frame as it was seen, where that is brighter and where it is
darker: panels rarely rise as fast as they fall. The medians over the frames are the two shares.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.metrology.frame_checks.frame_evidence import SampledBins
from membrane_ctrl.metrology.phase.frame_stack import Binned, FrameStack
from membrane_ctrl.metrology.phase.gray_code import gray_bit
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray, Singles

# From a Gray bit's edge, rad: beyond blur, and beyond the turn of the phases by a large share
_EDGE_RAD = 0.7
_HARMONICS = range(2, 7)  # of a sinusoid: the response of panel and camera
_SMOOTH_ORDER = 2  # of the polynomials by which light and contrast may differ over the mirror
_LEAST_DETERMINED = 0.05  # of the change from the previous frame, beyond its own pattern
_LEAST_BINS = 300
_LIVE_BINS = 2500  # of a live cycle: a share is known to 2e-4
# What no frame measures: over the share, since sinusoids change between greys; over the difference
# of rise and fall; over the share's square, since a panel relaxes from its last picture or state
_TRANSITIONS = 0.01
_ASYMMETRY = 0.03
_SECOND_ORDER = 0.1
_SURE_SIGMAS = 3.0
_FLOOR = 3e-5
# Each round finds nine tenths of the rest, since the light that it compares with has its share, too
ROUNDS = 5
_KNOWN = 2e-5
_UNKNOWN_SIGMA = 0.03  # a share that is not better known is no estimate
_GREAT_SHARE = 0.05  # beyond, what the correction leaves is no longer small


@dataclass(frozen=True)
class HeldLight:
    """Share of the previous picture in each frame."""

    rise: float  # where a frame is brighter than the previous one
    fall: float  # where it is darker
    sigma: float  # of their mean; NaN if the set cannot show it
    corrected: bool = False  # whether it was taken out of the frames

    @property
    def share(self) -> float:
        """Mean of the two."""
        return (self.rise + self.fall) / 2

    @property
    def left(self) -> float:
        """Standard uncertainty of the share that is left in the frames; NaN if unknown."""
        return self.sigma if self.corrected else math.hypot(self.share, self.sigma)


UNKNOWN = HeldLight(0.0, 0.0, math.nan)


def estimate_held_light(
    stack: FrameStack, binned: Binned, scene: SampledBins, excluded: Collection[int]
) -> HeldLight:
    """Estimate the shares from all frames that can show them.

    `scene` has the phases by the fitted surface; frames in `excluded` are neither used nor taken
    for a previous picture.
    """
    scene = scene.thinned()
    means = binned.means.reshape(len(stack.patterns), -1)[:, scene.index].astype(float)
    clipped = binned.saturated.reshape(len(stack.patterns), -1)[:, scene.index]
    smooth = _smooth_columns(scene)
    found: tuple[list[tuple[float, float]], ...] = ([], [])
    for frame in range(len(stack.patterns)):
        previous = stack.before_of(frame)
        if previous < 0 or {frame, previous} & set(excluded):
            continue
        if stack.patterns[previous].role not in ("sin", "gray"):
            continue  # without a pattern: it is like a change of the light
        columns, sure = _own_columns(stack, scene, frame, smooth)
        sure = sure & ~clipped[frame] & ~clipped[previous]
        of_frame = _fit_previous(means[frame], means[previous], columns * scene.light, sure)
        for way, one in zip(found, of_frame, strict=True):
            way += one
    if not all(found):
        return UNKNOWN
    (rise, rise_sigma), (fall, fall_sigma) = (_middle(way) for way in found)
    sigma = math.hypot(rise_sigma, fall_sigma) / math.sqrt(2)
    if len(found[0]) == 1:  # no scatter: only their difference shows whether they are true
        sigma = math.hypot(sigma, rise - fall)
    if sigma > _UNKNOWN_SIGMA:
        return UNKNOWN
    return HeldLight(rise, fall, math.hypot(sigma, _FLOOR))


def is_worth_removing(held: HeldLight) -> bool:
    """Whether the frames show a share beyond its uncertainty."""
    return max(abs(held.rise), abs(held.fall)) > _SURE_SIGMAS * held.sigma


def add_held_light(removed: HeldLight, found: HeldLight) -> HeldLight:
    """Return the shares in the frames, of which one part was removed before the other was found."""
    if not removed.corrected and not is_worth_removing(found):
        return found
    rise = removed.rise + found.rise * (1 - removed.rise)
    fall = removed.fall + found.fall * (1 - removed.fall)
    share = (rise + fall) / 2
    model = math.hypot(_TRANSITIONS * share, _ASYMMETRY * (rise - fall), _SECOND_ORDER * share**2)
    return HeldLight(rise, fall, math.hypot(found.sigma, model), corrected=True)


def remove_held_light(stack: FrameStack, binned: Binned, held: HeldLight) -> Binned:
    """Return the bins with the previous pictures taken out."""
    means = binned.means.copy()
    for frame in range(len(stack.patterns)):
        previous = stack.before_of(frame)
        if previous >= 0:
            means[frame] += held_change(binned.means[frame], binned.means[previous], held)
    return replace(binned, means=means)


def held_change(seen: Singles, previous: Singles, held: HeldLight) -> Singles:
    """Return what a picture would show more at rest, from it and the one before."""
    more = seen - previous
    rise, fall = (np.float32(f / (1 - f)) for f in (held.rise, held.fall))
    return np.asarray(np.where(more > 0, rise, fall) * more)


def find_held_light(
    stack: FrameStack, binned: Binned, index: IntArray, phase_rad: FloatArray
) -> tuple[HeldLight, Binned]:
    """Find the shares of a live cycle, whose phases are known, and take them out.

    Parameters
    ----------
    index : (n,) int array
        Bins.
    phase_rad : (2, n) array
        Their absolute phases, to some hundredths of a radian.

    Returns
    -------
    HeldLight, Binned
        The bins are the given ones if the frames show no share.
    """
    few = slice(None, None, max(1, index.size // _LIVE_BINS))
    index, phase_rad = index[few], phase_rad[:, few]
    held, without = UNKNOWN, binned
    x_weights = stack.weights(stack.sinusoids(AXES[0]))[0]
    for _ in range(ROUNDS):
        x_means = without.means[stack.sinusoids(AXES[0])]
        light = np.tensordot(x_weights, x_means.reshape(len(x_weights), -1)[:, index], axes=1)
        scene = SampledBins(index, light, phase_rad, np.zeros_like(phase_rad))
        found = estimate_held_light(stack, without, scene, ())
        held = add_held_light(held, found)
        if not held.corrected or not is_worth_another_round(found):
            break
        without = remove_held_light(stack, binned, held)
    return held, without


def is_worth_another_round(found: HeldLight) -> bool:
    """Whether what the last round found is worth a correction."""
    return max(abs(found.rise), abs(found.fall)) > _KNOWN


def add_first_predecessor(
    stack: FrameStack, binned: Binned, scene: SampledBins, held: HeldLight
) -> FrameStack:
    """Return the stack with the last frame as the first one's predecessor, if that fits better.

    Sets are often taken one after the other, and then the first picture follows the last one. If it
    does, the first sinusoid swings less than the others of its axis, by the share.
    """
    share = held.share
    first = [k for k in stack.sinusoids(AXES[0]) if stack.before_of(k) < 0]
    if len(first) != 1 or share <= 0:
        return stack
    scene = scene.thinned()
    swings = {}
    for frame in stack.sinusoids(AXES[0]):
        seen = binned.means[frame].reshape(-1)[scene.index].astype(float)
        columns, _ = _own_columns(stack, scene, frame, np.ones((1, scene.index.size)))
        solved = np.linalg.lstsq((columns * scene.light).T, seen, rcond=None)[0]
        swings[frame] = float(np.hypot(solved[1], solved[2]))
    # The others contain a step of the same fringes, which leaves |1 - f + f exp(-i step)|
    others = float(np.median([swing for frame, swing in swings.items() if frame != first[0]]))
    steps = stack.shifts_rad(stack.sinusoids(AXES[0]))
    turn = float(np.median(np.diff(steps)))
    others /= abs(1 - share + share * np.exp(-1j * turn))
    ratio = swings[first[0]] / max(others, 1e-9)
    if abs(ratio - (1 - share)) >= abs(ratio - 1):
        return stack
    before = [stack.before_of(frame) for frame in range(len(stack.patterns))]
    before[first[0]] = stack.last_taken
    return replace(stack, before=tuple(before))


def describe_held_light(held: HeldLight) -> str:
    """Why a set is degraded by what its frames hold of the previous ones; empty if it is not."""
    if not held.corrected or abs(held.share) < _GREAT_SHARE:
        return ""
    return (
        f"each frame shows {held.share:.1%} of the previous picture: the panel is slow, or the "
        "frames come too early after it: wait longer"
    )


def _smooth_columns(scene: SampledBins) -> FloatArray:
    """Polynomials (k, n) over the mirror, the constant first."""
    spread = np.maximum(scene.phase_rad.std(axis=1), 1e-9)
    u, v = (scene.phase_rad - scene.phase_rad.mean(axis=1)[:, None]) / spread[:, None]
    powers = [(p, q) for p in range(_SMOOTH_ORDER + 1) for q in range(_SMOOTH_ORDER + 1 - p)]
    return np.stack([u**p * v**q for p, q in powers])


def _own_columns(
    stack: FrameStack, scene: SampledBins, frame: int, smooth: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Columns (p, n) of a frame's own pattern, over the light, and the bins to fit."""
    pattern = stack.patterns[frame]
    every = np.ones(scene.index.size, bool)
    if pattern.role in ("white", "black"):
        return smooth, every
    phase = scene.phase_rad[AXES.index(pattern.axis)]
    if pattern.role == "gray":
        shown, from_edge = gray_bit(phase, pattern.index)
        return np.concatenate([smooth, smooth * shown]), from_edge > _EDGE_RAD
    if pattern.period_mm:  # of another period: not among the phases
        return smooth, ~every
    psi = phase + pattern.shift_rad
    waves = [np.cos(psi), np.sin(psi), *(np.cos(n * psi) for n in _HARMONICS)]
    waves += [np.sin(n * psi) for n in _HARMONICS]
    return np.concatenate([smooth[:1], np.stack(waves[:2]), smooth[1:], np.stack(waves[2:])]), every


def _fit_previous(
    seen: FloatArray, previous: FloatArray, columns: FloatArray, sure: BoolArray
) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
    """Share and noise where a frame rises, and where it falls; empty if it cannot show them."""
    rises: list[tuple[float, float]] = []
    falls: list[tuple[float, float]] = []
    if np.count_nonzero(sure) < _LEAST_BINS:
        return rises, falls
    columns, seen = columns[:, sure], seen[sure]
    columns = columns / np.maximum(np.linalg.norm(columns, axis=1, keepdims=True), 1e-30)
    # Normal equations: the columns have length 1 and are far from dependent
    solve = np.linalg.pinv(columns @ columns.T) @ columns
    own = (solve @ seen) @ columns
    change = previous[sure] - own
    ways = np.stack([np.minimum(change, 0.0), np.maximum(change, 0.0)])
    free = ways - (ways @ solve.T) @ columns
    power = np.sum(free**2, axis=1)
    determined = power > _LEAST_DETERMINED * np.sum(ways**2, axis=1) + 1e-12 * float(own @ own)
    if not determined.any():
        return rises, falls
    inverse = np.linalg.inv(free[determined] @ free[determined].T)
    shares = inverse @ (free[determined] @ (seen - own))
    rest = seen - own - shares @ free[determined]
    sigmas = np.sqrt(np.mean(rest**2) * np.diag(inverse))
    found = iter(zip(shares.tolist(), sigmas.tolist(), strict=True))
    for way, is_determined in zip((rises, falls), determined, strict=True):
        if is_determined:
            way.append(next(found))
    return rises, falls


def _middle(found: list[tuple[float, float]]) -> tuple[float, float]:
    """Median of the shares, and its uncertainty by noise and scatter."""
    shares, sigmas = np.array(found).T
    share = float(np.median(shares))
    count = math.sqrt(len(found))
    # The median of few is 1.25 times as uncertain as their mean; one alone has no scatter
    scatter = 0.1 * abs(share)
    if len(found) > 1:
        scatter = 1.25 * 1.4826 * float(np.median(np.abs(shares - share))) / count
    return share, math.hypot(float(np.median(sigmas)) / count, scatter)
