"""Which board the photographs show, if it is not the stated one."""

from collections.abc import Sequence

import cv2
import numpy as np

from membrane_ctrl.metrology.calibration.board import Board, Levels, Markers, detect_markers
from membrane_ctrl.metrology.calibration.board_lens import LEAST_CORNERS

_TRIED = 3  # photographs
_LONGEST_PX = 1000  # of a photograph, shrunk for speed
_AROUND = 2  # squares more or fewer, each way
_SMALLEST = (3, 3)  # corners, from which OpenCV lets a chessboard grow
_CONFIRMED = 2  # photographs, or the only one


def find_other_board(stated: Board, photographs: Sequence[Levels]) -> Board | None:
    """Return the board of another size that is found in the photographs.

    A size is named only if the detector finds it in two photographs, if there are as many. Of
    several, the one with the most corners is named, and the smallest of those.

    Parameters
    ----------
    stated : Board
        The board that was not found.
    photographs : sequence of (height, width) arrays

    Returns
    -------
    Board or None
        None without one.
    """
    # Some photographs, shrunk for speed; the markers of a charuco board are detected once for all
    # sizes.
    small = [_shrink(photograph) for photograph in photographs[:_TRIED]]
    needed = min(_CONFIRMED, len(small))
    markers: list[Markers | None] = [None] * len(small)
    if stated.kind == "charuco":
        markers = [detect_markers(photograph) for photograph in small]

    # The size with the most corners; of equal ones the smallest, as a detector also finds a part.
    best: Board | None = None
    best_score = (0, 0)
    for board in _list_candidates(stated, small, markers):
        counts = [
            len(board.corners(photograph, seen)[0])
            for photograph, seen in zip(small, markers, strict=True)
        ]
        shown = sum(count >= LEAST_CORNERS for count in counts)
        score = (sum(counts), -board.columns * board.rows)
        if shown >= needed and score > best_score:
            best = board
            best_score = score
    return best


def _list_candidates(
    stated: Board, photographs: Sequence[Levels], markers: Sequence[Markers | None]
) -> list[Board]:
    """Sizes that are tried, without the stated one."""
    if stated.kind == "chessboard":  # a turned one is the same, and the detector is slow
        sizes = _grow_chessboards(photographs)
        # inner corners, or their rows and columns, taken for squares
        sizes |= {(stated.columns + more, stated.rows + more) for more in (-1, 1)}
        sizes = {(max(size), min(size)) for size in sizes}
        sizes.discard((max(stated.columns, stated.rows), min(stated.columns, stated.rows)))
    else:
        sizes = _list_charuco_sizes(stated, markers)
        sizes.discard((stated.columns, stated.rows))
    return [Board(stated.kind, *size) for size in sorted(sizes) if min(size) > max(_SMALLEST)]


def _list_charuco_sizes(stated: Board, markers: Sequence[Markers | None]) -> set[tuple[int, int]]:
    """Sizes near the stated one with as many markers as the highest number that is seen."""
    count = 0
    for seen in markers:
        if seen is not None and seen.ids is not None:
            count = max(count, int(np.max(seen.ids)) + 1)
    around = range(-_AROUND, _AROUND + 1)
    near = {(stated.columns + i, stated.rows + j) for i in around for j in around}
    near |= {(rows, columns) for columns, rows in near}
    # the last row may be hidden in part
    return {
        (columns, rows)
        for columns, rows in near
        if count <= columns * rows // 2 <= count + columns // 2 and count > 0
    }


def _grow_chessboards(photographs: Sequence[Levels]) -> set[tuple[int, int]]:
    """Columns and rows of squares of chessboards of any size in the photographs."""
    sizes = set()
    for photograph in photographs:
        found, _, grown = cv2.findChessboardCornersSBWithMeta(
            photograph, _SMALLEST, cv2.CALIB_CB_LARGER
        )
        if found:
            rows, columns = grown.shape
            sizes.add((columns + 1, rows + 1))
    return sizes


def _shrink(photograph: Levels) -> Levels:
    scale = _LONGEST_PX / max(photograph.shape)
    if scale >= 1:
        return photograph
    small = cv2.resize(photograph, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)
