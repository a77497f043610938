"""The commands that calibrate a part of the optics by itself, for `calibrate --prior` or for the configuration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from membrane_ctrl.cli.options import ConfigArgument, ConfigOption, JsonOption, PriorOption, SetArgument, configured

BoardOption = Annotated[str, typer.Option(help="KIND:COLUMNSxROWS of squares, KIND charuco or chessboard.")]


def add_commands(app: typer.Typer) -> None:
    """Add `calibrate-board`, `calibrate-camera`, `calibrate-pose`, `calibrate-display`."""
    app.command("calibrate-board")(calibrate_board)
    app.command("calibrate-camera")(calibrate_camera)
    app.command("calibrate-pose")(calibrate_pose)
    app.command("calibrate-display")(calibrate_display)


def calibrate_board(
    out: Annotated[Path, typer.Argument(metavar="PICTURE", help="A .png to be shown pixel for pixel.")],
    width_px: Annotated[int, typer.Option(min=64, help="Of the screen.")],
    height_px: Annotated[int, typer.Option(min=64, help="Of the screen.")],
    square_px: Annotated[int, typer.Option(min=8, help="Side of a square, a multiple of 8.")],
    board: BoardOption = "charuco:15x9",
) -> int:
    """Draw the board that `calibrate-camera` looks for, for a screen of so many pixels."""
    from membrane_ctrl.calibration.camera_command import draw_board

    return draw_board(out, board, square_px, width_px, height_px)


def calibrate_camera(
    photographs: Annotated[Path, typer.Argument(metavar="FOLDER", help="Photographs of the board, tilted each way.")],
    config: ConfigOption = None,
    board: BoardOption = "charuco:15x9",
    out: Annotated[Path, typer.Option(help="The lens, for `calibrate --prior`.")] = Path("camera.toml"),
    json: JsonOption = False,
) -> int:
    """Focal length, principal point and distortion from photographs of a board; size and pixels are the config's."""
    from membrane_ctrl.calibration.camera_command import CameraOptions
    from membrane_ctrl.calibration.camera_command import calibrate_camera as run

    return run(CameraOptions(photographs, board, configured(config), out, json))


def calibrate_pose(
    folder: SetArgument,
    geometry: Annotated[Path | None, typer.Option(help="Measured by hand, instead of the set's.")] = None,
    prior: PriorOption = None,
    radius_sigma_mm: Annotated[float, typer.Option(min=0.001, help="How well the ring's radius is known.")] = 0.2,
    out: Annotated[Path, typer.Option(help="The pose, for `calibrate --prior`.")] = Path("pose.toml"),
    json: JsonOption = False,
) -> int:
    """Pose of the camera from the ring's ellipse in a full set."""
    from membrane_ctrl.calibration.pose_command import PoseOptions
    from membrane_ctrl.calibration.pose_command import calibrate_pose as run

    return run(PoseOptions(folder, geometry, tuple(prior or ()), radius_sigma_mm, out, json))


def calibrate_display(config: ConfigArgument, json: JsonOption = False) -> int:
    """Settle time and gamma of the screen, as the camera sees it, and what they are worth."""
    from membrane_ctrl.calibration.display_command import calibrate_display as run

    return run(configured(config), str(config), json)
