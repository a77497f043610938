"""What pixels of a cushion show, by the simulator's own trace: screen points with the gas lens and
with the two reflections of the front film, without frames and noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config.front_film import FrontFilmConfig
from membrane_ctrl.config.optics import CameraConfig, MirrorConfig, OpticsConfig
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.sim.optics.bench_poses import camera_pose, pixel_directions, screen_pose
from membrane_ctrl.sim.optics.film_shape import FilmShape
from membrane_ctrl.sim.optics.front_film import FrontFilm
from membrane_ctrl.sim.optics.trace_cushion import trace_cushion

SAG_MM = 37.1
RADIUS_MM = 500.0
OPTICS = OpticsConfig(
    camera=CameraConfig(width_px=612, height_px=512, pixel_um=13.8, bits=12),
    mirror=MirrorConfig(front_film=FrontFilmConfig()),
)


@dataclass(frozen=True)
class CushionPhases:
    """Pixels of a cushion.

    Attributes
    ----------
    column, row : (n,) arrays
        The pixels.
    rays : (3, n) array
        Unit vectors.
    position_mm : (2, n) array
        Where they meet the mirror.
    main_mm, seen_mm : (2, n) arrays
        Screen points by the mirror alone, and as the phases with all reflections show them.
    """

    column: FloatArray
    row: FloatArray
    rays: FloatArray
    position_mm: FloatArray
    main_mm: FloatArray
    seen_mm: FloatArray


def trace_phases(
    front: FrontFilm, columns: FloatArray, rows: FloatArray, film: FilmShape | None = None
) -> CushionPhases:
    """Trace the pixels of a grid of columns and rows."""
    film = film or FilmShape(SAG_MM)
    pose = camera_pose(OPTICS.geometry)
    column, row = (grid.ravel() for grid in np.meshgrid(columns, rows))
    directions = pixel_directions(OPTICS.camera, pose, column, row)
    found = trace_cushion(
        pose, directions, film.terms, film.sag_mm, 0.0, front, screen_pose(OPTICS.geometry)
    )
    seen = found.main.on_film(0.95 * RADIUS_MM)
    main_mm = np.stack([found.main.s_x_mm, found.main.s_y_mm])[:, seen]
    images_mm = found.images_mm[:, :, seen]

    # Phasors of the three images; those of the front film are dark beside the pattern.
    pattern = OPTICS.pattern
    rad_per_mm = 2 * np.pi / pattern.period_mm
    outside, inside = front.image_shares
    whole = np.ones(main_mm.shape, complex)
    half_mm = pattern.periods * pattern.period_mm / 2
    for share, image_mm in zip((outside, inside), images_mm, strict=True):
        with np.errstate(invalid="ignore"):
            lit = np.all(np.abs(image_mm) < half_mm, axis=0)
        turns = np.where(lit, rad_per_mm * (image_mm - main_mm), 0.0)
        whole += share / front.transmittance**2 * lit * np.exp(1j * turns)
    return CushionPhases(
        column[seen],
        row[seen],
        np.ascontiguousarray(directions[seen].T),
        np.stack([found.main.x_mm, found.main.y_mm])[:, seen],
        main_mm,
        main_mm + np.angle(whole) / rad_per_mm,
    )
