"""Fringe orders from the Gray code and from the phase's own continuity, each checked by the other.

The paper's eq. 2 relies on every Gray bit of every pixel. Continuity gives the orders of a
connected region up to one number, which all of its pixels vote for: one wrong Gray frame scatters
its votes and is outvoted. A phase that is not continuous (a torn region) has no orders.
"""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.phase.gray_code import absolute_phase, code_orders
from membrane_ctrl.metrology.phase.region_unwrap import tear_share, unwrap_regions
from membrane_ctrl.model.arrays import BoolArray, FloatArray

# Largest share of neighbours between which a good phase is torn, by dust. One stale frame of three
# tears it at every quarter period.
_TORN_SHARE = 0.003
# Least share of votes for the chosen order. One wrong Gray frame leaves 50 % or more on the right
# order; fewer agree only if the phase is wrong.
_LEAST_AGREEMENT = 0.35
_LEAST_VOTES = 30  # of a region; a smaller one cannot outvote its own noise
_MOST_ORDERS = 32  # by which the votes may differ from the continuous phase


@dataclass(frozen=True)
class Orders:
    """Absolute phase of one axis.

    Attributes
    ----------
    phase_rad : (H, W) array
        Absolute phase, counted from the low edge's -pi; NaN where not known.
    agreement : float
        Share of the pixels whose own Gray bits give the same order.
    torn : bool
        Whether the phase is not continuous, or hardly any code agrees with it: the orders are the
        Gray code's alone.
    """

    phase_rad: FloatArray
    agreement: float
    torn: bool


def resolve_orders(wrapped_rad: FloatArray, bits: BoolArray, mask: BoolArray) -> Orders:
    """Absolute phase of one axis from its Gray code (eq. 2) and its continuity.

    Parameters
    ----------
    wrapped_rad : (H, W) array
        Phase in (-pi, pi].
    bits : (4, H, W) bool array
        Gray bits, most significant first.
    mask : (H, W) bool array
        Pixels that see the pattern.

    Returns
    -------
    Orders
    """
    k1, k2 = code_orders(bits)
    return resolve_orders_by_votes(wrapped_rad, absolute_phase(wrapped_rad, k1, k2), mask)


def resolve_orders_by_votes(
    wrapped_rad: FloatArray, voted_rad: FloatArray, mask: BoolArray
) -> Orders:
    """Absolute phase of one axis from a vote of each pixel and from its continuity.

    Parameters
    ----------
    wrapped_rad : (H, W) array
        Phase in (-pi, pi].
    voted_rad : (H, W) array
        Absolute phase that each pixel has by itself; NaN where it has none.
    mask : (H, W) bool array
        Pixels that see the pattern.

    Returns
    -------
    Orders
    """
    smooth_rad, region = unwrap_regions(wrapped_rad, mask)
    if tear_share(smooth_rad) > _TORN_SHARE:
        return Orders(np.where(mask, voted_rad, np.nan), 1.0, torn=True)

    # Each pixel votes for the number of periods that its region lacks.
    lacking = np.round((voted_rad - smooth_rad) / (2 * math.pi))
    is_voting = mask & np.isfinite(voted_rad)
    regions = 0
    if mask.any():
        regions = region.max() + 1
    votes = np.zeros((regions, 2 * _MOST_ORDERS + 1), np.int64)
    in_range = np.clip(lacking[is_voting], -_MOST_ORDERS, _MOST_ORDERS)
    ballot = in_range.astype(np.int64)
    np.add.at(votes, (region[is_voting], ballot + _MOST_ORDERS), 1)

    # The most frequent vote of each region; a region of few pixels has none.
    winner = np.zeros(0)
    if regions:
        winner = np.argmax(votes, axis=1) - float(_MOST_ORDERS)
    winner[votes.sum(axis=1) < _LEAST_VOTES] = np.nan

    # The winner holds for the whole region. If few pixels agree with it, the phase itself is wrong.
    shift = np.full(mask.shape, np.nan)
    shift[mask] = winner[region[mask]]
    is_known = np.isfinite(shift) & is_voting
    agreement = 0.0
    if is_known.any():
        agreement = float(np.mean(lacking[is_known] == shift[is_known]))
    if agreement < _LEAST_AGREEMENT:
        return Orders(np.where(mask, voted_rad, np.nan), 1.0, torn=True)
    return Orders(smooth_rad + 2 * math.pi * shift, agreement, torn=False)
