"""Rows of the error budget for the film's motion during a set, and the doubts that it raises."""

import math
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.metrology.figure.set_motion import FilmMotion
from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.uncertainty import bench_sources
from membrane_ctrl.metrology.uncertainty.budget import Source
from membrane_ctrl.metrology.uncertainty.corrected_motion_error import SensitivityError
from membrane_ctrl.metrology.uncertainty.geometry_spread import GeometrySpread
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench
from membrane_ctrl.metrology.uncertainty.unseen_motion import UnseenMotion, estimate_unseen_motion
from membrane_ctrl.model.arrays import FloatArray

# What the correction for the film's motion from frame to frame leaves, besides a share of the
# motion by the geometry: the fringes' error in the film's place.
_FRINGES_UM = 0.1


@dataclass(frozen=True)
class FilmMotionRows:
    """What the film's motion during a set contributes to its budget.

    Attributes
    ----------
    motion : FilmMotion
        Motion by laser and fringes.
    unseen : UnseenMotion or None
        Motion from x to y by the fringes alone, of a set without a laser.
    rows : tuple of Source
        The rows; the sigma of the first one is the error of the motion from x to y in µm.
    frame_to_frame_um : float
        RMS motion from frame to frame that the phases contain.
    doubts : tuple of str
        Why the figure is degraded, for people.
    """

    motion: FilmMotion
    unseen: UnseenMotion | None
    rows: tuple[Source, ...]
    frame_to_frame_um: float
    doubts: tuple[str, ...]


def find_film_motion_rows(
    bench: TrialBench,
    checked: Checked,
    spread: GeometrySpread,
    laser_relative: float,
    noise_mm2: FloatArray,
) -> FilmMotionRows:
    """Find the rows for the film's motion from x to y: by the laser, or by the fringes.

    Section 3 of docs/explanation/uncertainty.md.

    Parameters
    ----------
    bench : TrialBench
        Some points of the set.
    checked : Checked
        The set.
    spread : GeometrySpread
        Covariance of the geometry.
    laser_relative : float
        Standard uncertainty of the laser's scale.
    noise_mm2 : (2,) array
        Variance of the screen point of a bin, along x and y, from the noise of the pixels.

    Returns
    -------
    FilmMotionRows
    """
    motion = FilmMotion.from_set(checked)
    unseen = None
    if not math.isfinite(motion.x_to_y_sigma_um):
        unseen = estimate_unseen_motion(bench, spread, noise_mm2)
    rows, doubts = _describe_motion(bench, motion, unseen)

    # If the phases are corrected, the error of the correction is left instead of the motion.
    film_um = math.hypot(motion.moved_um, motion.noise_um)
    if motion.is_worth_correcting:
        error = SensitivityError.from_spread(bench, spread, laser_relative)
        film_um = math.hypot(_FRINGES_UM, error.relative * motion.moved_um, motion.noise_um)
        x_um, y_um = (float(of_axis_um.mean()) for of_axis_um in motion.motion_um)
        rows.append(error.source(bench, x_um, y_um))
    return FilmMotionRows(motion, unseen, tuple(rows), film_um, tuple(doubts))


def _describe_motion(
    bench: TrialBench, motion: FilmMotion, unseen: UnseenMotion | None
) -> tuple[list[Source], list[str]]:
    """Rows for the film's motion from x to y, and the doubts that it raises.

    Parameters
    ----------
    bench : TrialBench
        Some points of the set.
    motion : FilmMotion
        Motion by laser and fringes.
    unseen : UnseenMotion or None
        Motion by the fringes alone, of a set without a laser.
    """
    if unseen is None:
        left_um = 0.0
        if not motion.is_worth_correcting:
            x_um, y_um = motion.motion_um
            left_um = float(x_um.mean() - y_um.mean())
        sigma_um = math.hypot(motion.x_to_y_sigma_um, left_um)
        description = "motion of the film from x to y, by the laser"
        return [bench_sources.film_source(bench, (sigma_um,), description, paired=False)], []

    # Without a laser: the motion, with the parts of its error that sets share (the geometry, and
    # slopes that patches of the mirror leave); the noise of the fringes, which they do not.
    description = "motion of the film from x to y, without a laser"
    sigmas_um = (unseen.moved_um, unseen.shared_um)
    source = bench_sources.film_source(bench, sigmas_um, description, paired=True)
    description = "slopes of patches of the mirror that look like motion of the film from x to y"
    by_patch = bench_sources.film_source(bench, unseen.patches_um, description, paired=True)
    noise_mm2 = float(np.sum(by_patch.effects_mm**2)) * unseen.noise_share
    description = "noise of the fringes that show the film's motion from x to y"
    noise = bench_sources.film_source(bench, (unseen.noise_um,), description, paired=False)
    rows = [
        source,
        replace(by_patch, name="film_patches_um", noise_mm2=noise_mm2),
        replace(noise, name="film_seen_um"),
    ]
    if not unseen.is_significant:
        return rows, []
    doubt = (
        f"the film moved by {unseen.moved_um:+.0f} +- {unseen.sigma_um:.0f} µm from the x to the y "
        "frames, seen in the fringes: record the laser's readings"
    )
    return rows, [doubt]
