"""Steps of the figure from one cycle to the next."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.metrology.hencky import zernike_projection
from membrane_ctrl.review.found_event import Found, event_around
from membrane_ctrl.review.shapes import Shapes
from membrane_ctrl.review.steps import confidence, differences

JUMP_LEAST_UM = 0.3
JUMP_LEAST_SIGMAS = 8.0
JUMP_HALF_CYCLES = 5
# From cycle to cycle; a setpoint's ramp is faster, and frames of a mirror that moves do not fit each other.
JUMP_STILL_UM = 2.0
# Standard deviation over median absolute deviation, of normal noise.
_SIGMA_OVER_MAD = 1.4826


def shape_jumps(shapes: Shapes, held: NDArray[np.bool_]) -> list[Found]:
    """The figure beside its sag (terms 5 to 11, without what a deeper bowl has of them) steps between cycles."""
    moved_um = np.abs(np.diff(shapes.displacement_um, prepend=np.nan, append=np.nan))
    still = ~(np.fmax(moved_um[:-1], moved_um[1:]) > JUMP_STILL_UM)
    good = held & still & (shapes.verdict != "rejected")
    if np.count_nonzero(good) < 4 * JUMP_HALF_CYCLES:
        return []
    # of a month all 36 terms are 190 MB
    terms = shapes.coeffs_um[good, 4:11] - np.outer(shapes.sag_um[good], zernike_projection()[4:11])
    change = np.stack([differences(term, JUMP_HALF_CYCLES, 0) for term in terms.T])
    size = np.sqrt((change**2).sum(axis=0))
    scale = np.nanmedian(size)
    sigma = _SIGMA_OVER_MAD * float(np.nanmedian(np.abs(size - scale))) + 1e-12
    score = np.nan_to_num((size - scale) / sigma)
    rows = np.flatnonzero((np.nan_to_num(size) >= JUMP_LEAST_UM) & (score >= JUMP_LEAST_SIGMAS))
    groups = np.split(rows, np.flatnonzero(np.diff(rows) > 2 * JUMP_HALF_CYCLES) + 1) if rows.size else []
    best = [int(group[np.argmax(size[group])]) for group in groups]
    time_s = {"time_s": shapes.time_s[good]}
    return [
        event_around("shape jump", time_s, row, 60, float(size[row]), "um", confidence(float(score[row]), size.size))
        for row in best
    ]
