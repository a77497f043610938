"""The light of each used sinusoid, and the place of the film during it."""

from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.metrology.frame_checks.frame_evidence import make_evidence
from membrane_ctrl.metrology.frame_checks.frame_model import (
    COSINE,
    MOTION,
    SECOND_HARMONIC,
    SINE,
    make_frame_model,
    solve_frame,
)
from membrane_ctrl.metrology.frame_checks.phase_drift import PhaseShifts
from membrane_ctrl.metrology.frame_checks.sampled_bins import SampledBins
from membrane_ctrl.metrology.phase.frame_stack import Binned, FrameStack
from membrane_ctrl.model.arrays import FloatArray, IntArray

# Pixels that are used to find the film's positions, whose noise would be taken for motion: a fixed
# number, whatever the size of the bins.
_SAMPLED_PX = 96_000
# Standard deviation of the phases, rad: fewer fringes cannot be distinguished from a contrast that
# differs over the mirror.
_SEVERAL_RAD = 6.0
_SMOOTH_ORDER = 4  # powers of the smooth deviations over the mirror with several fringes
_FLAT_ORDER = 1  # with fewer: a constant alone
# Patches across the picture: what a model leaves of a frame is independent from one to the next.
_PATCHES = 12
_CURVED = 0.01  # second harmonic over the swing beyond which a response is not straight
_TINY = 1e-9  # instead of a division by zero


@dataclass(frozen=True)
class LightAndFilm:
    """Light of the used sinusoids, where the film was, and how the picture shifted.

    Attributes
    ----------
    light : (2, frames) array
        Level and swing of the used sinusoids about the mean of their axis; 1 for other frames.
    film_um : (used,) array
        Displacement of the film during the used sinusoids of x, and then of y.
    film_noise_um : float
        Its standard uncertainty, RMS over the frames.
    shifts : two PhaseShifts
        Shifts of the phases of x and of y that the film's motion does not explain.
    """

    light: FloatArray
    film_um: FloatArray
    film_noise_um: float
    shifts: tuple[PhaseShifts, PhaseShifts]


def estimate_light_and_film(
    stack: FrameStack,
    binned: Binned,
    scene: SampledBins,
    used: tuple[list[int], list[int]],
    phase_rad: FloatArray,
) -> LightAndFilm:
    """Estimate the light of each used sinusoid, and where the film was during it.

    Each frame is compared with the light that the other axis saw: in that of its own axis it leaves
    waves, which would hide 10 % of what differs. Phases that differ smoothly from the surface's (a
    film that moved between the axes, a wrong geometry) and a contrast that differs over the mirror
    (blur) would be taken for both light and motion, so the model has them, too.

    Parameters
    ----------
    stack, binned, scene : FrameStack, Binned, SampledBins
        As in `frame_evidence.measure_frames`.
    used : two lists of int
        The used sinusoids of x and of y.
    phase_rad : (2, bins) array
        Measured absolute phases.

    Returns
    -------
    LightAndFilm
    """
    scene = scene.thin_to(_SAMPLED_PX // binned.bin_px**2)
    readings_um = np.nan_to_num(stack.displacement_um - stack.mean_reading_um)

    # Polynomials in the place on the mirror, to which the phases are about proportional.
    spread_rad = scene.phase_rad.std(axis=1)
    u, v = (scene.phase_rad - scene.phase_rad.mean(axis=1)[:, None]) / spread_rad[:, None]
    order = _FLAT_ORDER
    if spread_rad.min() > _SEVERAL_RAD:
        order = _SMOOTH_ORDER
    smooth = np.stack([u**p * v**q for p in range(order) for q in range(order - p)])

    # The predicted phases plus a smooth fit of what the measured ones deviate from them.
    deviation_rad = phase_rad[:, scene.index] - scene.phase_rad
    smooth_rad = deviation_rad @ np.linalg.pinv(smooth) @ smooth
    scene = replace(scene, phase_rad=scene.phase_rad + smooth_rad)

    # Each frame by its model, with a contrast that differs over the mirror, and with the light that
    # the other axis saw.
    contrast = smooth[1:]
    if order == _SMOOTH_ORDER:
        contrast = scene.smooth_columns()[1:]
    contrast = contrast - contrast.mean(axis=1, keepdims=True)
    patch = _assign_patches(scene.places_px)
    means = binned.means.reshape(len(stack.patterns), -1)[:, scene.index].astype(float)
    light = np.ones((2, len(stack.patterns)))
    film_um = np.empty(0)
    sigma_um = np.empty(0)
    shifts = []
    for axis, (own, others) in enumerate((used, used[::-1])):
        light_of_others = stack.weights(others)[0] @ means[others]
        sensitivity = scene.sensitivity_rad_per_um[axis]
        found = []
        patches_rad = []
        for k in own:
            model = make_frame_model(stack, scene, k, float(readings_um[k]))
            columns = np.vstack([model.columns, model.columns[COSINE] * contrast])
            model = replace(model, columns=columns)
            solution = solve_frame(means[k], model, light_of_others)
            # A curved response has harmonics, which differ over the mirror, too: by blur, or by the
            # angle of view.
            if solution.second_harmonic > _CURVED:
                more = model.columns[SECOND_HARMONIC] * contrast
                model = replace(model, columns=np.vstack([columns, more]))
                solution = solve_frame(means[k], model, light_of_others)
            found.append(make_evidence(solution, model, light_of_others, 0.0, k))
            per_unit = np.array([1.0, -sensitivity.mean()])
            influence = per_unit @ solution.inverse[[SINE, MOTION]] @ solution.columns
            parts_rad = influence * solution.rest / max(solution.swing, _TINY)
            patches_rad.append(np.bincount(patch, parts_rad, _PATCHES**2))
        places_um = readings_um[own] + [each.moved_um for each in found]
        shift_rad = [each.step_rad - sensitivity.mean() * each.moved_um for each in found]
        film_rad = float(np.sqrt(np.mean(sensitivity**2)) * np.std(places_um))
        frames = np.array(own, float)
        shifts.append(PhaseShifts(frames, np.array(shift_rad), film_rad, np.array(patches_rad)))

        # Light about the mean of the axis, and the film's place: the laser's reading corrected.
        level_and_swing = np.array([[each.level, each.swing] for each in found]).T
        light[:, own] = level_and_swing / level_and_swing.mean(axis=1, keepdims=True)
        film_um = np.append(film_um, places_um)
        sigma_um = np.append(sigma_um, [each.moved_sigma_um for each in found])
    noise_um = float(np.sqrt(np.mean(sigma_um**2)))
    return LightAndFilm(light, film_um, noise_um, (shifts[0], shifts[1]))


def _assign_patches(places_px: FloatArray) -> IntArray:
    """Number (n,) of the patch of the picture that each place (2, n) is in."""
    first_px = places_px.min(axis=1, keepdims=True)
    reach_px = np.maximum(np.ptp(places_px, axis=1, keepdims=True), _TINY)
    in_patches = (places_px - first_px) / reach_px * _PATCHES
    column, row = np.clip(in_patches.astype(int), 0, _PATCHES - 1)
    return np.asarray(row * _PATCHES + column)
