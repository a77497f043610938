"""Absolute phases of the bins of a set: from its Gray code, or from the set that it refers to."""

import math

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig, PatternConfig
from membrane_ctrl.metrology.frame_checks import bin_view
from membrane_ctrl.metrology.frame_checks.checked_set import Anchor
from membrane_ctrl.metrology.phase import frame_stack
from membrane_ctrl.metrology.phase.fringe_orders import resolve_orders
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
from membrane_ctrl.metrology.phase.screen_scale import inside_pattern
from membrane_ctrl.model.arrays import FloatArray

# A phase that moved further than this between two sets may have got the order of the next period.
_GUARD_RAD = 0.9 * math.pi
_LOST_SHARE = 0.01  # share of such points that a set may have


def absolute_phases_of_bins(
    stack: frame_stack.FrameStack,
    binned: frame_stack.Binned,
    view: bin_view.BinView,
    anchor: Anchor | None,
    optics: OpticsConfig,
) -> FloatArray:
    """Absolute phases of the bins of a set.

    They follow from the Gray code or, with an anchor, from the phases of the set that it was made
    of.

    Parameters
    ----------
    stack, binned : FrameStack, Binned
        The set, and its frames as means over bins.
    view : BinView
        What the usable frames show of each bin.
    anchor : Anchor or None
        Phases of the set that this one refers to; None: the set has its own Gray code.
    optics : OpticsConfig
        The bench.

    Returns
    -------
    (2, rows, columns) array
        NaN where not valid.

    Raises
    ------
    NoFigureError
        If the film moved too far from the anchor.
    """
    if anchor is not None:
        return _follow_anchor(view, anchor)
    return absolute_phases(stack, binned, view, optics.pattern)


def absolute_phases(
    stack: frame_stack.FrameStack,
    binned: frame_stack.Binned,
    view: bin_view.BinView,
    pattern: PatternConfig,
) -> FloatArray:
    """Absolute phases of a set with Gray code (eq. 2 of the paper).

    Parameters
    ----------
    stack, binned, view
        As in `absolute_phases_of_bins`.
    pattern : PatternConfig
        The pattern on the screen.

    Returns
    -------
    (2, rows, columns) array
        NaN where not valid.
    """
    absolute_rad = np.empty_like(view.phase_rad)
    for k, axis in enumerate(AXES):
        # A bit is bright above half the light: the mean of the fringes, which no single frame can
        # spoil.
        bits = binned.means[stack.gray(axis)] > view.light
        phase_rad = resolve_orders(view.phase_rad[k], bits, view.mask).phase_rad
        absolute_rad[k] = np.where(inside_pattern(phase_rad, pattern), phase_rad, np.nan)
    return absolute_rad


def _follow_anchor(view: bin_view.BinView, anchor: Anchor) -> FloatArray:
    """Absolute phases nearest to the anchor's. Raises NoFigureError if the film moved so far that
    the orders are not certain.
    """
    # The change modulo 2 pi, which is the change itself while it is below half a period.
    change_rad = np.angle(np.exp(1j * (view.phase_rad - anchor.phase_rad)))
    seen = view.mask & np.isfinite(anchor.phase_rad).all(axis=0)

    # A field of changes that passes half a period anywhere shows points just below it.
    lost = 1.0
    if seen.any():
        largest_rad = np.abs(change_rad[:, seen]).max(axis=0)
        lost = float(np.mean(largest_rad > _GUARD_RAD))
    if lost > _LOST_SHARE:
        raise bin_view.NoFigureError(
            f"the phase moved by half a period from the reference at {lost:.0%} of the points"
        )
    return np.where(seen, anchor.phase_rad + change_rad, np.nan)
