"""Which frames do not belong to their set, and why: from the data alone.

Every frame is judged against the other frames of its own set, so the display's gamma, vignetting,
the film's ripple or a motion that all share is no fault. A limit is the larger of a floor, below
which the figure does not suffer, and a multiple of the scatter of the set's own good frames.
"""

from collections.abc import Collection
from enum import Enum, auto

import numpy as np

from membrane_ctrl.metrology.frame_checks.frame_evidence import FrameEvidence
from membrane_ctrl.metrology.frame_checks.frame_faults import Flag, FrameDefect
from membrane_ctrl.metrology.phase.frame_stack import Binned, FrameStack
from membrane_ctrl.metrology.phase.pattern_sequence import AXES

# Floors of the limits. Good frames of simulated sets (gamma 2.2, a rippled film, 20 µm of motion)
# differ by up to 0.005 rad of step and 0.005 of swing. If a slow display leaves 5 % of the previous
# frame in one, that is 0.05 rad, and 4 µm of figure.
STEP_RAD = 0.03
LEVEL_SHARE = 0.05
SWING_SHARE = 0.05
_FLICKER = 0.03  # a frame whose light is further off is called flicker, whatever else is wrong
# A frame taken 15 µm off bends the figure by a few µm at most; lasers are commonly off by less.
MOVED_UM = 15.0
REST_SHARE = 0.015
SATURATED_SHARE = 0.02
_BURNT_SHARE = 10 * SATURATED_SHARE  # beyond it, saturation is the cause of all else
# Bits are compared with half the light: a Gray frame may be 10 % off; Gray frames agree better with
# each other.
GRAY_SHARE = 0.04
WHITE_SHARE = 0.08
GRAY_REST = 0.15
FLAT_REST = 0.08
_LEAST_SWING = 0.5  # of a Gray frame, over the light: less is not its pattern
_MOST_BLACK = 0.5  # light of the black frame, over that of the white one
_WRONG_PATTERN = 2.0  # severity of a frame that looks like another pattern
# With fewer bins than this beyond a Gray frame's only edge, no more than FLAT_REST of its light is
# not flat.
_NO_EDGE = 0.005
_SCATTERS = 6.0  # a limit is this multiple of the good frames' scatter
_REST_RATIO = 1.2  # a frame's own rest may exceed that of the others by this factor
_DARK = 0.4  # a frame with less than this share of the light is called dark, not flicker
_COMPARED_ROWS = 16  # of a frame, before all are compared
_TINY = 1e-9  # instead of a division by zero


def find_identical_frames(stack: FrameStack) -> dict[int, int]:
    """Find frames that are byte for byte an earlier one of the sequence: noise never repeats.

    Returns
    -------
    dict
        The earlier frame, by the later one.
    """
    first_with: dict[bytes, int] = {}
    earlier: dict[int, int] = {}
    for k, frame in enumerate(stack.frames):
        if k in stack.unusable:
            continue
        # A few rows distinguish most frames; all rows are compared only if these are equal.
        some_rows = frame[:: max(1, len(frame) // _COMPARED_ROWS)].tobytes()
        first = first_with.setdefault(some_rows, k)
        if first != k and np.array_equal(stack.frames[first], frame):
            earlier[k] = first
    return earlier


def find_obvious_faults(stack: FrameStack, binned: Binned) -> list[Flag]:
    """Find sinusoids that are bad without a prediction: far darker than the others, or saturated.

    They are compared on the brighter half of the bins.

    Parameters
    ----------
    stack : FrameStack
        The set.
    binned : Binned
        Its frames as means over bins.

    Returns
    -------
    list of Flag
        In the order of the frames.
    """
    frames = [k for axis in AXES for k in stack.sinusoids(axis) if k not in stack.unusable]
    if not frames:
        return []

    # Mean light, and share of clipped bins, of each frame.
    brightest = np.max(binned.means[frames], axis=0)
    is_bright = brightest >= np.median(brightest)
    light = {k: float(np.mean(binned.means[k][is_bright])) for k in frames}
    saturated = {k: float(np.mean(binned.saturated[k][is_bright])) for k in frames}

    # Frames that are far from the medians.
    usual_light = float(np.median(list(light.values())))
    usual_saturated = float(np.median(list(saturated.values())))
    flags = []
    for k in frames:
        if light[k] < _DARK * usual_light:
            reason = f"dark: {light[k] / usual_light:.2f} of the light of the others"
            severity = usual_light / max(light[k], _TINY)
            flags.append(Flag(k, FrameDefect.DARK, reason, severity))
        elif saturated[k] > usual_saturated + _BURNT_SHARE:
            reason = f"saturated: {saturated[k]:.0%} of the bins"
            severity = saturated[k] / SATURATED_SHARE
            flags.append(Flag(k, FrameDefect.SATURATED, reason, severity))
    return flags


def inspect_frames(
    stack: FrameStack, evidence: dict[int, FrameEvidence], excluded: Collection[int]
) -> list[Flag]:
    """Judge all readable frames.

    Parameters
    ----------
    stack : FrameStack
        The set.
    evidence : dict
        Of each readable frame: what it shows against the surface that was fitted to the frames
        that are not excluded.
    excluded : collection of int
        Frames that are judged, but not used to judge the others.

    Returns
    -------
    list of Flag
        The frames that do not belong to the set, the worst first.
    """
    # Frames that are left out already may not widen the limits of the others.
    trusted = {k: e for k, e in evidence.items() if k not in excluded}
    flags = [*_judge_sinusoids(stack, evidence, trusted), *_judge_gray(stack, evidence, trusted)]
    # A frame that repeats another one is stale, whatever else is wrong with it.
    earlier = find_identical_frames(stack)
    flags = [_name_pattern(stack, flag, evidence, earlier) for flag in flags]
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
                flags += _judge_sinusoid(k, evidence[k], same, every)
    return flags


class _Deviation(Enum):
    """What of a sinusoid differs from the others."""

    STEP = auto()
    LIGHT = auto()
    SWING = auto()
    MOVED = auto()
    REST = auto()
    SATURATED = auto()


def _judge_sinusoid(
    frame: int,
    own: FrameEvidence,
    same: list[FrameEvidence],
    every: list[FrameEvidence],
) -> list[Flag]:
    """One sinusoid against those of its axis (`same`), its light against those of both (`every`).

    Each deviation is in units of its limit; the largest one is the frame's defect if it exceeds 1.
    """
    # Limits of the other frames' scatter, and their usual values.
    step_limit_rad, usual_step_rad = _compute_limit([each.step_rad for each in same], STEP_RAD)
    moved_limit_um, usual_moved_um = _compute_limit([each.moved_um for each in same], MOVED_UM)
    level_limit, usual_level = _compute_limit([each.level for each in every], 0.0)
    swing_limit, usual_swing = _compute_limit([each.swing for each in same], 0.0)
    usual_rest = float(np.median([each.rest for each in same]))
    usual_saturated = float(np.median([each.saturated for each in same]))

    # Floors that are a share of the usual light.
    level_limit = max(LEVEL_SHARE * usual_level, level_limit)
    swing_limit = max(SWING_SHARE * usual_swing, swing_limit)
    rest_limit = max(REST_SHARE, _REST_RATIO * usual_rest)

    # Deviations of this frame, the phase's within half a turn. Independent rests add in squares.
    step_off_rad = (own.step_rad - usual_step_rad + np.pi) % (2 * np.pi) - np.pi
    more_rest = max(own.rest**2 - usual_rest**2, 0.0) ** 0.5
    deviations = {
        _Deviation.STEP: abs(step_off_rad) / step_limit_rad,
        _Deviation.LIGHT: abs(own.level - usual_level) / level_limit,
        _Deviation.SWING: abs(own.swing - usual_swing) / swing_limit,
        _Deviation.MOVED: abs(own.moved_um - usual_moved_um) / moved_limit_um,
        _Deviation.REST: more_rest / rest_limit,
        _Deviation.SATURATED: (own.saturated - usual_saturated) / SATURATED_SHARE,
    }
    largest = max(deviations, key=lambda deviation: deviations[deviation])
    severity = deviations[largest]
    if severity <= 1:
        return []
    defect, reason = _name_sinusoid_defect(largest, own, usual_level, usual_moved_um)
    return [Flag(frame, defect, reason, severity)]


def _name_sinusoid_defect(
    largest: _Deviation, own: FrameEvidence, usual_level: float, usual_moved_um: float
) -> tuple[FrameDefect, str]:
    """The defect of a sinusoid, and its reason. Wrong light comes first: it causes all else."""
    # Light that is wrong by much.
    light = own.level / max(usual_level, _TINY)
    if own.saturated > _BURNT_SHARE or largest is _Deviation.SATURATED:
        return FrameDefect.SATURATED, f"saturated: {own.saturated:.0%} of the bins"
    if light < _DARK:
        return FrameDefect.DARK, f"dark: {light:.2f} of the light of the others"
    if largest is _Deviation.LIGHT or abs(light - 1) > _FLICKER:
        return FrameDefect.FLICKER, f"flicker: {light:.3f} of the light of the others"

    # The right light: the film elsewhere, another phase step, or a cause that is not known.
    away_um = own.moved_um - usual_moved_um
    if largest in (_Deviation.MOVED, _Deviation.REST) and abs(away_um) > MOVED_UM:
        reason = f"moved: the film was {away_um:+.0f} µm from where the others saw it"
        return FrameDefect.MOVED, reason
    if largest is _Deviation.STEP:
        reason = f"stale or wrong picture: its phase step is {own.step_rad:+.2f} rad off"
        return FrameDefect.WRONG_PICTURE, reason
    return FrameDefect.DIFFERS, f"differs from its prediction by {own.rest:.1%} of the light"


def _judge_gray(
    stack: FrameStack, evidence: dict[int, FrameEvidence], trusted: dict[int, FrameEvidence]
) -> list[Flag]:
    """Gray frames against each other, white against them, black against white."""
    # The light of bright bits, usual among the Gray frames that show an edge of their bit.
    gray = [k for axis in AXES for k in stack.gray(axis) if k in evidence]
    good = [evidence[k] for k in gray if k in trusted and evidence[k].lit > _NO_EDGE]
    if not good:
        return []
    bright_limit, bright = _compute_limit([each.level for each in good], 0.0)
    light_limit = max(GRAY_SHARE, bright_limit / max(bright, _TINY))
    flags = []
    for k in gray:
        # A bit without an edge on the mirror is a flat frame, bright or dark.
        own = evidence[k]
        if not _NO_EDGE < own.lit < 1 - _NO_EDGE:
            flags += _judge_flat(k, own, bright, is_white=own.lit > 0.5)
            continue

        # The light of its bright bits; and its content: rest, contrast, and the pattern it is most
        # like.
        light_severity = abs(own.level / max(bright, _TINY) - 1) / light_limit
        content_severity = max(
            own.rest / (GRAY_REST * bright),
            _LEAST_SWING * bright / max(own.swing, _TINY),
        )
        if own.shows != k:
            content_severity = max(content_severity, _WRONG_PATTERN)
        severity = max(light_severity, content_severity)
        if severity > 1:
            is_wrong_content = content_severity > light_severity
            defect, reason = _name_gray_defect(own, bright, is_wrong_content)
            flags.append(Flag(k, defect, reason, severity))
    for role in ("white", "black"):
        single = stack.find_frame(role)
        if single is not None and single in evidence:
            flags += _judge_flat(single, evidence[single], bright, is_white=role == "white")
    return flags


def _name_gray_defect(
    own: FrameEvidence, bright: float, is_wrong_content: bool
) -> tuple[FrameDefect, str]:
    """The defect of a Gray frame and its reason; `bright` is the usual light of bright bits."""
    light = own.level / max(bright, _TINY)
    if light < _DARK and own.swing < _DARK * bright:
        return FrameDefect.DARK, f"dark: {light:.2f} of the light of the others"
    if is_wrong_content:
        differs = f"differs from its prediction by {own.rest / bright:.0%} of the light"
        return FrameDefect.WRONG_PICTURE, f"stale or wrong picture: {differs}"
    defect = _name_wrong_light(own)
    return defect, f"{defect.name.lower()}: {light:.3f} of the light of the others"


def _judge_flat(frame: int, own: FrameEvidence, bright: float, is_white: bool) -> list[Flag]:
    """A frame of one level over the whole mirror: all bright (`is_white`), or all dark."""
    # How far level and evenness are from their limits: 1 is at the limit.
    light = own.level / max(bright, _TINY)
    rest_severity = own.rest / (FLAT_REST * bright)
    light_severity = light / _MOST_BLACK
    if is_white:
        light_severity = abs(light - 1) / WHITE_SHARE
    if max(rest_severity, light_severity) <= 1:
        return []

    # An uneven frame shows another picture; so does a black one that is too bright.
    if rest_severity > light_severity or not is_white:
        differs = f"stale or wrong picture: differs from its prediction by {own.rest / bright:.0%}"
        return [Flag(frame, FrameDefect.WRONG_PICTURE, differs, rest_severity)]
    defect = _name_wrong_light(own)
    if light < _DARK:
        defect = FrameDefect.DARK
    reason = f"{defect.name.lower()}: {light:.3f} of the light of the others"
    return [Flag(frame, defect, reason, light_severity)]


def _name_wrong_light(own: FrameEvidence) -> FrameDefect:
    """Why the light of a frame with flat levels is off, if it is not dark."""
    if own.saturated > 0.5:
        return FrameDefect.SATURATED
    return FrameDefect.FLICKER


def _name_pattern(
    stack: FrameStack, flag: Flag, evidence: dict[int, FrameEvidence], earlier: dict[int, int]
) -> Flag:
    """Name the frame whose picture a flagged frame shows, if that is known.

    `earlier` are the identical frames, as `find_identical_frames` gives them.
    """
    k = flag.frame
    own = evidence[k]
    # A frame that repeats another one is stale.
    identical = earlier.get(k)
    if identical is None:
        identical = next((late for late, early in earlier.items() if early == k), None)
    if identical is not None:
        reason = f"stale: the same picture as {stack.patterns[identical].name}"
        return Flag(k, FrameDefect.STALE, reason, flag.severity)
    # Else it may show the picture of another frame; if that one shows this picture, they are
    # swapped.
    if own.shows == k:
        return flag
    name = stack.patterns[own.shows].name
    partner = evidence.get(own.shows)
    if partner is not None and partner.shows == k:
        return Flag(k, FrameDefect.SWAPPED, f"swapped with {name}", flag.severity, own.shows)
    return Flag(k, FrameDefect.STALE, f"stale: shows {name}", flag.severity)


def _compute_limit(values: list[float], floor: float) -> tuple[float, float]:
    """Limit of the deviation from the median, and the median, of one quantity over good frames.

    The limit is the floor, or a multiple of the robust standard deviation if that is larger.
    """
    if not values:
        return max(floor, _TINY), 0.0
    median = float(np.median(values))
    scatter = 1.4826 * float(np.median(np.abs(np.array(values) - median)))
    return max(floor, _SCATTERS * scatter, _TINY), median
