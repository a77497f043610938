"""Fringe orders from the Gray code and from the phase's own continuity, each checked by the other.

The paper's eq. 2 trusts every Gray bit of every pixel. Continuity gives the orders of a connected
region up to one number, which all of its pixels vote for: one wrong Gray frame scatters its votes
and is outvoted, and the result shows which frame contradicts it. Where the phase itself is torn (a
wrong sinusoid) eq. 2 remains.
"""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.numerics.compiled import kernel
from membrane_ctrl.metrology.phase.phase_steps import absolute_phase, code_orders
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray

# Wrapped phase made continuous over a mask by walking from neighbour to neighbour.


@kernel
def _flood(phase, mask, out, region, queue):  # type: ignore[no-untyped-def]
    """Breadth-first: each pixel takes the period nearest to the neighbour that reached it. Returns
    the regions.
    """
    height, width = phase.shape
    count = 0
    for seed in range(height * width):
        if not mask[seed // width, seed % width] or region[seed // width, seed % width] >= 0:
            continue
        head, tail = 0, 1
        queue[0] = seed
        region[seed // width, seed % width] = count
        out[seed // width, seed % width] = phase[seed // width, seed % width]
        while head < tail:
            row, column = queue[head] // width, queue[head] % width
            head += 1
            for k in range(4):
                r = row + (k == 0) - (k == 1)
                c = column + (k == 2) - (k == 3)
                if (
                    r < 0
                    or c < 0
                    or r >= height
                    or c >= width
                    or not mask[r, c]
                    or region[r, c] >= 0
                ):
                    continue
                step = phase[r, c] - out[row, column]
                out[r, c] = phase[r, c] - 2 * math.pi * math.floor(step / (2 * math.pi) + 0.5)
                region[r, c] = count
                queue[tail] = r * width + c
                tail += 1
        count += 1
    return count


def unwrap_regions(wrapped_rad: FloatArray, mask: BoolArray) -> tuple[FloatArray, IntArray]:
    """Continuous phase (H, W) of each connected region, up to whole periods, and the number (H, W)
    of the region.

    `mask` (H, W) is where the phase is trusted; outside they are NaN and -1. Neighbours must differ
    by less than half a period.
    """
    out = np.full(wrapped_rad.shape, np.nan)
    region = np.full(wrapped_rad.shape, -1, np.int64)
    _flood(np.ascontiguousarray(wrapped_rad), mask, out, region, np.empty(mask.size, np.int64))
    return out, region


def tear_share(phase_rad: FloatArray) -> float:
    """Share of neighbours whose continuous phases differ by more than half a period; NaN is left
    out.

    0 if the phase is the same whichever way the walk went.
    """
    steps = np.concatenate([np.diff(phase_rad, axis=0).ravel(), np.diff(phase_rad, axis=1).ravel()])
    steps = steps[np.isfinite(steps)]
    return float(np.mean(np.abs(steps) > math.pi)) if steps.size else 0.0


# A good phase has no tears but for dust; one stale frame of three tears it at every quarter period.
_TORN_SHARE = 0.003
# One wrong Gray frame leaves half of the votes or more on the right order; fewer agree only if the
# phase is wrong.
_LEAST_AGREEMENT = 0.35
_LEAST_VOTES = 30  # a smaller island cannot outvote its own noise


@dataclass(frozen=True)
class Orders:
    """Absolute phase of one axis."""

    phase_rad: FloatArray  # (H, W): counted from the low edge's -pi; NaN where not known
    agreement: float  # share of the pixels whose own Gray bits give the same order
    # the phase is not continuous, or hardly any code agrees with it: the orders are the Gray code's
    # alone
    torn: bool


def orders(wrapped_rad: FloatArray, bits: BoolArray, mask: BoolArray) -> Orders:
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
    return by_votes(wrapped_rad, absolute_phase(wrapped_rad, *code_orders(bits)), mask)


def by_votes(wrapped_rad: FloatArray, coded: FloatArray, mask: BoolArray) -> Orders:
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


def gray_bit(phase_rad: FloatArray, bit: int) -> tuple[BoolArray, FloatArray]:
    """What Gray frame `bit` (1..4) shows at an absolute phase, and the distance in rad to where
    that bit changes.

    V2 = floor(2 s / T) with s / T = (phase + pi) / (2 pi). Bit b of the code changes at V2 =
    2^(4-b) (odd number).
    """
    half_periods = (phase_rad + math.pi) / math.pi
    v2 = np.floor(np.nan_to_num(half_periods)).astype(np.int64)
    shown = ((v2 ^ (v2 >> 1)) >> (4 - bit)) & 1
    spacing = 2 ** (4 - bit)
    from_edge = np.abs(half_periods % (2 * spacing) - spacing)
    return shown.astype(bool), from_edge * math.pi
