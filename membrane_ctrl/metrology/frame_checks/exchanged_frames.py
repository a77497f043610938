"""Two sinusoids of an axis that were exchanged, in a set whose frames cannot show which."""

import math
from dataclasses import replace
from itertools import combinations

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.frame_checks import frame_faults
from membrane_ctrl.metrology.frame_checks.checked_set import Anchor, Checked, RejectedSetError
from membrane_ctrl.metrology.frame_checks.exclusion_rounds import (
    exchange_order,
    exclude_bad_frames,
)
from membrane_ctrl.metrology.phase import frame_stack
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
from membrane_ctrl.model.shape_estimate import RESIDUAL_REJECTED_URAD

_EXCHANGE_ROUNDS = 2  # of a set with two frames exchanged
# Steps of an axis up to which an exchanged pair cannot be named by what its frames show.
_FEW_STEPS = 3


def put_exchanged_back(
    stack: frame_stack.FrameStack,
    binned: frame_stack.Binned,
    optics: OpticsConfig,
    anchor: Anchor | None,
) -> Checked | None:
    """Exchange two sinusoids of an axis, if exactly one exchange makes all frames agree.

    Three steps that run backwards predict every frame wrongly, so no frame can be blamed for what
    it shows. The Gray code and the surface decide: of all exchanges only the right one leaves no
    frame to be flagged. Of four steps, the good ones show which two are swapped.

    Parameters
    ----------
    stack, binned : FrameStack, Binned
        The set, and its frames as means over bins.
    optics : OpticsConfig
        The bench.
    anchor : Anchor or None
        Gives a set without Gray code its fringe orders.

    Returns
    -------
    Checked or None
        The set with the two frames put back and flagged; None if no exchange, or more than one,
        makes the frames agree.
    """
    if stack.unusable or len(stack.sinusoids(AXES[0])) > _FEW_STEPS:
        return None

    # Each exchange of two sinusoids of an axis is tried.
    found: list[Checked] = []
    pairs = [pair for axis in AXES for pair in combinations(stack.sinusoids(axis), 2)]
    for a, b in pairs:
        order = exchange_order(len(stack.patterns), a, b)
        try:
            checked = exclude_bad_frames(
                stack.exchange_frames(order),
                binned.exchange_frames(order),
                optics,
                anchor,
                _EXCHANGE_ROUNDS,
            )
        except RejectedSetError:
            continue
        if not checked.flags and is_one_surface(checked):
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


def is_one_surface(checked: Checked) -> bool:
    """Return whether the slopes are those of one surface.

    Phase steps that run backwards agree with each other, but their slopes fit no surface.
    """
    field = checked.tracer.slope_field(checked.state.points, checked.state.surface)
    measured = field[2:4]
    fitted = field[4:6]
    residual_urad = 1e6 * float(np.sqrt(np.mean(np.square(measured - fitted))))
    return residual_urad <= RESIDUAL_REJECTED_URAD


def _flag_swapped(frame: int, shown: str, swapped_with: int) -> frame_faults.Flag:
    return frame_faults.Flag(
        frame, frame_faults.FrameDefect.SWAPPED, f"swapped with {shown}", math.inf, swapped_with
    )
