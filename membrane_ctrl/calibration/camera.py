"""The commands `calibrate-camera` and `calibrate-board`: the lens, from photographs of a board."""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.config.schema import CameraConfig, Config
from membrane_ctrl.geometry.prior_file import write_prior
from membrane_ctrl.measure.images import IMAGE_BYTES_MAX, decoded_image
from membrane_ctrl.metrology.calibration.board import Board, on_screen
from membrane_ctrl.metrology.calibration.board_lens import (
    LEAST_CORNERS,
    BoardView,
    Lens,
    calibrate_lens,
)
from membrane_ctrl.metrology.calibration.board_size import find_other_board
from membrane_ctrl.metrology.rays.bench_parameters import usual_sigma
from membrane_ctrl.model import errors, files

_TRIED_BOARDS = 3  # photographs in which a board of another size is looked for
_UNSEEN = "another kind of board, a blurred one, or one that is hardly in the picture"
_IMAGES = (".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg")


@dataclass(frozen=True)
class CameraOptions:
    """Options of `calibrate-camera`.

    Attributes
    ----------
    folder : Path
        Folder of the photographs.
    board : str
        The board in them, as `Board.parse` reads it.
    config : Config
        The configuration, with the stated camera.
    out : Path
        File of the prior.
    as_json : bool
        Whether to print the report as JSON.
    """

    folder: Path
    board: str
    config: Config
    out: Path
    as_json: bool


def calibrate_camera(options: CameraOptions) -> int:
    """Find the corners, fit the lens, write the prior and report the improvement.

    Returns
    -------
    int
        The exit code of the command.

    Raises
    ------
    CommandError
        If a photograph is not usable, or the photographs do not determine the lens.
    """
    board = _parse_board(options.board)
    camera = options.config.optics.camera

    # The corners in each photograph.
    paths = _list_photographs(options.folder)
    views = [_read_view(path, board, camera) for path in paths]
    _refuse_mirrored(paths, views, board, camera)
    try:
        # The lens.
        lens = calibrate_lens(views, camera)
    except ValueError as error:
        why = f"{error}{_explain_unseen_board(board, paths, views, camera)}"
        raise errors.RejectedError(f"{options.folder}: {why}") from None

    # The prior's file, and the report.
    tables = {"camera": _camera_table(camera, lens), "sigmas": lens.sigmas}
    write_prior(options.out, tables, "calibrate-camera", lens.used, lens.rms_px)
    report = {
        "schema": "membrane-calibrate-camera/1",
        "out": str(options.out),
        "rms_px": lens.rms_px,
        "stated_rms_px": lens.stated_rms_px,
        "used": list(lens.used),
        "left_out": list(lens.left_out),
        "camera": tables["camera"],
        "sigmas": lens.sigmas,
    }
    if options.as_json:
        print(json.dumps(report))
    else:
        print("\n".join(_format_lens(camera, lens, options.out)))
    return int(errors.Exit.DONE)


def draw_board(out: Path, board_text: str, square_px: int, width_px: int, height_px: int) -> int:
    """Write the board as a picture for a screen, in the middle of it.

    Parameters
    ----------
    out : Path
        Its suffix chooses the format; one without loss, such as PNG, keeps the edges sharp.
    board_text : str
        KIND:COLUMNSxROWS in squares, such as `charuco:15x9`.
    square_px : int
        Side of a square; a multiple of 8, for the markers within.
    width_px, height_px : int
        Size of the screen, and of the picture.

    Returns
    -------
    int
        The exit code of the command.

    Raises
    ------
    InputError
        The board does not fit, or the picture cannot be written.
    """
    try:
        levels = on_screen(_parse_board(board_text), square_px, width_px, height_px)
    except ValueError as error:
        raise errors.InputError(f"calibrate-board: {error}") from None
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        written, picture = cv2.imencode(out.suffix, levels)
        if written:
            files.write_bytes_atomic(files.resolve_user_path(out), picture.tobytes())
    except (OSError, cv2.error):
        written = False
    if not written:
        raise errors.InputError(f"{out}: cannot be written; give a .png in a writable folder")
    print(
        f"{board_text} of {square_px} px squares written to {out}; display it pixel for pixel",
        file=sys.stderr,
    )
    return int(errors.Exit.DONE)


def _parse_board(text: str) -> Board:
    """The board of option `--board`. Raises InputError."""
    try:
        return Board.parse(text)
    except ValueError as error:
        raise errors.InputError(f"--board {error}") from None


def _list_photographs(folder: Path) -> list[Path]:
    """The images of a folder by name. Raises InputError if there are none."""
    if not folder.is_dir():
        raise errors.InputError(f"{folder}: no such folder of photographs")
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in _IMAGES)
    if not found:
        raise errors.InputError(f"{folder}: holds no photographs ({', '.join(_IMAGES)})")
    return found


def _explain_unseen_board(
    board: Board, paths: Sequence[Path], views: Sequence[BoardView], camera: CameraConfig
) -> str:
    """Why most photographs do not show the board: the size that they show instead, if any."""
    unseen = [
        path for path, view in zip(paths, views, strict=True) if len(view.place) < LEAST_CORNERS
    ]
    if 2 * len(unseen) <= len(views):
        return ""

    # Try photographs that are spread over the folder.
    every = max(1, len(unseen) // _TRIED_BOARDS)
    tried = unseen[::every][:_TRIED_BOARDS]
    other = find_other_board(board, [_read_photograph(path, camera) for path in tried])
    if other is None:
        causes = _UNSEEN
        if board.kind == "chessboard":
            causes += "; a chessboard must be whole in the picture"
        return f" (no board of another size is found either; cause unknown: {causes})"
    return f" (they show a board of {other}, squares, not corners: give --board {other})"


def _read_view(path: Path, board: Board, camera: CameraConfig) -> BoardView:
    """The board's corners in one photograph. Raises InputError."""
    place, seen_px = board.corners(_read_photograph(path, camera))
    return BoardView(path.name, place, seen_px)


def _refuse_mirrored(
    paths: list[Path], views: list[BoardView], board: Board, camera: CameraConfig
) -> None:
    """Raise RejectedError for photographs whose markers are readable only from behind."""
    mirrored = []
    for path, view in zip(paths, views, strict=True):
        if board.kind == "charuco" and len(view.place) < LEAST_CORNERS:
            flipped = np.ascontiguousarray(_read_photograph(path, camera)[:, ::-1])
            place, _ = board.corners(flipped)
            if len(place) >= LEAST_CORNERS:
                mirrored.append(path.name)
    if mirrored:
        raise errors.RejectedError(
            f"{paths[0].parent}: mirrored photographs: {', '.join(mirrored)}; take them of the "
            "board itself, not of its image in a mirror, and as the camera delivers them"
        )


def _read_photograph(path: Path, camera: CameraConfig) -> NDArray[np.uint8]:
    """A photograph (rows, columns) in gray, with 8 bits. Raises InputError."""
    try:
        data = files.read_bytes(path, IMAGE_BYTES_MAX)
        image = decoded_image(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    except OSError as error:
        raise errors.InputError(f"{path}: {error.strerror or error}") from None
    except ValueError as error:
        raise errors.InputError(f"{path}: {error}") from None
    rows, columns = image.shape
    if (rows, columns) != (camera.height_px, camera.width_px):
        raise errors.InputError(
            f"{path}: {columns} x {rows} pixels, but the configuration's optics.camera has "
            f"{camera.width_px} x {camera.height_px}"
        )
    if image.dtype != np.uint8:
        # The detectors take 8 bits only, which suffice for corners.
        scale = 255.0 / max(1, int(image.max()))
        image = (np.asarray(image, float) * scale).astype(np.uint8)
    return np.asarray(image, np.uint8)


def _camera_table(camera: CameraConfig, lens: Lens) -> dict[str, Any]:
    """Table `optics.camera` of the prior's file."""
    return {
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "pixel_um": camera.pixel_um,
        "focal_mm": lens.focal_px * camera.pixel_um * 1e-3,
        "principal_px": list(lens.principal_px),
        "distortion": list(lens.distortion),
    }


def _format_lens(camera: CameraConfig, lens: Lens, out: Path) -> list[str]:
    """The table of the lens, and how well it fits, for a terminal."""
    focal_mm = _camera_table(camera, lens)["focal_mm"]
    # In the order of the sigmas: focal length, principal point, four terms of distortion.
    stated_distortion = (*camera.distortion, 0.0, 0.0, 0.0, 0.0)[:4]
    stated = (camera.focal_mm, *camera.principal, *stated_distortion)
    values = (focal_mm, *lens.principal_px, *lens.distortion)
    scales = (focal_mm, *[1.0] * 6)
    lines = ["what              stated       found        +-           known before"]
    for name, before, value, scale in zip(lens.sigmas, stated, values, scales, strict=True):
        label = name
        if name == "focal_relative":
            label = "focal_mm"
        sigma = lens.sigmas[name] * scale
        usual = usual_sigma(name) * scale
        lines.append(f"{label:<16}{before:>10.5g}{value:>13.6g}  {sigma:<11.2g}  {usual:.2g}")
    lines.append(
        f"corner residuals {lens.rms_px:.3f} px RMS in {len(lens.used)} photographs; with the "
        f"stated lens {lens.stated_rms_px:.3f} px"
    )
    if lens.left_out:
        lines.append(f"omitted, without a board or with a bad fit: {', '.join(lens.left_out)}")
    if lens.sigmas["focal_relative"] > usual_sigma("focal_relative"):
        lines.append(
            "the focal length is no better known than from its data sheet: tilt the board "
            "more, both ways"
        )
    return [*lines, f"written: {out}; use it with calibrate --prior {out}"]
