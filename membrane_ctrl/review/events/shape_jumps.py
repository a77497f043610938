"""Finds steps of the mirror's figure between cycles."""

import numpy as np

from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.arrays import BoolArray
from membrane_ctrl.review.events.found_event import FoundEvent, event_around
from membrane_ctrl.review.events.steps import mean_differences, step_confidence
from membrane_ctrl.run_files.shapes import Shapes

JUMP_LEAST_UM = 0.3
JUMP_LEAST_SIGMAS = 8.0
JUMP_HALF_CYCLES = 5
# Between cycles; a setpoint's ramp is faster, and frames of a moving mirror are inconsistent.
JUMP_STILL_UM = 2.0
# Standard deviation over median absolute deviation, of normal noise.
_SIGMA_OVER_MAD = 1.4826


def shape_jumps(shapes: Shapes, held: BoolArray) -> list[FoundEvent]:
    """Find steps of the figure between cycles, by its terms 5 to 11 less the share of a deeper
    bowl.

    Parameters
    ----------
    shapes : Shapes
        The measured figures of a run, n cycles.
    held : (n,) bool array
        Whether the mirror was held during each.
    """
    # Cycles of a held mirror that stands still.
    moved_um = np.abs(np.diff(shapes.displacement_um, prepend=np.nan, append=np.nan))
    still = ~(np.fmax(moved_um[:-1], moved_um[1:]) > JUMP_STILL_UM)
    good = held & still & (shapes.verdict != "rejected")
    if np.count_nonzero(good) < 4 * JUMP_HALF_CYCLES:
        return []
    # all terms of a month take 190 MB (36 of them)
    terms = shapes.coeffs_um[good, 4:11] - np.outer(shapes.sag_um[good], zernike_projection()[4:11])
    # The mean of the cycles after each place less that of those before, as RMS over the terms.
    change = np.stack([mean_differences(term, JUMP_HALF_CYCLES, 0) for term in terms.T])
    size = np.sqrt((change**2).sum(axis=0))
    # Its usual size and scatter, both robust: a jump is far above them.
    scale = np.nanmedian(size)
    sigma = _SIGMA_OVER_MAD * float(np.nanmedian(np.abs(size - scale))) + 1e-12
    score = np.nan_to_num((size - scale) / sigma)
    rows = np.flatnonzero((np.nan_to_num(size) >= JUMP_LEAST_UM) & (score >= JUMP_LEAST_SIGMAS))
    # One jump for each stretch of high scores: the largest.
    groups = []
    if rows.size:
        groups = np.split(rows, np.flatnonzero(np.diff(rows) > 2 * JUMP_HALF_CYCLES) + 1)
    best = [int(group[np.argmax(size[group])]) for group in groups]
    time_s = {"time_s": shapes.time_s[good]}
    return [
        event_around(
            "shape jump",
            time_s,
            row,
            60,
            float(size[row]),
            "µm",
            step_confidence(float(score[row]), size.size),
        )
        for row in best
    ]
