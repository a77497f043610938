"""Focal length, principal point and distortion from photographs of a board (OpenCV's calibration).

The model is the one that the self-calibration frees: one focal length, k1, k2, p1, p2. Views that
fit much worse than the others (blurred, a corner mistaken for its neighbour) are left out and
named.

The errors of the corners of one view are not independent: blur, light and the board's form shift
them together. So the sigmas are those of the scatter between the views (jackknife: the fit is
repeated without each of them), and of a board that is not flat. OpenCV's sigmas, of independent
corners, are the least.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from membrane_ctrl.config.schema import CameraConfig
from membrane_ctrl.model.arrays import ArrayLike, FloatArray

LEAST_VIEWS = 4  # each has a pose of its own; with fewer the lens hides in the poses
LEAST_CORNERS = 12  # of a view
_WORSE = 3.0  # times the median view's error
# Bow of a board over its longest side: paper on a plate, a screen
FLATNESS = 2e-4
# Corners that the picture of a plane leaves by this many squares are not those of the board, and a
# lens that leaves this share of a square on average fits none
_OF_ANOTHER_BOARD, _LEFT_OF_CORNERS = 0.5, 0.1
_SMALLEST_SQUARE_PX = 2.0
_FOCAL_UNKNOWN = 0.2  # relative sigma of a focal length about which nothing was learned
_SPLIT_VIEWS = 2 * LEAST_VIEWS  # fewer views are not tested for two cameras
_FOCAL_SPREAD = np.linspace(-0.08, 0.08, 33)  # of the focal length, tried on each view
_SPLIT_SIGMAS = 5.0
_SPLIT_BETTER = 0.8  # residual of two cameras over that of one
_SPLIT_STEPS = 3  # in which each view goes to the camera that fits it better
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
    """Fit focal length, principal point and distortion of the lens.

    Parameters
    ----------
    views : sequence of BoardView
        The corners in each photograph.
    stated : CameraConfig
        Where the fit begins, and what the result is compared with.

    Raises
    ------
    ValueError
        With fewer than `LEAST_VIEWS` views of `LEAST_CORNERS` corners, if nothing fits, or if the
        views do not determine the lens.
    """
    # Fit without the worst view, until no view is much worse than the others.
    seen = [view for view in views if len(view.place) >= LEAST_CORNERS]
    bent = [view.name for view in seen if _plane_misfit(view) > _OF_ANOTHER_BOARD]
    good = [view for view in seen if view.name not in bent]
    while True:
        if len(good) < LEAST_VIEWS:
            named = ", ".join(bent)
            also = f"; the corners in {named} do not lie on a plane board" if bent else ""
            raise ValueError(
                f"the board is seen in {len(good)} photographs; at least {LEAST_VIEWS} are "
                f"needed, tilted both ways{also}"
            )
        rms, matrix, lens, sigmas, errors = _fit_camera(good, stated)
        worst = int(np.argmax(errors))
        if errors[worst] <= _WORSE * float(np.median(errors)):
            break
        good = good[:worst] + good[worst + 1 :]
    focal_px = float(matrix[0, 0])
    names = {view.name for view in good}
    found = _parameters(matrix, lens)

    # Sigmas: those of independent corners (in OpenCV's order: fx, fy, cx, cy, k1, k2, p1, p2) or of
    # the scatter between the views, the larger one, and the effect of a board that is not flat.
    independent = np.array([sigmas[1] / focal_px, *sigmas[2:8]])
    scatter = _jackknife_sigmas(good, stated)
    flatness = _parameters(*_fit_camera(_bowed_views(good), stated)[1:3]) - found
    values = np.hypot(np.maximum(independent, scatter), flatness)
    _require_determined(good, values, rms)
    _refuse_two_cameras(good, stated, matrix, lens, rms)
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


def _plane_misfit(view: BoardView) -> float:
    """What the picture of a plane leaves of the corners, RMS, in sides of a square.

    Infinite without a plane, or with corners that are no numbers. A lens's distortion leaves a few
    hundredths.
    """
    square_px = _square_px(view)
    if not np.isfinite(view.seen_px).all() or square_px < _SMALLEST_SQUARE_PX:
        return math.inf
    plane, _ = cv2.findHomography(view.place[:, :2], view.seen_px)
    if plane is None or not np.isfinite(plane).all():
        return math.inf
    expected = cv2.perspectiveTransform(view.place[:, None, :2].astype(float), plane)[:, 0]
    off_px = np.sqrt(np.mean(np.sum((expected - view.seen_px) ** 2, axis=1)))
    return float(off_px) / square_px


def _square_px(view: BoardView) -> float:
    """About the side of a square in the picture, of a board whose squares have the side 1."""
    spans = [float(np.linalg.norm(np.std(part, axis=0))) for part in (view.seen_px, view.place)]
    return spans[0] / max(spans[1], 1e-9)


def _require_determined(views: Sequence[BoardView], sigmas: FloatArray, rms_px: float) -> None:
    """Raise ValueError if the fit leaves too much, or does not determine the lens."""
    square_px = float(np.median([_square_px(view) for view in views]))
    if rms_px > _LEFT_OF_CORNERS * square_px:
        raise ValueError(
            f"the corners are {rms_px:.1f} px RMS off with the best lens, {rms_px / square_px:.0%} "
            "of a square: cause unknown; it looks like corners mistaken for their neighbours, a "
            "board that is not flat, or photographs of several boards"
        )
    unknown = [
        name
        for name, sigma in zip(_NAMES, sigmas, strict=True)
        if not np.isfinite(sigma) or (name == "focal_relative" and sigma > _FOCAL_UNKNOWN)
    ]
    if unknown:
        raise ValueError(
            f"the photographs do not determine {', '.join(unknown)}: the board must be tilted by "
            "about 30 degrees both ways, and fill the picture"
        )


def _parameters(matrix: FloatArray, lens: FloatArray) -> FloatArray:
    """Logarithm of the focal length, principal point, k1, k2, p1, p2."""
    return np.array([np.log(matrix[0, 0]), matrix[0, 2], matrix[1, 2], *lens[:4]])


def _jackknife_sigmas(views: Sequence[BoardView], stated: CameraConfig) -> FloatArray:
    """Sigmas (7,) of the parameters from fits without each view in turn."""
    count = len(views)
    without = np.array(
        [
            _parameters(*_fit_camera([*views[:k], *views[k + 1 :]], stated)[1:3])
            for k in range(count)
        ]
    )
    squares = np.sum((without - without.mean(axis=0)) ** 2, axis=0)
    return np.asarray(np.sqrt((count - 1) / count * squares))


def _bowed_views(views: Sequence[BoardView]) -> list[BoardView]:
    """The views as if the board were bowed by `FLATNESS` of its longest side."""
    every = np.concatenate([view.place for view in views])[:, :2]
    middle = (every.max(axis=0) + every.min(axis=0)) / 2
    side = float(np.max(np.ptp(every, axis=0)))
    bowed = []
    for view in views:
        place = view.place.astype(float).copy()
        square = np.sum((place[:, :2] - middle) ** 2, axis=1)
        place[:, 2] += FLATNESS * side * (1 - square / (side / 2) ** 2)
        bowed.append(replace(view, place=place))
    return bowed


def _refuse_two_cameras(
    views: Sequence[BoardView],
    stated: CameraConfig,
    matrix: FloatArray,
    lens: FloatArray,
    rms: float,
) -> None:
    """Raise ValueError if the views fall into two groups with focal lengths of their own.

    Each view is tried with focal lengths about the common one. The views are ordered by the best,
    and split where the two groups fit best. The groups are of two cameras only if both focal
    lengths differ by far more than their scatter, and the residual falls.
    """
    if len(views) < _SPLIT_VIEWS:
        return
    best = [_best_focal(view, matrix, lens) for view in views]
    ordered = [views[k] for k in np.argsort(best)]
    gaps = np.diff(np.sort(best))[LEAST_VIEWS - 1 : len(views) - LEAST_VIEWS]
    split = LEAST_VIEWS + int(np.argmax(gaps))
    groups = [ordered[:split], ordered[split:]]
    fits = [_fit_camera(group, stated) for group in groups]
    for _ in range(_SPLIT_STEPS):
        left = np.array([[_rms_px([view], *fit[1:3]) for fit in fits] for view in views])
        first = left[:, 0] < left[:, 1]
        if min(np.count_nonzero(first), np.count_nonzero(~first)) < LEAST_VIEWS:
            return
        groups = [
            [view for view, its in zip(views, mine, strict=True) if its] for mine in (first, ~first)
        ]
        fits = [_fit_camera(group, stated) for group in groups]
    counts = [sum(len(view.place) for view in group) for group in groups]
    squares = sum(fit[0] ** 2 * count for fit, count in zip(fits, counts, strict=True))
    apart = abs(float(np.log(fits[0][1][0, 0] / fits[1][1][0, 0])))
    scatter = math.hypot(*(_jackknife_focal(group, stated) for group in groups))
    if apart > _SPLIT_SIGMAS * scatter and np.sqrt(squares / sum(counts)) < _SPLIT_BETTER * rms:
        names = [", ".join(view.name for view in group) for group in groups]
        focal = [float(fit[1][0, 0]) for fit in fits]
        raise ValueError(
            f"the photographs are of two cameras, or the focus was changed: {names[0]} have a "
            f"focal length of {focal[0]:.1f} px, {names[1]} of {focal[1]:.1f} px"
        )


def _best_focal(view: BoardView, matrix: FloatArray, lens: FloatArray) -> float:
    """Relative change of the focal length with which one view fits best."""
    left = []
    for change in _FOCAL_SPREAD:
        tried = matrix.copy()
        tried[0, 0] *= 1 + change
        tried[1, 1] *= 1 + change
        left.append(_rms_px([view], tried, lens))
    return float(_FOCAL_SPREAD[int(np.argmin(left))])


def _jackknife_focal(views: Sequence[BoardView], stated: CameraConfig) -> float:
    """Relative sigma of the focal length of a group, from fits without each of its views."""
    return float(_jackknife_sigmas(views, stated)[0])


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
