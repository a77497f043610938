"""Checks the frames of a capture set against each other, and fits a surface to its bins.

Bins of pixels give the fringe orders, a surface, and what each frame should have shown
(`set_fit`). Frames that do not belong are left out until the rest agree (`exclusion_rounds`). A
set whose frames give no figure is rejected here, with `RejectedSetError`; verdicts on the figure
itself follow from its quality (`model.shape_estimate.judge_quality`).

`figure.pixel_figure` then measures every pixel, its period taken from its bin.
"""

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.frame_checks import (
    band_removal,
    bin_view,
    frame_faults,
    frame_inspection,
    picture_orientation,
)
from membrane_ctrl.metrology.frame_checks.bin_orders import absolute_phases_of_bins
from membrane_ctrl.metrology.frame_checks.checked_set import (
    Anchor,
    Checked,
    RejectedSetError,
    vertex_z_mm,
)
from membrane_ctrl.metrology.frame_checks.exchanged_frames import (
    is_one_surface,
    put_exchanged_back,
)
from membrane_ctrl.metrology.frame_checks.exclusion_rounds import (
    exclude_bad_frames,
    flags_of_sinusoids,
)
from membrane_ctrl.metrology.phase import frame_stack
from membrane_ctrl.model.arrays import FloatArray

# Sinusoids that differ from the prediction: it may be the prediction that is wrong.
_MANY_BLAMED = 3


def check_set(
    stack: frame_stack.FrameStack, optics: OpticsConfig, anchor: Anchor | None = None
) -> Checked:
    """Check the frames of a set and fit a surface to its bins.

    Derivation: section 12 of docs/explanation/metrology.md.

    Parameters
    ----------
    stack : FrameStack
        The set.
    optics : OpticsConfig
        The bench; `camera.bits` sets saturation.
    anchor : Anchor, optional
        Gives a set without Gray code its fringe orders.

    Returns
    -------
    Checked
        The set without the frames that do not belong, and with swapped ones put back.

    Raises
    ------
    RejectedSetError
        The frames give no figure: too few of them agree, they are clipped, or pictures or pattern
        are turned or mirrored.
    """
    # Bins without the bands of the backlight.
    full_scale_adu = 2**optics.camera.bits - 1
    stack, binned, _ = band_removal.remove_bands(
        stack, frame_stack.bin_frames(stack, full_scale_adu)
    )
    try:
        # Rounds without the frames that do not belong; if these leave no figure, two frames may be
        # exchanged.
        found = exclude_bad_frames(stack, binned, optics, anchor)
    except RejectedSetError as error:
        put_back = put_exchanged_back(stack, binned, optics, anchor)
        if put_back is None:
            phase_rad = _phases_alone(stack, binned, optics, anchor)
            _require_stated_orientation(optics, stack, phase_rad, binned.bin_px)
            reason = str(error) + _find_doubt(stack, error.flags)
            raise RejectedSetError(reason, error.flags, error.saturated_fraction) from None
        found = put_back

    # Frames that agree but fit no surface may be exchanged, too.
    if not is_one_surface(found):
        found = put_exchanged_back(stack, binned, optics, anchor) or found
    _require_stated_orientation(optics, stack, found.phase_rad, binned.bin_px)
    if any(flag.defect.is_found_by_prediction for flag in found.flags):
        # A wrong orientation also predicts frames wrongly: without these, the harmonics of a
        # response leave waves that hide it.
        phase_rad = _phases_alone(stack, binned, optics, anchor)
        _require_stated_orientation(optics, stack, phase_rad, binned.bin_px)
    return found


def _phases_alone(
    stack: frame_stack.FrameStack,
    binned: frame_stack.Binned,
    optics: OpticsConfig,
    anchor: Anchor | None,
) -> FloatArray | None:
    """Absolute phases (2, rows, columns) of the bins by the frames alone; None if they give none.

    For a set whose frames contradict the geometry: no frame is left out because of it.
    """
    excluded = set(stack.unusable)
    excluded |= {flag.frame for flag in frame_inspection.find_obvious_faults(stack, binned)}
    light = None
    if anchor is not None:
        light = anchor.light
    try:
        view = bin_view.combine_frames(stack, binned, excluded, light)
        return absolute_phases_of_bins(stack, binned, view, anchor, optics)
    except (bin_view.NoFigureError, ValueError):
        return None


def _require_stated_orientation(
    optics: OpticsConfig, stack: frame_stack.FrameStack, phase_rad: FloatArray | None, bin_px: int
) -> None:
    """Raise RejectedSetError if pictures or pattern are turned or mirrored."""
    if phase_rad is None:
        return
    row, column = np.indices(phase_rad.shape[1:]).reshape(2, -1)
    places_px = np.asarray(bin_px * np.stack([column, row]) + (bin_px - 1) / 2, float)
    at_z_mm = vertex_z_mm(optics, stack.mean_reading_um)
    orientation = picture_orientation.find_orientation(
        optics, at_z_mm, places_px, phase_rad.reshape(2, -1)
    )
    if orientation is not None:
        raise RejectedSetError(orientation.describe(), ())


def _find_doubt(stack: frame_stack.FrameStack, flags: tuple[frame_faults.Flag, ...]) -> str:
    """The doubt that the geometry is wrong, if many frames differ from what it predicts; else "".

    Pictures that are the same, unreadable or dark need no prediction.
    """
    blamed = [
        flag for flag in flags_of_sinusoids(stack, flags) if flag.defect.is_found_by_prediction
    ]
    if len(blamed) < _MANY_BLAMED:
        return ""
    return "; with this many frames blamed, check the geometry and the axes of these pictures"
