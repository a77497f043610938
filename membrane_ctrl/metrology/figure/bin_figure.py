"""The figure of a checked set from its bins, for the analysis of many sets.

For Zernike terms the bins carry as much information as the pixels, at a sixteenth of the cost
(decision 41).
"""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.figure.set_motion import FilmMotion, combine_axis_steps
from membrane_ctrl.metrology.figure.set_quality import set_quality
from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.phase import phase_change, phase_steps, screen_scale
from membrane_ctrl.metrology.rays import ray_tracing
from membrane_ctrl.metrology.reconstruction import slope_noise, surface_fit
from membrane_ctrl.model.arrays import FloatArray, IntArray
from membrane_ctrl.model.shape_estimate import Quality


@dataclass(frozen=True)
class BinFigure:
    """Surface through the bins of one set.

    Attributes
    ----------
    fit : surface_fit.Fit
        Hencky excess and Zernike terms.
    points : ray_tracing.Points
        The bins' rays and screen points, followed to the surface.
    index : (n,) int array
        Numbers of the bins.
    sigma_mm : (2, n) array
        Standard uncertainty of the screen points from the noise of the pixels.
    quality : Quality
        Quality of the fit, for the verdict.
    """

    fit: surface_fit.Fit
    points: ray_tracing.Points
    index: IntArray
    sigma_mm: FloatArray
    quality: Quality


def bin_figure(optics: OpticsConfig, checked: Checked, film: FilmMotion | None = None) -> BinFigure:
    """Phases of the bins, corrected for the film's motion, and the surface fitted to them.

    Parameters
    ----------
    optics : OpticsConfig
        The bench.
    checked : Checked
        The set.
    film : FilmMotion, optional
        Motion of the film, by default from laser and fringes.

    Returns
    -------
    BinFigure
    """
    state = checked.state
    film = film or FilmMotion.from_set(checked)

    # Phases of the bins. The loop takes any numbers: here means over the bins instead of sums,
    # hence bins of one pixel in the combinations of the steps.
    means = [checked.binned.means[used].reshape(len(used), -1) for used in checked.view.used]
    motion_um = film.motion_um if film.is_worth_correcting else (None, None)
    steps = [
        combine_axis_steps(checked, axis, of_axis_um) for axis, of_axis_um in enumerate(motion_um)
    ]
    followed = np.empty_like(state.accepted)
    phase_change.update_phases(
        means, state.index, steps, state.sensitivity_rad_per_um, state.accepted, followed
    )

    # Their surface.
    mm_per_rad = screen_scale.mm_per_rad(optics.pattern)
    points = state.points.subset(np.ones(state.index.size, bool))
    points.screen_mm[:] = followed[:, 0] * mm_per_rad - state.offset_mm
    fit = surface_fit.fit_surface(checked.tracer, points, state.surface)
    checked.tracer.intersect(points, fit.surface)

    # Standard uncertainty of the screen points from the noise of the pixels.
    swing_adu = followed[:, 4]
    noise_adu = slope_noise.pixel_sigma_adu(optics.camera.noise_adu) / checked.binned.bin_px
    sigma_rad = np.empty_like(swing_adu)
    for axis, used in enumerate(checked.view.used):
        # That of fringes of amplitude 1, over the amplitude.
        shifts_rad = checked.stack.shifts_rad(used)
        unit_sigma_rad = phase_steps.phase_sigma_rad(shifts_rad, noise_adu, 1.0)
        sigma_rad[axis] = unit_sigma_rad / swing_adu[axis]
    quality = set_quality(optics, checked, fit, float(np.median(swing_adu.min(axis=0))))
    return BinFigure(fit, points, state.index, mm_per_rad * sigma_rad, quality)
