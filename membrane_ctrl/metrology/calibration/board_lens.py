"""Focal length, principal point and distortion from photographs of a board (OpenCV's calibration).

The model is the one that the self-calibration frees: one focal length, k1, k2, p1, p2. Views that
fit much worse than the others (blurred, a corner mistaken for its neighbour) are left out and
named.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from membrane_ctrl.config.schema import CameraConfig
from membrane_ctrl.model.arrays import ArrayLike, FloatArray

LEAST_VIEWS = 4  # each has a pose of its own; with fewer the lens hides in the poses
LEAST_CORNERS = 12  # of a view
_WORSE = 3.0  # times the median view's error
_FLAGS = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_FIX_K3
_NAMES = ("focal_relative", "principal_x_px", "principal_y_px", "k1", "k2", "p1", "p2")


@dataclass(frozen=True)
class BoardView:
    """Corners of one photograph: place (n, 3) on the board in any unit, (n, 2) in px."""

    name: str
    place: FloatArray
    seen_px: FloatArray


@dataclass(frozen=True)
class Lens:
    """Result of the views."""

    focal_px: float
    principal_px: tuple[float, float]
    distortion: tuple[float, ...]  # k1, k2, p1, p2
    sigmas: dict[str, float]  # by the calibration's names of the parameters
    rms_px: float  # residual of a corner (both components), with this lens and with the stated one
    stated_rms_px: float
    used: tuple[str, ...]  # names of views
    left_out: tuple[str, ...]


def calibrate_lens(views: Sequence[BoardView], stated: CameraConfig) -> Lens:
    """Fit the lens.

    Raises ValueError with fewer than `LEAST_VIEWS` views of `LEAST_CORNERS` corners, or if nothing
    fits. `stated` is where the fit begins, and what the result is compared with.
    """
    good = [view for view in views if len(view.place) >= LEAST_CORNERS]
    while True:
        if len(good) < LEAST_VIEWS:
            raise ValueError(
                f"the board is seen in {len(good)} photographs; at least {LEAST_VIEWS} are "
                "needed, tilted both ways"
            )
        rms, matrix, lens, sigmas, errors = _fit_camera(good, stated)
        worst = int(np.argmax(errors))
        if errors[worst] <= _WORSE * float(np.median(errors)):
            break
        good = good[:worst] + good[worst + 1 :]
    focal_px = float(matrix[0, 0])
    names = {view.name for view in good}
    values = [sigmas[1] / focal_px, *sigmas[2:8]]  # OpenCV's order: fx, fy, cx, cy, k1, k2, p1, p2
    return Lens(
        focal_px=focal_px,
        principal_px=(float(matrix[0, 2]), float(matrix[1, 2])),
        distortion=tuple(float(k) for k in lens[:4]),
        sigmas=dict(zip(_NAMES, map(float, values), strict=True)),
        rms_px=rms,
        stated_rms_px=_rms_px(good, _camera_matrix(stated), np.array(stated.distortion, float)),
        used=tuple(view.name for view in good),
        left_out=tuple(view.name for view in views if view.name not in names),
    )


def _fit_camera(
    views: Sequence[BoardView], stated: CameraConfig
) -> tuple[float, FloatArray, FloatArray, FloatArray, FloatArray]:
    """RMS, camera matrix, distortion, sigmas of the intrinsics, RMS of each view."""
    places = [view.place.astype(np.float32)[:, None] for view in views]
    seen = [view.seen_px.astype(np.float32)[:, None] for view in views]
    size = (stated.width_px, stated.height_px)
    try:
        rms, matrix, lens, _, _, sigmas, _, errors = cv2.calibrateCameraExtended(
            places, seen, size, _camera_matrix(stated), np.zeros(5), flags=_FLAGS
        )
    except cv2.error as error:
        raise ValueError(f"no lens fits the photographs: {str(error).splitlines()[0]}") from None
    if not np.isfinite(rms):
        raise ValueError("no lens fits the photographs")
    return (
        float(rms),
        np.asarray(matrix, float),
        _flatten_row(lens),
        _flatten_row(sigmas),
        _flatten_row(errors),
    )


def _flatten_row(values: ArrayLike) -> FloatArray:
    return np.asarray(values, float).ravel()


def _rms_px(views: Sequence[BoardView], matrix: FloatArray, lens: FloatArray) -> float:
    """Residual of the corners with a given lens, each view with its own best pose."""
    squares, count = 0.0, 0
    for view in views:
        _, turn, shift = cv2.solvePnP(view.place, view.seen_px, matrix, lens)
        expected = cv2.projectPoints(view.place, turn, shift, matrix, lens)[0][:, 0]
        squares += float(np.sum((expected - view.seen_px) ** 2))
        count += len(expected)
    return float(np.sqrt(squares / count))


def _camera_matrix(camera: CameraConfig) -> FloatArray:
    focal_px = camera.focal_mm / (camera.pixel_um * 1e-3)
    column, row = camera.principal
    return np.array([[focal_px, 0.0, column], [0.0, focal_px, row], [0.0, 0.0, 1.0]])
