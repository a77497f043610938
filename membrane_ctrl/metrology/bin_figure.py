"""The figure of a checked set from its bins: what every analysis of many sets uses.

For 36 terms the bins carry all that the pixels do, at a sixteenth of the cost (decision 41).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.config import OpticsConfig
from membrane_ctrl.metrology.checked import Checked
from membrane_ctrl.metrology.covariance import pixel_sigma_adu
from membrane_ctrl.metrology.full import LASER_NOISE_UM
from membrane_ctrl.metrology.motion import combine_steps, worth_correcting
from membrane_ctrl.metrology.patterns import AXES
from membrane_ctrl.metrology.phase import phase_sigma_rad, step_weights
from membrane_ctrl.metrology.phasor import StepCombination, track
from membrane_ctrl.metrology.quality import Quality
from membrane_ctrl.metrology.reconstruct import Fit, Points, solve
from membrane_ctrl.metrology.unwrap import mm_per_rad

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class BinFigure:
    """Surface through the bins of one set.

    Attributes
    ----------
    fit : Fit
        Hencky excess and 36 terms.
    points : Points
        The bins' rays and screen points, standing on the surface.
    index : (n,) int array
        Their bins.
    sigma_mm : (2, n) array
        1 sigma of the screen points from the noise of the pixels.
    quality : Quality
        For the verdict.
    moved : bool
        Whether the film's motion between the frames was taken out.
    """

    fit: Fit
    points: Points
    index: NDArray[np.int64]
    sigma_mm: FloatArray
    quality: Quality
    moved: bool


def bin_figure(optics: OpticsConfig, checked: Checked) -> BinFigure:
    """Phases of the bins with the film's motion taken out, and the surface fitted to them."""
    stack, state = checked.stack, checked.state
    moved = worth_correcting(stack.readings_um, LASER_NOISE_UM)
    sums = [checked.binned.means[used].reshape(len(used), -1) for used in checked.view.used]
    steps = [_combination(checked, axis, moved) for axis in range(len(AXES))]
    followed = np.empty_like(state.accepted)
    # the loop takes any numbers: here means over the bins, hence a bin side of 1 in the combinations
    track(sums, state.index, steps, state.sensitivity_rad_per_um, state.accepted, followed)  # type: ignore[arg-type]
    scale = mm_per_rad(optics.pattern)
    points = state.points.subset(np.ones(state.index.size, bool))
    points.screen_mm[:] = followed[:, 0] * scale - state.offset_mm
    fit = solve(checked.tracer, points, state.surface)
    checked.tracer.intersect(points, fit.surface)
    swing = followed[:, 4]
    noise = pixel_sigma_adu(optics.camera.noise_adu) / checked.binned.bin_px
    shifts = [stack.shifts_rad(used) for used in checked.view.used]
    sigma = np.stack([phase_sigma_rad(d, noise, 1.0) / b for d, b in zip(shifts, swing, strict=True)])
    quality = _quality(optics, checked, fit, float(np.median(swing.min(axis=0))))
    return BinFigure(fit, points, state.index, scale * sigma, quality, moved)


def _combination(checked: Checked, axis: int, moved: bool) -> StepCombination:
    """How the means of the usable frames of an axis combine."""
    used = checked.view.used[axis]
    shifts = checked.stack.shifts_rad(used)
    motion_um = checked.stack.displacement_um[used] - checked.stack.mean_reading_um if moved else None
    return combine_steps(step_weights(shifts), shifts, 1, motion_um)


def _quality(optics: OpticsConfig, checked: Checked, fit: Fit, swing_adu: float) -> Quality:
    used = [k for axis in checked.view.used for k in axis]
    saturated = checked.binned.saturated[used].any(axis=0) & checked.near
    seen = (checked.view.mask & checked.near) | saturated
    area = math.pi * optics.mirror.analysis_radius_mm**2
    return Quality(
        modulation_share=swing_adu / (2**optics.camera.bits - 1),
        saturated_fraction=float(np.mean(saturated[seen])) if seen.any() else 0.0,
        valid_fraction=min(1.0, float(np.sum(checked.state.area_mm2)) / area),
        residual_urad=1e6 * math.hypot(fit.residual_x, fit.residual_y) / math.sqrt(2),
        converged=fit.converged,
    )
