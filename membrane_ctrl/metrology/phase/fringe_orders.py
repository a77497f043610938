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

# A good phase has no tears but for dust; one stale frame of three tears it at every quarter period.
_TORN_SHARE = 0.003
# One wrong Gray frame leaves half of the votes or more on the right order; fewer agree only if the
# phase is wrong.
_LEAST_AGREEMENT = 0.35
_LEAST_VOTES = 30  # a smaller island cannot outvote its own noise


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
    """Absolute phase of one axis.

    Parameters
    ----------
    wrapped_rad : (H, W) array
        Phase in (-pi, pi].
    bits : (4, H, W) bool array
        Gray bits, most significant first.
    mask : (H, W) bool array
        Pixels that see the pattern.
    """
    return resolve_orders_by_votes(
        wrapped_rad, absolute_phase(wrapped_rad, *code_orders(bits)), mask
    )


def resolve_orders_by_votes(wrapped_rad: FloatArray, coded: FloatArray, mask: BoolArray) -> Orders:
    """As `orders`, from absolute phases (H, W) that each pixel has by itself; NaN where it has
    none.
    """
    smooth, region = unwrap_regions(wrapped_rad, mask)
    if tear_share(smooth) > _TORN_SHARE:
        return Orders(np.where(mask, coded, np.nan), 1.0, torn=True)
    offset = np.round((coded - smooth) / (2 * math.pi))
    votes = np.zeros(
        (region.max() + 1 if mask.any() else 0, 65), np.int64
    )  # orders differ by 32 at most
    voting = mask & np.isfinite(coded)
    place = np.clip(offset[voting], -32, 32).astype(np.int64) + 32
    np.add.at(votes, (region[voting], place), 1)
    winner = np.argmax(votes, axis=1) - 32.0 if len(votes) else np.zeros(0)
    small = votes.sum(axis=1) < _LEAST_VOTES
    winner[small] = np.nan
    shift = np.full(mask.shape, np.nan)
    shift[mask] = winner[region[mask]]
    known = np.isfinite(shift) & voting
    agreement = float(np.mean(offset[known] == shift[known])) if known.any() else 0.0
    if agreement < _LEAST_AGREEMENT:
        return Orders(np.where(mask, coded, np.nan), 1.0, torn=True)
    return Orders(smooth + 2 * math.pi * shift, agreement, torn=False)
