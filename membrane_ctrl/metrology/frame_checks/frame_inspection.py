"""Which frames do not belong to their set, and why: from the data alone.

Every frame is judged against the other frames of its own set, so the display's gamma, vignetting,
the film's ripple or a motion that all share is no fault. A limit is the larger of a floor, below
which the figure does not suffer, and a multiple of the scatter of the set's own good frames.
"""

from collections.abc import Collection

import numpy as np

from membrane_ctrl.metrology.frame_checks.frame_evidence import FrameEvidence
from membrane_ctrl.metrology.frame_checks.frame_faults import Flag, FrameDefect
from membrane_ctrl.metrology.phase.frame_stack import Binned, FrameStack
from membrane_ctrl.metrology.phase.pattern_sequence import AXES

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


def find_identical_frames(stack: FrameStack) -> dict[int, int]:
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


def find_obvious_faults(stack: FrameStack, binned: Binned) -> list[Flag]:
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


def inspect_frames(
    stack: FrameStack, evidence: dict[int, FrameEvidence], excluded: Collection[int]
) -> list[Flag]:
    """Judge all readable frames, worst first.

    The evidence compares them with the surface fitted to the frames that are not excluded. Excluded
    frames are judged too, but not used to judge the others.
    """
    trusted = {k: e for k, e in evidence.items() if k not in excluded}
    flags = [*_judge_sinusoids(stack, evidence, trusted), *_judge_gray(stack, evidence, trusted)]
    twins = find_identical_frames(stack)
    flags = [_name_pattern(stack, flag, evidence, twins) for flag in flags]
    return sorted(flags, key=lambda flag: -flag.severity)


def _judge_sinusoids(
    stack: FrameStack, evidence: dict[int, FrameEvidence], trusted: dict[int, FrameEvidence]
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
    e: FrameEvidence,
    same: list[FrameEvidence],
    every: list[FrameEvidence],
    trusted: dict[int, FrameEvidence],
) -> list[Flag]:
    """One sinusoid against those of its axis and, for the light, against those of both."""
    step_limit, step = _compute_limit([o.step_rad for o in same], STEP_RAD)
    moved_limit, moved_um = _compute_limit([o.moved_um for o in same], MOVED_UM)
    level_limit, level = _compute_limit([o.level for o in every], 0.0)
    swing_limit, swing = _compute_limit([o.swing for o in same], 0.0)
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
    kind: str, e: FrameEvidence, level: float, moved_um: float
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
    stack: FrameStack, evidence: dict[int, FrameEvidence], trusted: dict[int, FrameEvidence]
) -> list[Flag]:
    """Gray frames against each other, white against them, black against white."""
    gray = [k for axis in AXES for k in stack.gray(axis) if k in evidence]
    good = [evidence[k] for k in gray if k in trusted and evidence[k].lit > _NO_EDGE]
    if not good:
        return []
    bright_limit, bright = _compute_limit([e.level for e in good], 0.0)
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


def _gray_defect(e: FrameEvidence, bright: float, content: bool) -> tuple[FrameDefect, str]:
    light = e.level / max(bright, 1e-9)
    if light < _DARK and e.swing < _DARK * bright:
        return FrameDefect.DARK, f"dark: {light:.2f} of the light of the others"
    if content:
        differs = f"differs from its prediction by {e.rest / bright:.0%} of the light"
        return FrameDefect.WRONG_PICTURE, f"stale or wrong picture: {differs}"
    defect = FrameDefect.SATURATED if e.saturated > 0.5 else FrameDefect.FLICKER
    return defect, f"{defect.name.lower()}: {light:.3f} of the light of the others"


def _judge_flat(frame: int, e: FrameEvidence, bright: float, white: bool) -> list[Flag]:
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


def _name_pattern(
    stack: FrameStack, flag: Flag, evidence: dict[int, FrameEvidence], twins: dict[int, int]
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


def _compute_limit(values: list[float], floor: float) -> tuple[float, float]:
    """Limit and middle of a figure over the trusted frames."""
    if not values:
        return max(floor, 1e-9), 0.0
    middle = float(np.median(values))
    scatter = 1.4826 * float(np.median(np.abs(np.array(values) - middle)))
    return max(floor, _SCATTERS * scatter, 1e-9), middle
