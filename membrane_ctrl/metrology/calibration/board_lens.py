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

LEAST_VIEWS = 4  # each has its own pose; with fewer, the poses absorb errors of the lens
LEAST_CORNERS = 12  # of a view
_WORSE = 3.0  # times the median view's error
# Bow of a board over its longest side: paper on a plate, a screen
FLATNESS = 2e-4
# Corners that are off the picture of a plane by this many squares are not those of the board.
_LARGEST_PLANE_MISFIT = 0.5
_LARGEST_RESIDUAL = 0.1  # of a lens, in squares on average: with more it fits no photograph
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
    """Corners of one photograph.

    Attributes
    ----------
    name : str
        Name of the photograph.
    place : (n, 3) array
        Places on the board, in any unit.
    seen_px : (n, 2) array
        Columns and rows in the photograph.
    """

    name: str
    place: FloatArray
    seen_px: FloatArray


@dataclass(frozen=True)
class Lens:
    """The lens that fits the views.

    Attributes
    ----------
    focal_px : float
        Focal length over the pixels' pitch.
    principal_px : (float, float)
        Column and row of the principal point.
    distortion : tuple of float
        k1, k2, p1, p2.
    sigmas : dict
        Standard uncertainties by the calibration's names of the parameters.
    rms_px : float
        Residual of a corner (both components) with this lens.
    stated_rms_px : float
        The same with the stated lens.
    used, left_out : tuples of str
        Names of the views.
    """

    focal_px: float
    principal_px: tuple[float, float]
    distortion: tuple[float, ...]
    sigmas: dict[str, float]
    rms_px: float
    stated_rms_px: float
    used: tuple[str, ...]
    left_out: tuple[str, ...]


@dataclass(frozen=True)
class _CameraFit:
    """OpenCV's fit of some views.

    Attributes
    ----------
    rms_px : float
        Residual of a corner.
    matrix : (3, 3) array
        Camera matrix.
    lens : (5,) array
        k1, k2, p1, p2, k3 = 0.
    sigmas : (18,) array
        OpenCV's sigmas of the intrinsics, of independent corners: fx, fy, cx, cy, k1, ...
    view_rms_px : (views,) array
        Residual of each view.
    """

    rms_px: float
    matrix: FloatArray
    lens: FloatArray
    sigmas: FloatArray
    view_rms_px: FloatArray

    @property
    def focal_px(self) -> float:
        """Focal length over the pixels' pitch."""
        return float(self.matrix[0, 0])

    @property
    def parameters(self) -> FloatArray:
        """Logarithm of the focal length, principal point, k1, k2, p1, p2."""
        principal = [self.matrix[0, 2], self.matrix[1, 2]]
        return np.array([np.log(self.matrix[0, 0]), *principal, *self.lens[:4]])


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
    # Views with enough corners, all on a plane.
    seen = [view for view in views if len(view.place) >= LEAST_CORNERS]
    bent = [view.name for view in seen if _plane_misfit(view) > _LARGEST_PLANE_MISFIT]
    good = [view for view in seen if view.name not in bent]

    # Fit without the worst view, until no view is much worse than the others.
    while True:
        _require_views(good, bent)
        fit = _fit_camera(good, stated)
        worst = int(np.argmax(fit.view_rms_px))
        if fit.view_rms_px[worst] <= _WORSE * float(np.median(fit.view_rms_px)):
            break
        good = good[:worst] + good[worst + 1 :]

    # Sigmas: those of independent corners (in OpenCV's order: fx, fy, cx, cy, k1, k2, p1, p2) or of
    # the scatter between the views, the larger one, and the effect of a board that is not flat.
    independent = np.array([fit.sigmas[1] / fit.focal_px, *fit.sigmas[2:8]])
    scatter = _jackknife_sigmas(good, stated)
    flatness = _fit_camera(_bowed_views(good), stated).parameters - fit.parameters
    sigmas = np.hypot(np.maximum(independent, scatter), flatness)
    _require_determined(good, sigmas, fit.rms_px)
    _refuse_two_cameras(good, stated, fit)

    stated_lens = np.array(stated.distortion, float)
    used = [view.name for view in good]
    return Lens(
        focal_px=fit.focal_px,
        principal_px=(float(fit.matrix[0, 2]), float(fit.matrix[1, 2])),
        distortion=tuple(float(k) for k in fit.lens[:4]),
        sigmas=dict(zip(_NAMES, map(float, sigmas), strict=True)),
        rms_px=fit.rms_px,
        stated_rms_px=_rms_px(good, _camera_matrix(stated), stated_lens),
        used=tuple(used),
        left_out=tuple(view.name for view in views if view.name not in used),
    )


def _require_views(good: Sequence[BoardView], bent: Sequence[str]) -> None:
    """Raise ValueError if fewer than `LEAST_VIEWS` views are left; `bent` are those off a plane."""
    if len(good) >= LEAST_VIEWS:
        return
    also = ""
    if bent:
        also = f"; the corners in {', '.join(bent)} do not lie on a plane board"
    raise ValueError(
        f"the board is seen in {len(good)} photographs; at least {LEAST_VIEWS} are "
        f"needed, tilted both ways{also}"
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

    # A plane seen by a pinhole is a homography of its places; what is left is distortion.
    expected = cv2.perspectiveTransform(view.place[:, None, :2].astype(float), plane)[:, 0]
    off_px = np.sqrt(np.mean(np.sum((expected - view.seen_px) ** 2, axis=1)))
    return float(off_px) / square_px


def _square_px(view: BoardView) -> float:
    """About the side of a square in the picture, of a board whose squares have the side 1."""
    span_px = float(np.linalg.norm(np.std(view.seen_px, axis=0)))
    span = float(np.linalg.norm(np.std(view.place, axis=0)))
    return span_px / max(span, 1e-9)


def _require_determined(views: Sequence[BoardView], sigmas: FloatArray, rms_px: float) -> None:
    """Raise ValueError if the fit leaves too much, or does not determine the lens."""
    square_px = float(np.median([_square_px(view) for view in views]))
    if rms_px > _LARGEST_RESIDUAL * square_px:
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


def _jackknife_sigmas(views: Sequence[BoardView], stated: CameraConfig) -> FloatArray:
    """Sigmas (7,) of the parameters from fits without each view in turn."""
    count = len(views)
    fits = [_fit_camera([*views[:k], *views[k + 1 :]], stated) for k in range(count)]
    without = np.array([fit.parameters for fit in fits])
    squares = np.sum((without - without.mean(axis=0)) ** 2, axis=0)
    return np.asarray(np.sqrt((count - 1) / count * squares))


def _bowed_views(views: Sequence[BoardView]) -> list[BoardView]:
    """The views as if the board were bowed by `FLATNESS` of its longest side."""
    # A paraboloid over the longest side, 0 at its ends and highest in the middle.
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
    views: Sequence[BoardView], stated: CameraConfig, common: _CameraFit
) -> None:
    """Raise ValueError if the views fall into two groups with focal lengths of their own.

    Each view is tried with focal lengths about the common one. The views are ordered by the best,
    and split where the two groups fit best. The groups are of two cameras only if both focal
    lengths differ by far more than their scatter, and the residual falls.
    """
    if len(views) < _SPLIT_VIEWS:
        return

    # The first split: at the widest gap between the views' own focal lengths that leaves enough
    # views on both sides.
    own_focal = [_best_focal(view, common.matrix, common.lens) for view in views]
    ordered = [views[k] for k in np.argsort(own_focal)]
    gaps = np.diff(np.sort(own_focal))[LEAST_VIEWS - 1 : len(views) - LEAST_VIEWS]
    split = LEAST_VIEWS + int(np.argmax(gaps))
    groups = [ordered[:split], ordered[split:]]
    fits = [_fit_camera(group, stated) for group in groups]

    # Each view goes to the camera that fits it better, and both are fitted again.
    for _ in range(_SPLIT_STEPS):
        groups = [[], []]
        for view in views:
            rms_px = [_rms_px([view], fit.matrix, fit.lens) for fit in fits]
            is_first = rms_px[0] < rms_px[1]
            groups[0 if is_first else 1].append(view)
        if min(len(group) for group in groups) < LEAST_VIEWS:
            return
        fits = [_fit_camera(group, stated) for group in groups]

    # Two cameras only if the focal lengths differ by far more than their scatter, and if the
    # residual falls.
    difference = abs(float(np.log(fits[0].focal_px / fits[1].focal_px)))
    scatter = math.hypot(*(_jackknife_focal(group, stated) for group in groups))
    corners = [sum(len(view.place) for view in group) for group in groups]
    squares = sum(fit.rms_px**2 * count for fit, count in zip(fits, corners, strict=True))
    rms_px_of_two = math.sqrt(squares / sum(corners))
    if difference <= _SPLIT_SIGMAS * scatter or rms_px_of_two >= _SPLIT_BETTER * common.rms_px:
        return
    first, second = (", ".join(view.name for view in group) for group in groups)
    raise ValueError(
        f"the photographs are of two cameras, or the focus was changed: {first} have a "
        f"focal length of {fits[0].focal_px:.1f} px, {second} of {fits[1].focal_px:.1f} px"
    )


def _best_focal(view: BoardView, matrix: FloatArray, lens: FloatArray) -> float:
    """Relative change of the focal length with which one view fits best."""
    rms_px = []
    for change in _FOCAL_SPREAD:
        tried = matrix.copy()
        tried[0, 0] *= 1 + change
        tried[1, 1] *= 1 + change
        rms_px.append(_rms_px([view], tried, lens))
    return float(_FOCAL_SPREAD[int(np.argmin(rms_px))])


def _jackknife_focal(views: Sequence[BoardView], stated: CameraConfig) -> float:
    """Relative sigma of the focal length of a group, from fits without each of its views."""
    return float(_jackknife_sigmas(views, stated)[0])


def _fit_camera(views: Sequence[BoardView], stated: CameraConfig) -> _CameraFit:
    """Fit one camera to views, each with its own pose. Raises ValueError if nothing fits."""
    # OpenCV takes single precision, with an axis for the point.
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
    return _CameraFit(
        rms_px=float(rms),
        matrix=np.asarray(matrix, float),
        lens=_flatten_row(lens),
        sigmas=_flatten_row(sigmas),
        view_rms_px=_flatten_row(errors),
    )


def _flatten_row(values: ArrayLike) -> FloatArray:
    return np.asarray(values, float).ravel()


def _rms_px(views: Sequence[BoardView], matrix: FloatArray, lens: FloatArray) -> float:
    """Residual of the corners with a given lens, each view with its own best pose."""
    squares = 0.0
    count = 0
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
