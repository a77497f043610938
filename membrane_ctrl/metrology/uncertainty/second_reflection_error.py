"""Error of the figure by a second image of the screen."""

import math

import numpy as np

from membrane_ctrl.metrology.frame_checks.second_reflection import HIDDEN_RAD, SecondReflection
from membrane_ctrl.metrology.phase import screen_scale
from membrane_ctrl.metrology.uncertainty.budget import Source
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench
from membrane_ctrl.model.arrays import FloatArray

_SAYS = "second image of the screen, by another reflecting surface"
# Largest share that may hide, in sigmas; any smaller one is as likely, which has this standard
# uncertainty over the largest (JCGM 100, 4.3.7)
_HIDDEN_SIGMAS = 3.0
_UNIFORM = 1 / math.sqrt(3)
_RMS_SINE = 0.7  # of an unknown place


def second_reflection_source(bench: TrialBench, seen: SecondReflection) -> Source:
    """Return the row of the budget for a second image, found or too weak to be found.

    Parameters
    ----------
    bench : TrialBench
        Some points of the set.
    seen : SecondReflection
        What the Gray frames show; a set that cannot show a second image has a row of 0.

    Returns
    -------
    Source
        A limit if nothing was found.
    """
    # Share of the light: as found, or the largest that may hide in the noise of the Gray frames.
    sigma = 0.0
    if math.isfinite(seen.sigma):
        sigma = seen.sigma
    share = _UNIFORM * _HIDDEN_SIGMAS * sigma
    if seen.is_found:
        share = seen.share

    # Light r of another place turns a phase by r sin(phi' - phi): the surface for each axis alone.
    scale = screen_scale.mm_per_rad(bench.optics.pattern)
    effects = []
    for axis in range(2):
        off = np.zeros_like(bench.screen_mm)
        off[axis] = scale * share * _phase_error(bench.screen_mm[axis] / scale, seen, axis)
        solved = bench.solve(bench.geometry(), off, linear=True)
        effects.append(solved - bench.surface.parameters)
    if seen.is_found:  # one image: its effects on x and y belong together
        effects = [effects[0] + effects[1]]
    return Source(
        "second_image", _SAYS, share, np.stack(effects, axis=1), is_limit=not seen.is_found
    )


def _phase_error(phase: FloatArray, seen: SecondReflection, axis: int) -> FloatArray | float:
    """Error of the phase over the share; `phase` (n,) is counted from the pattern's middle."""
    if not seen.is_found:
        return _RMS_SINE
    shift = seen.shift_rad[axis]
    if not math.isfinite(shift):
        return math.sin(HIDDEN_RAD)
    return np.asarray(np.sin((seen.scale[axis] - 1) * phase + shift))
