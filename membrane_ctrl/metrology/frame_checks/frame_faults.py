"""Which frames do not belong to their set, and why: from the data alone.

Every frame is judged against the other frames of its own set, so the display's gamma, vignetting,
the film's ripple or a motion that all share is no fault. A limit is the larger of a floor, below
which the figure does not suffer, and a multiple of the scatter of the set's own good frames.

`closure`: do the frames of a series of phase steps agree, and if not, which one is wrong?

Least squares leave of each pixel's N intensities the residual r = P I, with P the projector off the
model's columns. Leaving out frame k needs no second fit: the sum of squares falls by exactly r_k^2
/ P_kk. The frame whose omission makes the rest agree is the wrong one.

With nothing known of a pixel the model has three parameters (mean, cosine, sine). For N = 4 one
degree of freedom is left, I_0 - I_1 + I_2 - I_3: it says that something is wrong, and blames all
four alike. Other knowledge decides:

- the phase, from other frequencies, the other sets or the surface: two parameters are left (mean,
  amplitude);
- mean and amplitude, from the other axis or frequency, or from white and black: with the mean
  alone, two frames half a period apart would share the blame; the length of the phasor tells them
  apart.

Both work for any N >= 4; from N = 5 on nothing else needs to be known.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np

from membrane_ctrl.metrology.frame_checks.frame_evidence import Evidence
from membrane_ctrl.metrology.phase.frame_stack import Binned, FrameStack
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
from membrane_ctrl.metrology.phase.phase_steps import step_residual, step_weights
from membrane_ctrl.model.arrays import ArrayLike, FloatArray

_TINY = 1e-9  # share of a frame that the model does not explain; below this it explains any frame


@dataclass(frozen=True)
class Closure:
    """How well N frames agree."""

    rms_adu: float  # the residual, per degree of freedom: the noise, if all is well
    frame_rms_adu: FloatArray  # (N,): the residual of each frame, over all pixels
    # (N,): the residual, per degree of freedom, without that frame; NaN where nothing would be left
    # to test
    without_rms_adu: FloatArray

    @property
    def suspect(self) -> int | None:
        """The frame that explains the disagreement best when left out; None if the data cannot
        tell.
        """
        return (
            None if np.isnan(self.without_rms_adu).any() else int(np.argmin(self.without_rms_adu))
        )

    @property
    def gain(self) -> float:
        """How many times better the rest agrees without the suspect:
        about 1 if no frame is wrong.
        """
        return (
            1.0
            if self.suspect is None
            else self.rms_adu / max(float(self.without_rms_adu.min()), _TINY)
        )


def closure(frames: ArrayLike, shifts_rad: Sequence[float] | FloatArray) -> Closure:
    """Agreement of the frames with a sinusoid of unknown mean, amplitude and phase in each pixel.

    Raises ValueError for fewer than four frames, or steps that determine no phase.

    Parameters
    ----------
    frames : (N, ...) array
        Intensities, N >= 4; pixels without fringes left out or masked by the caller.
    shifts_rad : (N,) array
        Phase steps.
    """
    stack, shifts = _checked(frames, shifts_rad)
    residual = step_residual(stack, shifts)
    design = np.stack([np.ones_like(shifts), np.cos(shifts), -np.sin(shifts)], axis=1)
    free = 1 - np.einsum("kp,pk->k", design, step_weights(shifts))  # diagonal of P
    return _summary(residual, np.broadcast_to(free[:, None], residual.shape), len(shifts) - 3)


def closure_with_phase(
    frames: ArrayLike, shifts_rad: Sequence[float] | FloatArray, phase_rad: FloatArray
) -> Closure:
    """Agreement with a sinusoid of known phase (...) and unknown mean and amplitude; names a frame
    from N = 4 on.

    An error of the phase shows in all frames, as amplitude times error: it hides faults below that.
    """
    stack, shifts = _checked(frames, shifts_rad)
    carrier = np.cos(np.ravel(phase_rad) + shifts[:, None])
    carrier -= carrier.mean(axis=0)
    carrier /= np.maximum(np.linalg.norm(carrier, axis=0), _TINY)
    centred = stack - stack.mean(axis=0)
    residual = centred - carrier * np.sum(carrier * centred, axis=0)
    return _summary(residual, 1 - 1 / len(shifts) - carrier**2, len(shifts) - 2)


def closure_with_level(
    frames: ArrayLike,
    shifts_rad: Sequence[float] | FloatArray,
    mean_adu: FloatArray,
    amplitude_adu: FloatArray,
) -> Closure:
    """Agreement with a sinusoid of known mean and amplitude (...) and unknown phase; names a frame
    from N = 4 on.

    Linear in cosine and sine with the mean known; the phasor's length, which should be the
    amplitude, is one more equation. To first order in the noise that is the fit of the phase alone.
    """
    stack, shifts = _checked(frames, shifts_rad)
    centred, amplitude = stack - np.ravel(mean_adu), np.ravel(amplitude_adu)
    design = np.stack([np.cos(shifts), -np.sin(shifts)], axis=1)
    rest = [np.arange(len(shifts)) != k for k in range(len(shifts))]
    without = [
        math.sqrt(_level_rss(centred[keep], design[keep], amplitude) / (len(shifts) - 2))
        for keep in rest
    ]
    rms = math.sqrt(_level_rss(centred, design, amplitude) / (len(shifts) - 1))
    residual = centred - design @ np.linalg.pinv(design) @ centred
    return Closure(rms, np.sqrt(np.mean(residual**2, axis=1)), np.array(without))


def _level_rss(centred: FloatArray, design: FloatArray, amplitude: FloatArray) -> float:
    """Mean over pixels of the residual squares, that of the phasor's length in units of its
    variance along itself.
    """
    covariance = np.linalg.inv(design.T @ design)
    phasor = covariance @ design.T @ centred
    length = np.linalg.norm(phasor, axis=0)
    along = phasor / np.maximum(length, _TINY)
    variance = np.einsum("ip,ij,jp->p", along, covariance, along)
    variance = np.maximum(
        variance, np.linalg.eigvalsh(covariance)[0]
    )  # a phasor of 0 points nowhere
    rss = np.sum((centred - design @ phasor) ** 2, axis=0)
    return float(np.mean(rss + (length - amplitude) ** 2 / variance))


def _checked(
    frames: ArrayLike, shifts_rad: Sequence[float] | FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Frames as (N, pixels) and shifts; four frames at least, as three always agree."""
    shifts = np.asarray(shifts_rad, float)
    stack = np.asarray(frames, float).reshape(len(shifts), -1)
    if len(shifts) < 4:
        raise ValueError(f"{len(shifts)} phase steps always agree: a closure needs four or more")
    if stack.shape[1] == 0:
        raise ValueError("no pixels to test")
    step_weights(shifts)  # refuses steps that determine no phase
    return stack, shifts


def _summary(residual: FloatArray, free: FloatArray, freedom: int) -> Closure:
    """From the residual (N, pixels), the diagonal of P there, and the degrees of freedom of a
    pixel.
    """
    rss = np.sum(residual**2, axis=0)
    rms = math.sqrt(float(rss.mean()) / freedom)
    # a frame that the model explains in any case cannot be tested by omission: its pixel keeps its
    # sum
    drop = np.where(free > _TINY, residual**2 / np.maximum(free, _TINY), 0.0)
    without = np.full(len(residual), math.nan)
    if freedom > 1:
        without = np.sqrt(np.maximum(np.mean(rss - drop, axis=1), 0.0) / (freedom - 1))
    return Closure(rms, np.sqrt(np.mean(residual**2, axis=1)), without)


# Floors. Good frames of simulated sets (gamma 2.2, a rippled film, 20 µm of motion) differ by up to
# 0.005 rad of step and 0.005 of swing. A twentieth of the frame before left in one by a slow
# display is 0.05 rad, and
# 4 µm of figure.
STEP_RAD = 0.03
LEVEL_SHARE = 0.05
SWING_SHARE = 0.05
_FLICKER = 0.03  # of light is called flicker whatever else is wrong
# A frame taken 15 µm off bends the figure by a few µm at most; lasers are commonly off by less.
MOVED_UM = 15.0
REST_SHARE = 0.015
SATURATED_SHARE = 0.02
# Bits are read against half the light: a Gray frame may be a tenth off; Gray frames agree better
# among themselves.
GRAY_SHARE = 0.04
WHITE_SHARE = 0.08
GRAY_REST = 0.15
FLAT_REST = 0.08
# With fewer bins than this beyond a Gray frame's only edge, no more than FLAT_REST of its light is
# not flat.
_NO_EDGE = 0.005
_SCATTERS = 6.0  # of the good frames' scatter
_DARK = 0.4  # less than this share of the light is no flicker


class FrameDefect(Enum):
    """What is wrong with a frame."""

    UNREADABLE = auto()
    LEFT_OUT = auto()  # without further reason
    DARK = auto()
    SATURATED = auto()
    FLICKER = auto()
    MOVED = auto()  # the film was elsewhere
    STALE = auto()  # shows the picture of another frame
    SWAPPED = auto()  # two frames show each other's pictures
    WRONG_PICTURE = auto()  # stale, or another picture
    DIFFERS = auto()  # from its prediction, without a name
    INCONSISTENT = auto()  # with the other steps of its series


# Found by comparing the frame with what the geometry predicts: a wrong geometry blames many frames
# so.
FOUND_BY_PREDICTION = frozenset(
    {FrameDefect.MOVED, FrameDefect.DIFFERS, FrameDefect.WRONG_PICTURE, FrameDefect.FLICKER}
)


@dataclass(frozen=True)
class Flag:
    """A frame that does not belong."""

    frame: int
    defect: FrameDefect
    reason: str  # for people
    severity: float  # times the limit
    # the frame that shows this one's pattern while this one shows its
    swapped_with: int | None = None


def flag_unreadable(frame: int, reason: str) -> Flag:
    """Return the flag of a frame that could not be read."""
    return Flag(frame, FrameDefect.UNREADABLE, reason, np.inf)


def identical_frames(stack: FrameStack) -> dict[int, int]:
    """Frames that are byte for byte an earlier one of the sequence, and which:
    noise never repeats.
    """
    seen: dict[bytes, int] = {}
    out: dict[int, int] = {}
    for k, frame in enumerate(stack.frames):
        if k in stack.unusable:
            continue
        key = frame[:: max(1, len(frame) // 16)].tobytes()  # 16 rows tell two frames apart ...
        if key in seen and np.array_equal(
            stack.frames[seen[key]], frame
        ):  # ... and all rows are compared then
            out[k] = seen[key]
        else:
            seen.setdefault(key, k)
    return out


def obvious(stack: FrameStack, binned: Binned) -> list[Flag]:
    """Sinusoids that are bad without a prediction: far darker than the others, or burnt out."""
    frames = [k for axis in AXES for k in stack.sinusoids(axis) if k not in stack.unusable]
    if not frames:
        return []
    bright = np.max(binned.means[frames], axis=0)
    where = bright >= np.median(bright)
    light = {k: float(np.mean(binned.means[k][where])) for k in frames}
    burnt = {k: float(np.mean(binned.saturated[k][where])) for k in frames}
    middle, usual = float(np.median(list(light.values()))), float(np.median(list(burnt.values())))
    flags = []
    for k in frames:
        if light[k] < _DARK * middle:
            reason = f"dark: {light[k] / middle:.2f} of the light of the others"
            flags.append(Flag(k, FrameDefect.DARK, reason, middle / max(light[k], 1e-9)))
        elif burnt[k] > usual + 10 * SATURATED_SHARE:
            reason = f"saturated: {burnt[k]:.0%} of the bins"
            flags.append(Flag(k, FrameDefect.SATURATED, reason, burnt[k] / SATURATED_SHARE))
    return flags


def inspect(
    stack: FrameStack, evidence: dict[int, Evidence], excluded: Collection[int]
) -> list[Flag]:
    """Judge all readable frames, worst first.

    The evidence compares them with the surface fitted to the frames that are not excluded. Excluded
    frames are judged too, but not used to judge the others.
    """
    trusted = {k: e for k, e in evidence.items() if k not in excluded}
    flags = [*_judge_sinusoids(stack, evidence, trusted), *_judge_gray(stack, evidence, trusted)]
    twins = identical_frames(stack)
    flags = [_named(stack, flag, evidence, twins) for flag in flags]
    return sorted(flags, key=lambda flag: -flag.severity)


def _judge_sinusoids(
    stack: FrameStack, evidence: dict[int, Evidence], trusted: dict[int, Evidence]
) -> list[Flag]:
    """Judge each against the others, itself left out, so that it cannot widen its own limit."""
    flags = []
    for axis in AXES:
        frames = [k for k in stack.sinusoids(axis) if k in evidence]
        for k in frames:
            same = [trusted[j] for j in frames if j != k and j in trusted]
            every = [e for j, e in trusted.items() if j != k and stack.patterns[j].role == "sin"]
            if same:
                flags += _judge_sinusoid(k, evidence[k], same, every, trusted)
    return flags


def _judge_sinusoid(
    frame: int,
    e: Evidence,
    same: list[Evidence],
    every: list[Evidence],
    trusted: dict[int, Evidence],
) -> list[Flag]:
    """One sinusoid against those of its axis and, for the light, against those of both."""
    step_limit, step = _limit([o.step_rad for o in same], STEP_RAD)
    moved_limit, moved_um = _limit([o.moved_um for o in same], MOVED_UM)
    level_limit, level = _limit([o.level for o in every], 0.0)
    swing_limit, swing = _limit([o.swing for o in same], 0.0)
    rest = float(np.median([o.rest for o in same]))
    saturated = float(np.median([o.saturated for o in same]))
    worst = {
        "step": abs((e.step_rad - step + np.pi) % (2 * np.pi) - np.pi) / step_limit,
        "light": abs(e.level - level) / max(LEVEL_SHARE * level, level_limit),
        "swing": abs(e.swing - swing) / max(SWING_SHARE * swing, swing_limit),
        "moved": abs(e.moved_um - moved_um) / moved_limit,
        "rest": max(e.rest**2 - rest**2, 0.0) ** 0.5 / max(REST_SHARE, 1.2 * rest),
        "saturated": (e.saturated - saturated) / SATURATED_SHARE,
    }
    kind = max(worst, key=lambda name: worst[name])
    if worst[kind] <= 1:
        return []
    defect, reason = _sinusoid_defect(kind, e, level, moved_um)
    return [Flag(frame, defect, reason, worst[kind])]


def _sinusoid_defect(
    kind: str, e: Evidence, level: float, moved_um: float
) -> tuple[FrameDefect, str]:
    light = e.level / max(level, 1e-9)
    if e.saturated > 10 * SATURATED_SHARE or kind == "saturated":
        return FrameDefect.SATURATED, f"saturated: {e.saturated:.0%} of the bins"
    if light < _DARK:
        return FrameDefect.DARK, f"dark: {light:.2f} of the light of the others"
    if kind == "light" or abs(light - 1) > _FLICKER:
        return FrameDefect.FLICKER, f"flicker: {light:.3f} of the light of the others"
    if kind in ("moved", "rest") and abs(e.moved_um - moved_um) > MOVED_UM:
        away_um = e.moved_um - moved_um
        return (
            FrameDefect.MOVED,
            f"moved: the film was {away_um:+.0f} µm from where the others saw it",
        )
    if kind == "step":
        return (
            FrameDefect.WRONG_PICTURE,
            f"stale or wrong picture: its phase step is {e.step_rad:+.2f} rad off",
        )
    return FrameDefect.DIFFERS, f"differs from its prediction by {e.rest:.1%} of the light"


def _judge_gray(
    stack: FrameStack, evidence: dict[int, Evidence], trusted: dict[int, Evidence]
) -> list[Flag]:
    """Gray frames against each other, white against them, black against white."""
    gray = [k for axis in AXES for k in stack.gray(axis) if k in evidence]
    good = [evidence[k] for k in gray if k in trusted and evidence[k].lit > _NO_EDGE]
    if not good:
        return []
    bright_limit, bright = _limit([e.level for e in good], 0.0)
    flags = []
    for k in gray:
        e = evidence[k]
        if not _NO_EDGE < e.lit < 1 - _NO_EDGE:
            flags += _judge_flat(k, e, bright, white=e.lit > 0.5)
            continue
        light = abs(e.level / max(bright, 1e-9) - 1) / max(
            GRAY_SHARE, bright_limit / max(bright, 1e-9)
        )
        content = max(
            e.rest / (GRAY_REST * bright),
            2.0 if e.shows != k else 0.0,
            0.5 * bright / max(e.swing, 1e-9),
        )
        if max(light, content) > 1:
            defect, reason = _gray_defect(e, bright, content > light)
            flags.append(Flag(k, defect, reason, max(light, content)))
    for role in ("white", "black"):
        single = stack.single(role)
        if single is not None and single in evidence:
            flags += _judge_flat(single, evidence[single], bright, white=role == "white")
    return flags


def _gray_defect(e: Evidence, bright: float, content: bool) -> tuple[FrameDefect, str]:
    light = e.level / max(bright, 1e-9)
    if light < _DARK and e.swing < _DARK * bright:
        return FrameDefect.DARK, f"dark: {light:.2f} of the light of the others"
    if content:
        differs = f"differs from its prediction by {e.rest / bright:.0%} of the light"
        return FrameDefect.WRONG_PICTURE, f"stale or wrong picture: {differs}"
    defect = FrameDefect.SATURATED if e.saturated > 0.5 else FrameDefect.FLICKER
    return defect, f"{defect.name.lower()}: {light:.3f} of the light of the others"


def _judge_flat(frame: int, e: Evidence, bright: float, white: bool) -> list[Flag]:
    light = e.level / max(bright, 1e-9)
    rest = e.rest / (FLAT_REST * bright)
    off = abs(light - 1) / WHITE_SHARE if white else light / 0.5
    if max(rest, off) <= 1:
        return []
    if rest > off or not white:
        differs = f"stale or wrong picture: differs from its prediction by {e.rest / bright:.0%}"
        return [Flag(frame, FrameDefect.WRONG_PICTURE, differs, rest)]
    defect = FrameDefect.SATURATED if e.saturated > 0.5 else FrameDefect.FLICKER
    if light < _DARK:
        defect = FrameDefect.DARK
    return [
        Flag(frame, defect, f"{defect.name.lower()}: {light:.3f} of the light of the others", off)
    ]


def _named(
    stack: FrameStack, flag: Flag, evidence: dict[int, Evidence], twins: dict[int, int]
) -> Flag:
    """Add the frame whose picture it is, if that is known."""
    k = flag.frame
    e = evidence[k]
    same = twins.get(k, next((late for late, early in twins.items() if early == k), None))
    if same is not None:
        twin = f"stale: the same picture as {stack.patterns[same].name}"
        return Flag(k, FrameDefect.STALE, twin, flag.severity)
    if e.shows != k:
        name = stack.patterns[e.shows].name
        partner = evidence.get(e.shows)
        if partner is not None and partner.shows == k:
            return Flag(k, FrameDefect.SWAPPED, f"swapped with {name}", flag.severity, e.shows)
        return Flag(k, FrameDefect.STALE, f"stale: shows {name}", flag.severity)
    return flag


def _limit(values: list[float], floor: float) -> tuple[float, float]:
    """Limit and middle of a figure over the trusted frames."""
    if not values:
        return max(floor, 1e-9), 0.0
    middle = float(np.median(values))
    scatter = 1.4826 * float(np.median(np.abs(np.array(values) - middle)))
    return max(floor, _SCATTERS * scatter, 1e-9), middle
