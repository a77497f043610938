"""Phase of each bin against the last cycle: the phase steps combined, then the change of angle."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from membrane_ctrl.metrology.numerics.compiled import compile_kernel
from membrane_ctrl.metrology.numerics.threads import split_over_threads
from membrane_ctrl.metrology.phase.phasor_kernels import branchless_arctan2, remove_phasor_motion
from membrane_ctrl.model.arrays import AnyArray, ComplexArray, FloatArray, IntArray

_BLOCK = 512  # points whose intermediate values stay in the first-level cache


@dataclass(frozen=True)
class StepCombination:
    """How the frames of one axis become a phasor.

    Attributes
    ----------
    cosine : (N,) array
        Weights of the frames' bin sums for C, over the pixels of a bin.
    sine : (N,) array
        The same for S.
    turn, mirror : (2,) complex arrays
        First and second moments of the film's motion (`reconstruction.film_motion`); 0 without.
    """

    cosine: FloatArray
    sine: FloatArray
    turn: ComplexArray = field(default_factory=lambda: np.zeros(2, complex))
    mirror: ComplexArray = field(default_factory=lambda: np.zeros(2, complex))


@compile_kernel
def _combine_sums(sums, index, weights, first, out):  # type: ignore[no-untyped-def]
    """out[p] = sum over frames of weight times bin sum."""
    for p in range(out.size):
        out[p] = 0.0
    for k in range(weights.size):
        weight = weights[k]
        if weight == 0:  # of four equal steps, every second one
            continue
        for p in range(out.size):
            out[p] += weight * sums[k, index[first + p]]


@compile_kernel
def _remove_motion(c, s, slope, turn, mirror):  # type: ignore[no-untyped-def]
    """`remove_phasor_motion` of phasors c + i s, in place; `slope` is q of each point."""
    for p in range(c.size):
        c[p], s[p] = remove_phasor_motion(c[p], s[p], slope[p], turn, mirror)


@compile_kernel
def _relative_angle(c, s, last_cos, last_sin, change, size):  # type: ignore[no-untyped-def]
    """Angle of c + i s relative to the last phase into `change`, its length into `size`; c + i s
    becomes a unit vector.
    """
    for p in range(c.size):
        length = math.sqrt(c[p] * c[p] + s[p] * s[p])
        scale = 1 / (length + 1e-300)
        x = c[p] * scale
        y = s[p] * scale
        # arg(z conj z_last), section 6 of docs/explanation/metrology.md
        sine = y * last_cos[p] - x * last_sin[p]
        cosine = x * last_cos[p] + y * last_sin[p]
        change[p] = branchless_arctan2(sine, cosine)
        size[p] = length
        c[p] = x
        s[p] = y


@compile_kernel
def _track_phases(sums, index, cosine, sine, turn, mirror, slope, last, out, start, stop):  # type: ignore[no-untyped-def]
    """Phase of each point, counted from the last one; rows of `last` and `out` as in
    `update_phases`.
    """
    for first in range(start, stop, _BLOCK):
        end = min(first + _BLOCK, stop)
        # The phasor of each point, without the film's motion.
        c = out[1, first:end]
        s = out[2, first:end]
        _combine_sums(sums, index, cosine, first, c)
        _combine_sums(sums, index, sine, first, s)
        if turn[1] != 0:
            _remove_motion(c, s, slope[first:end], turn, mirror)
        # Its angle to the last phasor, which is the change of the phase.
        _relative_angle(
            c, s, last[1, first:end], last[2, first:end], out[3, first:end], out[4, first:end]
        )
        for p in range(first, end):
            out[0, p] = last[0, p] + out[3, p]


def update_phases(
    sums: Sequence[AnyArray],
    index: IntArray,
    combined: Sequence[StepCombination],
    sensitivity_rad_per_um: FloatArray,
    last: FloatArray,
    out: FloatArray,
) -> None:
    """Phases of the points against the last ones, for x and y, into `out`.

    Derivation: section 6 of docs/explanation/metrology.md.

    Parameters
    ----------
    sums : two (N, bins) uint32 arrays
        Bin sums of the N frames of each axis.
    index : (n,) int array
        Bin of each point.
    combined : two StepCombination
        How the frames of each axis combine.
    sensitivity_rad_per_um : (2, n) array
        Change of phase per µm of displacement.
    last, out : (2, FOLLOWED_ROWS, n) arrays
        Rows of the cycle before, from which the change is counted (unambiguous below pi), and of
        this one: absolute phase (rad), its cosine and sine, change (rad), amplitude (ADU).
    """

    def run(start: int, stop: int) -> None:
        for k, steps in enumerate(combined):
            weights = (steps.cosine, steps.sine, steps.turn, steps.mirror)
            _track_phases(
                sums[k], index, *weights, sensitivity_rad_per_um[k], last[k], out[k], start, stop
            )

    split_over_threads(run, index.size)
