"""What each frame shows, measured against what the surface predicts it should show.

After the fit the phase of every bin is known without any single frame, so each frame alone gives
its own phase step, brightness, contrast and film position: the coefficients of `frame_model`. Over
thousands of bins noise is negligible; the remaining residual does not belong to the pattern.
"""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.frame_checks.frame_model import (
    COSINE,
    MOTION,
    SINE,
    FrameModel,
    FrameSolution,
    make_frame_model,
    solve_frame,
)
from membrane_ctrl.metrology.frame_checks.sampled_bins import SampledBins
from membrane_ctrl.metrology.phase.frame_stack import Binned, FrameStack
from membrane_ctrl.model.arrays import BoolArray, FloatArray

# Least correlation with a pattern, to look like it: a sinusoid and its square wave have 0.9.
_LEAST_LIKENESS = 0.7
_CLEARLY_MORE = 1e-3  # another pattern must be more like a frame than its own by this much
_FLAT_PICTURE = 0.02  # standard deviation over mean of a picture without any pattern
_TINY = 1e-9  # instead of a division by zero


@dataclass(frozen=True)
class FrameEvidence:
    """What one frame shows; units of light are those of `SampledBins.light`.

    Attributes
    ----------
    level : float
        m of a sinusoid, hi of a Gray frame, the level of white and black.
    swing : float
        b of a sinusoid, hi - lo of a Gray frame, else 0.
    step_rad : float
        delta of a sinusoid: its phase step less the stated one.
    moved_um, moved_sigma_um : float
        e of a sinusoid: the film's displacement less the laser's reading; its noise, if the rest is
        noise.
    rest : float
        RMS of what the model leaves, as a share of the light.
    saturated : float
        Share of bins with a saturated pixel.
    shows : int
        The frame whose pattern this one fits best.
    lit : float
        Share of the bins where a Gray frame is predicted bright: 0 or 1 where the mirror shows no
        edge of that bit.
    """

    level: float
    swing: float
    step_rad: float
    moved_um: float
    moved_sigma_um: float
    rest: float
    saturated: float
    shows: int
    lit: float = 1.0


def measure_frames(
    stack: FrameStack, binned: Binned, scene: SampledBins, readable: list[int]
) -> dict[int, FrameEvidence]:
    """Measure what each readable frame shows.

    Parameters
    ----------
    stack, binned : FrameStack, Binned
        The set, and its frames as means over bins.
    scene : SampledBins
        The mirror's bins, with the phases that the fitted surface predicts.
    readable : list of int
        Frames that hold a picture.

    Returns
    -------
    dict
        The evidence by frame.
    """
    # What each frame should show, with the film where the laser saw it.
    scene = scene.thin_to()
    readings_um = np.nan_to_num(stack.displacement_um - np.nan_to_num(stack.mean_reading_um))
    models = [
        make_frame_model(stack, scene, k, float(reading_um))
        for k, reading_um in enumerate(readings_um)
    ]
    waves = [model.wave() for model in models]

    # What it shows: the pattern that it is most like, and the light, step and place that fit its
    # own pattern best.
    evidence = {}
    for k in readable:
        seen = binned.means[k].reshape(-1)[scene.index].astype(float)
        saturated = float(np.mean(binned.saturated[k].reshape(-1)[scene.index]))
        shows = _find_best_pattern(seen, waves, scene.light, k)
        solution = solve_frame(seen, models[k], scene.light)
        evidence[k] = make_evidence(solution, models[k], scene.light, saturated, shows)
    return evidence


def make_evidence(
    solution: FrameSolution, model: FrameModel, light: FloatArray, saturated: float, shows: int
) -> FrameEvidence:
    """Make the evidence of one frame.

    Parameters
    ----------
    solution : FrameSolution
        The fit of the frame.
    model : FrameModel
        What the frame should show.
    light : (n,) array
        Light of the bins by all frames.
    saturated : float
        Share of the bins with a saturated pixel.
    shows : int
        The frame whose pattern this one is most like.

    Returns
    -------
    FrameEvidence
    """
    solved = solution.coefficients
    rest = solution.rest_rms / float(np.mean(light[model.sure]))

    # A sinusoid: b cos delta and b sin delta give swing and step.
    if model.role == "sin":
        swing = max(solution.swing, _TINY)
        variance = max(float(solution.inverse[MOTION, MOTION]), 0.0)
        return FrameEvidence(
            level=float(solved[0]),
            swing=solution.swing,
            step_rad=float(np.arctan2(solved[SINE], solved[COSINE])),
            moved_um=float(solved[MOTION]) / swing,
            moved_sigma_um=solution.rest_rms * math.sqrt(variance) / swing,
            rest=rest,
            saturated=saturated,
            shows=shows,
        )

    # A Gray frame: lo and hi - lo.
    if model.role == "gray":
        lit = float(np.mean(model.columns[1][model.sure]))
        level = float(solved.sum())
        swing = float(solved[1])
        return FrameEvidence(level, swing, 0.0, 0.0, 0.0, rest, saturated, shows, lit)
    return FrameEvidence(float(solved[0]), 0.0, 0.0, 0.0, 0.0, rest, saturated, shows)


def _find_best_pattern(
    seen: FloatArray, waves: list[tuple[BoolArray, FloatArray]], light: FloatArray, own: int
) -> int:
    """The frame whose pattern a picture looks like most: the largest correlation over the light.

    A flat picture, white or black, correlates with no pattern; the answer is then its own frame.
    """
    picture = seen / np.maximum(light, _TINY)
    mean = max(float(np.mean(picture)), _TINY)
    best_likeness = _LEAST_LIKENESS
    best = own
    for frame, (sure, wave) in enumerate(waves):
        deviation = float(np.std(picture[sure]))
        if deviation < _FLAT_PICTURE * mean:
            continue
        likeness = float(picture[sure] @ wave) / deviation
        margin = _CLEARLY_MORE
        if frame == own:
            margin = 0.0
        if likeness > best_likeness + margin:
            best_likeness = likeness
            best = frame
    return best
