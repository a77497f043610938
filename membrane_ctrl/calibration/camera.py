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
    """Options of the command: a folder of photographs, the board in them,
    the camera as configured.
    """

    folder: Path
    board: str
    config: Config
    out: Path
    as_json: bool


def calibrate_camera(options: CameraOptions) -> int:
    """Find the corners, fit the lens, write the prior and report the improvement. Raises
    CommandError.
    """
    board, camera = _parse_board(options.board), options.config.optics.camera
    paths = _list_photographs(options.folder)
    views = [_read_view(path, board, camera) for path in paths]
    _refuse_mirrored(paths, views, board, camera)
    try:
        lens = calibrate_lens(views, camera)
    except ValueError as error:
        why = f"{error}{_explain_unseen_board(board, paths, views, camera)}"
        raise errors.RejectedError(f"{options.folder}: {why}") from None
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
    print(
        json.dumps(report)
        if options.as_json
        else "\n".join(_format_lens(camera, lens, options.out))
    )
    return int(errors.Exit.DONE)


def draw_board(out: Path, board_text: str, square_px: int, width_px: int, height_px: int) -> int:
    """Write the board as a picture for a screen of the given size in pixels. Raises
    errors.InputError.
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
    try:
        return Board.parse(text)
    except ValueError as error:
        raise errors.InputError(f"--board {error}") from None


def _list_photographs(folder: Path) -> list[Path]:
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
    spread = unseen[:: max(1, len(unseen) // _TRIED_BOARDS)][:_TRIED_BOARDS]
    other = find_other_board(board, [_read_photograph(path, camera) for path in spread])
    if other is None:
        whole = "; a chessboard must be whole in the picture" if board.kind == "chessboard" else ""
        return f" (no board of another size is found either; cause unknown: {_UNSEEN}{whole})"
    return f" (they show a board of {other}, squares, not corners: give --board {other})"


def _read_view(path: Path, board: Board, camera: CameraConfig) -> BoardView:
    place, seen_px = board.corners(_read_photograph(path, camera))
    return BoardView(path.name, place, seen_px)


def _refuse_mirrored(
    paths: list[Path], views: list[BoardView], board: Board, camera: CameraConfig
) -> None:
    """Raise RejectedError for photographs whose markers are readable only from behind."""
    mirrored = []
    for path, view in zip(paths, views, strict=True):
        if board.kind == "charuco" and len(view.place) < LEAST_CORNERS:
            place, _ = board.corners(np.ascontiguousarray(_read_photograph(path, camera)[:, ::-1]))
            if len(place) >= LEAST_CORNERS:
                mirrored.append(path.name)
    if mirrored:
        raise errors.RejectedError(
            f"{paths[0].parent}: mirrored photographs: {', '.join(mirrored)}; take them of the "
            "board itself, not of its image in a mirror, and as the camera delivers them"
        )


def _read_photograph(path: Path, camera: CameraConfig) -> NDArray[np.uint8]:
    try:
        image = decoded_image(
            files.read_bytes(path, IMAGE_BYTES_MAX), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
        )
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or error
        raise errors.InputError(f"{path}: {reason}") from None
    if image.shape != (camera.height_px, camera.width_px):
        raise errors.InputError(
            f"{path}: {image.shape[1]} x {image.shape[0]} pixels, but the configuration's "
            "optics.camera has "
            f"{camera.width_px} x {camera.height_px}"
        )
    if image.dtype != np.uint8:  # the detectors take 8 bits only, which suffice for corners
        image = (np.asarray(image, float) * (255.0 / max(1, int(image.max())))).astype(np.uint8)
    return np.asarray(image, np.uint8)


def _camera_table(camera: CameraConfig, lens: Lens) -> dict[str, Any]:
    return {
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "pixel_um": camera.pixel_um,
        "focal_mm": lens.focal_px * camera.pixel_um * 1e-3,
        "principal_px": list(lens.principal_px),
        "distortion": list(lens.distortion),
    }


def _format_lens(camera: CameraConfig, lens: Lens, out: Path) -> list[str]:
    found = _camera_table(camera, lens)
    stated = (camera.focal_mm, *camera.principal, *(*camera.distortion, 0.0, 0.0, 0.0, 0.0)[:4])
    values = (found["focal_mm"], *lens.principal_px, *lens.distortion)
    scales = (found["focal_mm"], *[1.0] * 6)
    lines = ["what              stated       found        +-           known before"]
    for name, before, value, scale in zip(lens.sigmas, stated, values, scales, strict=True):
        label = "focal_mm" if name == "focal_relative" else name
        sigma, usual = lens.sigmas[name] * scale, usual_sigma(name) * scale
        lines.append(f"{label:<16}{before:>10.5g}{value:>13.6g}  {sigma:<11.2g}  {usual:.2g}")
    lines.append(
        f"corner residuals {lens.rms_px:.3f} px RMS in {len(lens.used)} photographs; "
        f"with the stated lens {lens.stated_rms_px:.3f} px"
    )
    if lens.left_out:
        lines.append(f"omitted, without a board or with a bad fit: {', '.join(lens.left_out)}")
    if lens.sigmas["focal_relative"] > usual_sigma("focal_relative"):
        lines.append(
            "the focal length is no better known than from its data sheet: tilt the board "
            "more, both ways"
        )
    return [*lines, f"written: {out}; use it with calibrate --prior {out}"]
