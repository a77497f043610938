"""The bins of a capture set as screen points with their noise, for the calibration."""

import math
from dataclasses import replace

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.measure.capture_set import CaptureSet
from membrane_ctrl.measure.measurement import SetFigure, stack_of
from membrane_ctrl.metrology.calibration import rim_edges, screen_pose
from membrane_ctrl.metrology.figure.bin_figure import bin_figure
from membrane_ctrl.metrology.figure.set_motion import FilmMotion
from membrane_ctrl.metrology.frame_checks import bin_view
from membrane_ctrl.metrology.frame_checks.bin_orders import absolute_phases
from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.phase import phase_steps, screen_scale
from membrane_ctrl.metrology.phase.frame_stack import bin_frames
from membrane_ctrl.metrology.rays import set_phases
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.moved_screen import MovedScreen
from membrane_ctrl.metrology.reconstruction.bin_grid import BinGrid
from membrane_ctrl.metrology.reconstruction.slope_noise import pixel_sigma_adu
from membrane_ctrl.model import errors
from membrane_ctrl.model.arrays import FloatArray

# 1 sigma of the film's motion from x to y without a laser; the fringes determine it to some
# micrometres.
_MOTION_UNSEEN_UM = 100.0


def phases_of(name: str, checked: Checked, optics: OpticsConfig) -> set_phases.SetPhases:
    """The bins of a set of the film as screen points, corrected for the film's motion.

    They are those within the analysis radius that the set's own fit used. The stated geometry only
    chooses the bins and corrects the averaging of a curved phase over a bin (some 1e-3 mm, which no
    calibration changes).

    Parameters
    ----------
    name : str
        Name of the set.
    checked : Checked
        The set.
    optics : OpticsConfig
        The bench that it states.
    """
    # The motion from x to y is left to the solution: the stated lens would correct 2 % too much or
    # too little of it.
    film = FilmMotion.from_set(checked)
    x_um, y_um = film.motion_um
    within_axes = replace(film, motion_um=(x_um - x_um.mean(), y_um - y_um.mean()))
    figure = bin_figure(optics, checked, within_axes)
    motion_sigma_um = film.x_to_y_sigma_um
    if not math.isfinite(motion_sigma_um):
        motion_sigma_um = _MOTION_UNSEEN_UM
    grid = BinGrid(checked.tracer.geometry, optics.camera, checked.binned.bin_px)
    return set_phases.SetPhases(
        name=name,
        column_px=grid.column_px[figure.index],
        row_px=grid.row_px[figure.index],
        screen_mm=figure.points.screen_mm,
        sigma_mm=np.sqrt(np.mean(np.square(figure.sigma_mm), axis=0)),
        displacement_um=checked.stack.mean_reading_um,
        motion_um=float(x_um.mean() - y_um.mean()),
        motion_sigma_um=motion_sigma_um,
        moved_um=film.moved_um,
        period_mm=optics.pattern.period_mm,
    )


def phases_of_screen(capture: CaptureSet) -> set_phases.SetPhases:
    """The bins of a set of the screen itself as screen points.

    Raises RejectedError if they show no screen.
    """
    head = capture.head
    stack = stack_of(capture)
    camera = head.optics.camera
    pattern = head.optics.pattern
    geometry = Geometry.from_config(head.optics)
    binned = bin_frames(stack, 2**camera.bits - 1)
    try:
        view = bin_view.combine_frames(stack, binned, set(stack.unusable))
        phase_rad = absolute_phases(stack, binned, view, pattern)
        index = np.flatnonzero(np.isfinite(phase_rad).all(axis=0))
        grid = BinGrid(geometry, camera, binned.bin_px)
        screen_mm = screen_scale.screen_mm(phase_rad, pattern).reshape(2, -1)[:, index]
        column_px = grid.column_px[index]
        row_px = grid.row_px[index]
        screen = screen_pose.screen_seen(geometry, column_px, row_px, screen_mm)
    except (ValueError, bin_view.NoFigureError) as error:
        raise errors.RejectedError(f"{head.folder}: rejected: {error}") from None

    # Noise of the screen points: that of fringes of amplitude 1, over the amplitude; mean of x and
    # y.
    noise_adu = pixel_sigma_adu(camera.noise_adu) / binned.bin_px
    unit_sigmas_rad = [
        phase_steps.phase_sigma_rad(stack.shifts_rad(used), noise_adu, 1.0) for used in view.used
    ]
    swing_adu = view.swing_adu.reshape(2, -1)[:, index]
    sigma_rad = np.hypot(*(np.array(unit_sigmas_rad)[:, None] / swing_adu))
    sigma_mm = screen_scale.mm_per_rad(pattern) * sigma_rad / math.sqrt(2)
    return set_phases.SetPhases(
        name=head.folder.name,
        column_px=column_px,
        row_px=row_px,
        screen_mm=screen_mm,
        sigma_mm=sigma_mm,
        displacement_um=math.nan,
        artefact=screen,
        moved_screens=(MovedScreen.unknown_place(),),
        period_mm=pattern.period_mm,
    )


def edges_of(figure: SetFigure) -> FloatArray | None:
    """Edges of the light at the rim (2, n), pixels, in a full set; None where they are not
    visible.
    """
    stack = figure.checked.stack
    names = [pattern.name for pattern in figure.head.patterns]
    bad = {flag.frame for flag in figure.checked.flags} | set(stack.unusable)
    if not {"white", "black"} <= {name for k, name in enumerate(names) if k not in bad}:
        return None
    # The rim is where the light of the screen ends.
    white = stack.frames[names.index("white")].astype(float)
    black = stack.frames[names.index("black")].astype(float)
    rim_z_mm = figure.checked.tracer.vertex_z_mm + figure.figure.fit.surface.sag_mm
    radius_mm = figure.head.optics.mirror.radius_mm
    return rim_edges.find_edges(white - black, figure.checked.tracer.geometry, radius_mm, rim_z_mm)
