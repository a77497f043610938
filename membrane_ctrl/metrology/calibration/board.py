"""A board of known squares, on a screen or on a plate: its picture, and its corners in a
photograph.
"""

import re
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np

from membrane_ctrl.model.arrays import AnyArray, FloatArray

Levels = AnyArray
# A marker of 4 x 4 bits has a border of one: 6 modules; with a margin of one on each side a square
# has 8, so that squares of a multiple of 8 pixels have every edge on a pixel's edge.
MODULES = 8
_MARKER_SHARE = 6 / MODULES  # side of a marker over that of its square
_MARKERS = 1000  # markers in the dictionary
DICTIONARY = cv2.aruco.DICT_4X4_1000


class Markers(NamedTuple):
    """Markers in a photograph, as OpenCV gives them; `ids` is None without any."""

    corners: Any
    ids: Any


def detect_markers(image: Levels) -> Markers:
    """Find the markers in a photograph."""
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(DICTIONARY))
    corners, ids, _ = detector.detectMarkers(image)
    return Markers(corners, ids)


@dataclass(frozen=True)
class Board:
    """A board of squares.

    Attributes
    ----------
    kind : str
        "charuco", with markers (OpenCV's DICT_4X4_1000), of which a part is enough, or
        "chessboard", which is plain.
    columns, rows : int
        Numbers of squares.
    """

    kind: str
    columns: int
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

    def corners(
        self, image: Levels, markers: Markers | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Inner corners in a photograph.

        Parameters
        ----------
        image : (height, width) array
        markers : Markers, optional
            Those of the photograph, of which each size of a charuco board makes other corners;
            detecting them takes most of the time.

        Returns
        -------
        place : (n, 3) array
            On the board, in squares.
        seen_px : (n, 2) array
            Column and row.
        """
        # The corners that are seen, and their numbers, counted row by row.
        numbers = np.zeros(0, int)
        if self.kind == "chessboard":
            inner = (self.columns - 1, self.rows - 1)
            found, seen = cv2.findChessboardCornersSB(image, inner, flags=cv2.CALIB_CB_ACCURACY)
            if found:
                numbers = np.arange(inner[0] * inner[1])
        else:
            if markers is None:
                markers = detect_markers(image)
            ids = None
            if markers.ids is not None:
                seen, ids, _, _ = cv2.aruco.CharucoDetector(self._charuco()).detectBoard(
                    image, markerCorners=markers.corners, markerIds=markers.ids
                )
            if ids is not None:
                numbers = np.asarray(ids).ravel()
        if not numbers.size:
            return np.zeros((0, 3)), np.zeros((0, 2))

        # Their places: the first corner is one square from both edges.
        row, column = np.divmod(numbers, self.columns - 1)
        place = np.stack([column + 1.0, row + 1.0, np.zeros(numbers.size)], axis=1)
        return place, np.asarray(seen, float).reshape(-1, 2)

    def _charuco(self) -> Any:
        dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARY)
        return cv2.aruco.CharucoBoard((self.columns, self.rows), 1.0, _MARKER_SHARE, dictionary)


def on_screen(board: Board, square_px: int, width_px: int, height_px: int) -> Levels:
    """Return the board in the middle of a white screen.

    Parameters
    ----------
    board : Board
    square_px : int
        Side of a square in pixels of the screen.
    width_px, height_px : int
        Size of the screen.

    Returns
    -------
    (height_px, width_px) uint8 array

    Raises
    ------
    ValueError
        If it does not fit, or if `Board.draw` does.
    """
    drawn = board.draw(square_px)
    height, width = drawn.shape
    if width > width_px or height > height_px:
        sizes = f"{width} x {height} pixels, the screen {width_px} x {height_px}"
        raise ValueError(f"{board} of {square_px} px has {sizes}")
    levels = np.full((height_px, width_px), 255, np.uint8)
    top = (height_px - height) // 2
    left = (width_px - width) // 2
    levels[top : top + height, left : left + width] = drawn
    return levels
