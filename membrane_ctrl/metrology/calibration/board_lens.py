"""Focal length, principal point and distortion from photographs of a board (OpenCV's calibration).

The model is the one that the self-calibration frees: one focal length, k1, k2, p1, p2. Views that
fit much worse than the others (blurred, a corner taken for its neighbour) are left out and named.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from membrane_ctrl.config.schema import CameraConfig
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.surface import SeenScreen
from membrane_ctrl.model.arrays import AnyArray, ArrayLike, FloatArray

LEAST_VIEWS = 4  # each has a pose of its own; with fewer the lens hides in the poses
LEAST_CORNERS = 12  # of a view
_WORSE = 3.0  # times the median view's error
_FLAGS = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_FIX_K3
_PLANE_OFF = 5e-3  # of a tangent: what the stated lens leaves, far less than a fringe
_PLANE_SHARE = 0.8
_NAMES = ("focal_relative", "principal_x_px", "principal_y_px", "k1", "k2", "p1", "p2")


def screen_seen(
    geometry: Geometry, column_px: FloatArray, row_px: FloatArray, screen_mm: FloatArray
) -> SeenScreen:
    """Where the screen stands that the camera sees at points (2, n), about, with the stated lens.

    Raises ValueError if no plane is seen.
    """
    rays = geometry.rotation @ geometry.rays(column_px, row_px)
    seen, flat = (rays[:2] / rays[2]).T.copy(), screen_mm.T.copy()
    if flat.shape[0] <= LEAST_CORNERS:
        raise ValueError("no screen is seen")
    # a few bins may have a wrong fringe order
    good: AnyArray = np.asarray(cv2.findHomography(flat, seen, cv2.RANSAC, _PLANE_OFF)[1]).ravel()
    if np.mean(good == 1) < _PLANE_SHARE:  # also where there is none
        raise ValueError("what is seen is not a plane with fringes")
    keep = good == 1
    place = np.column_stack([flat[keep], np.zeros(np.count_nonzero(keep))])
    _, turn, shift = cv2.solvePnP(place, seen[keep], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    return SeenScreen(
        np.asarray(shift.ravel(), np.float64), np.asarray(cv2.Rodrigues(turn)[0].T, np.float64)
    )


def lens_derivatives(
    geometry: Geometry, column_px: FloatArray, row_px: FloatArray, rays: FloatArray
) -> FloatArray:
    """d ray / d (relative focal length, principal point, k1, k2, p1, p2), (7, 3, m).

    A pixel fixes the distorted point q = ((c, r) - principal) / focal = f(p; k): dp = (df/dp)^-1
    (dq - df/dk dk), and the unit vector c of (p, 1) turns by (1 - c c^T) (dp, 0) / |(p, 1)|.
    Coefficients beyond the first four, if the stated lens has any, count as constants of df/dp only
    to first order: they are left out there.
    """
    c = geometry.rotation @ rays
    x, y = c[0] / c[2], c[1] / c[2]
    k1, k2, p1, p2 = (*geometry.distortion, 0.0, 0.0, 0.0, 0.0)[:4]
    r2 = x * x + y * y
    radial, grows = 1 + k1 * r2 + k2 * r2**2, 2 * (k1 + 2 * k2 * r2)
    fxx = radial + grows * x * x + 2 * p1 * y + 6 * p2 * x
    fxy = grows * x * y + 2 * p1 * x + 2 * p2 * y
    fyy = radial + grows * y * y + 6 * p1 * y + 2 * p2 * x
    qx = (column_px - geometry.principal_px[0]) / geometry.focal_px
    qy = (row_px - geometry.principal_px[1]) / geometry.focal_px
    zero, step = np.zeros_like(x), np.full_like(x, -1 / geometry.focal_px)
    of_x = np.stack([-qx, step, zero, -x * r2, -x * r2**2, -2 * x * y, -(r2 + 2 * x * x)])
    of_y = np.stack([-qy, zero, step, -y * r2, -y * r2**2, -(r2 + 2 * y * y), -2 * x * y])
    det = fxx * fyy - fxy**2
    px, py = (fyy * of_x - fxy * of_y) / det, (fxx * of_y - fxy * of_x) / det
    moved = np.stack([px, py, np.zeros_like(px)], axis=1) * c[2]
    turned = moved - np.sum(moved * c, axis=1, keepdims=True) * c
    return np.asarray(np.einsum("ij,lim->ljm", geometry.rotation, turned))


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
        rms, matrix, lens, sigmas, errors = _fit(good, stated)
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
        stated_rms_px=_rms_px(good, _matrix(stated), np.array(stated.distortion, float)),
        used=tuple(view.name for view in good),
        left_out=tuple(view.name for view in views if view.name not in names),
    )


def _fit(
    views: Sequence[BoardView], stated: CameraConfig
) -> tuple[float, FloatArray, FloatArray, FloatArray, FloatArray]:
    """RMS, camera matrix, distortion, sigmas of the intrinsics, RMS of each view."""
    places = [view.place.astype(np.float32)[:, None] for view in views]
    seen = [view.seen_px.astype(np.float32)[:, None] for view in views]
    size = (stated.width_px, stated.height_px)
    try:
        rms, matrix, lens, _, _, sigmas, _, errors = cv2.calibrateCameraExtended(
            places, seen, size, _matrix(stated), np.zeros(5), flags=_FLAGS
        )
    except cv2.error as error:
        raise ValueError(f"no lens fits the photographs: {str(error).splitlines()[0]}") from None
    if not np.isfinite(rms):
        raise ValueError("no lens fits the photographs")
    return float(rms), np.asarray(matrix, float), _row(lens), _row(sigmas), _row(errors)


def _row(values: ArrayLike) -> FloatArray:
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


def _matrix(camera: CameraConfig) -> FloatArray:
    focal_px = camera.focal_mm / (camera.pixel_um * 1e-3)
    column, row = camera.principal
    return np.array([[focal_px, 0.0, column], [0.0, focal_px, row], [0.0, 0.0, 1.0]])


# A board of known squares, on a screen or on a plate: its picture, and its corners in a photograph.

Levels = AnyArray

# A marker of 4 x 4 bits has a border of one: 6 modules; with a margin of one on each side a square
# has 8, so that squares of a multiple of 8 pixels have every edge on a pixel's edge
MODULES = 8
_MARKER_SHARE = 6 / MODULES
_MARKERS = 1000  # of the dictionary


@dataclass(frozen=True)
class Board:
    """A board."""

    # "charuco" or "chessboard": with markers (OpenCV's DICT_4X4_1000), of which a part is enough,
    # or plain
    kind: str
    columns: int  # squares
    rows: int

    @classmethod
    def parse(cls, text: str) -> "Board":
        """From "charuco:15x9". Raises ValueError."""
        found = re.fullmatch(r"(charuco|chessboard):(\d{1,3})x(\d{1,3})", text)
        if found is None:
            raise ValueError(
                f"{text} is not a board: KIND:COLUMNSxROWS of squares, e.g. charuco:15x9, "
                "chessboard:10x7"
            )
        board = cls(found[1], int(found[2]), int(found[3]))
        if min(board.columns, board.rows) < 4 or (board.columns * board.rows > 2 * _MARKERS):
            raise ValueError(
                f"{text}: a board has at least 4 squares each way and at most {2 * _MARKERS} in all"
            )
        return board

    def __str__(self) -> str:
        """As `parse` takes it."""
        return f"{self.kind}:{self.columns}x{self.rows}"

    def draw(self, square_px: int) -> Levels:
        """The board alone, one level a pixel. Raises ValueError unless its edges fall on pixels."""
        if square_px % MODULES:
            raise ValueError(
                f"squares of {square_px} px: a multiple of {MODULES} is needed for edges on pixels"
            )
        if self.kind == "chessboard":
            row, column = np.indices((self.rows * square_px, self.columns * square_px)) // square_px
            return np.asarray(255 * ((row + column) % 2), np.uint8)
        size = (self.columns * square_px, self.rows * square_px)
        return np.asarray(self._charuco().generateImage(size, marginSize=0), np.uint8)

    def corners(self, image: Levels) -> tuple[FloatArray, FloatArray]:
        """Inner corners in a photograph: place (n, 3) on the board in squares, and (n, 2) column
        and row in px.
        """
        if self.kind == "chessboard":
            inner = (self.columns - 1, self.rows - 1)
            found, seen = cv2.findChessboardCornersSB(image, inner, flags=cv2.CALIB_CB_ACCURACY)
            numbers = np.arange(inner[0] * inner[1]) if found else np.zeros(0, int)
        else:
            seen, ids, _, _ = cv2.aruco.CharucoDetector(self._charuco()).detectBoard(image)
            numbers = np.zeros(0, int) if ids is None else np.asarray(ids).ravel()
        if not numbers.size:
            return np.zeros((0, 3)), np.zeros((0, 2))
        row, column = np.divmod(numbers, self.columns - 1)
        place = np.stack([column + 1.0, row + 1.0, np.zeros(numbers.size)], axis=1)
        return place, np.asarray(seen, float).reshape(-1, 2)

    def _charuco(self) -> Any:
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000)
        return cv2.aruco.CharucoBoard((self.columns, self.rows), 1.0, _MARKER_SHARE, dictionary)


def on_screen(board: Board, square_px: int, width_px: int, height_px: int) -> Levels:
    """The board in the middle of a white screen. Raises ValueError if it does not fit, or
    `Board.draw` does.
    """
    drawn = board.draw(square_px)
    height, width = drawn.shape
    if width > width_px or height > height_px:
        sizes = f"{width} x {height} pixels, the screen {width_px} x {height_px}"
        raise ValueError(f"{board} of {square_px} px has {sizes}")
    levels = np.full((height_px, width_px), 255, np.uint8)
    top, left = (height_px - height) // 2, (width_px - width) // 2
    levels[top : top + height, left : left + width] = drawn
    return levels
