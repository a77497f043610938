"""The commands that calibrate the optics."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from membrane_ctrl.cli.options import (
    ConfigArgument,
    ConfigOption,
    JsonOption,
    PriorOption,
    SetArgument,
    load_configuration,
)
from membrane_ctrl.model.errors import InputError

FilmModel = Literal["free", "hencky", "prestressed"]
BoardOption = Annotated[
    str, typer.Option(help="Board, as KIND:COLUMNSxROWS in squares; KIND is charuco or chessboard.")
]


def add_commands(app: typer.Typer) -> None:
    """Add `calibrate`, `calibrate-board`, `calibrate-camera`, `calibrate-pose`,
    `calibrate-display`.
    """
    app.command()(calibrate)
    app.command("calibrate-board")(calibrate_board)
    app.command("calibrate-camera")(calibrate_camera)
    app.command("calibrate-pose")(calibrate_pose)
    app.command("calibrate-display")(calibrate_display)


def calibrate_board(
    out: Annotated[
        Path,
        typer.Argument(metavar="PICTURE", help="PNG file to write; display it pixel for pixel."),
    ],
    width_px: Annotated[int, typer.Option(min=64, help="Width of the screen, px.")],
    height_px: Annotated[int, typer.Option(min=64, help="Height of the screen, px.")],
    square_px: Annotated[
        int, typer.Option(min=8, help="Side of a square, px; must be a multiple of 8.")
    ],
    board: BoardOption = "charuco:15x9",
) -> int:
    """Draw the board that `calibrate-camera` looks for."""
    from membrane_ctrl.calibration.camera import draw_board

    return draw_board(out, board, square_px, width_px, height_px)


def calibrate_camera(
    photographs: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER", help="Photographs of the board, tilted in all directions."
        ),
    ],
    config: ConfigOption = None,
    board: BoardOption = "charuco:15x9",
    out: Annotated[Path, typer.Option(help="Lens file to write, for `calibrate --prior`.")] = Path(
        "camera.toml"
    ),
    json: JsonOption = False,
) -> int:
    """Determine focal length, principal point and distortion from photographs of a board."""
    from membrane_ctrl.calibration import camera

    return camera.calibrate_camera(
        camera.CameraOptions(photographs, board, load_configuration(config), out, json)
    )


def calibrate_pose(
    folder: SetArgument,
    geometry: Annotated[
        Path | None, typer.Option(help="Geometry measured by hand, replacing the set's.")
    ] = None,
    prior: PriorOption = None,
    radius_sigma_mm: Annotated[
        float, typer.Option(min=0.001, help="Standard uncertainty of the ring's radius, mm.")
    ] = 0.2,
    out: Annotated[Path, typer.Option(help="Pose file to write, for `calibrate --prior`.")] = Path(
        "pose.toml"
    ),
    json: JsonOption = False,
) -> int:
    """Determine the pose of the camera from the ring's ellipse in a full set."""
    from membrane_ctrl.calibration import camera_pose

    options = camera_pose.PoseOptions(
        folder, geometry, tuple(prior or ()), radius_sigma_mm, out, json
    )
    return camera_pose.calibrate_pose(options)


def calibrate_display(config: ConfigArgument, json: JsonOption = False) -> int:
    """Measure settle time and gamma of the screen with the camera."""
    from membrane_ctrl.calibration.display import calibrate_display as run

    return run(load_configuration(config), str(config), json)


def calibrate(
    folders: Annotated[
        list[Path] | None,
        typer.Argument(metavar="SET...", help="Capture sets at different pressures."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Geometry file to write; geometry.toml by default.")
    ] = None,
    geometry: Annotated[
        Path | None, typer.Option(help="Geometry measured by hand, replacing the sets'.")
    ] = None,
    free: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[=SIGMA]",
            help="How well this parameter is known, e.g. focal_relative=1e-4; repeatable.",
        ),
    ] = None,
    prior: PriorOption = None,
    laser_sigma_um: Annotated[
        float,
        typer.Option(min=0.001, help="Standard uncertainty of a set's mean laser reading, µm."),
    ] = 1.0,
    film: Annotated[
        FilmModel,
        typer.Option(
            help="What the film follows: nothing (free), the law with any pre-strain, or Hencky."
        ),
    ] = "free",
    radius_sigma_mm: Annotated[
        float,
        typer.Option(
            min=0.001, help="Standard uncertainty of the ring's radius, whose edge is seen, mm."
        ),
    ] = 0.2,
    pictures: Annotated[
        bool, typer.Option(help="Draw the residuals next to the geometry file.")
    ] = True,
    json: JsonOption = False,
    live: Annotated[
        bool, typer.Option("--live", help="Take the sets from a hold; ask before it moves.")
    ] = False,
    range_um: Annotated[
        float | None,
        typer.Option(help="--live: range of setpoints, µm; by default 8000, or less if limited."),
    ] = None,
    sets: Annotated[
        int | None, typer.Option(min=2, max=20, help="--live: number of sets; 5 by default.")
    ] = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="--live: move the mirror and adopt without asking.")
    ] = False,
    session: Annotated[Path | None, typer.Option(help="--live: continue this session.")] = None,
    session_name: Annotated[
        str, typer.Option("--name", help="--live: name of a new session.")
    ] = "live",
    logs: Annotated[Path, typer.Option(help="--live: put sessions in LOGS/calibration.")] = Path(
        "logs"
    ),
    run: Annotated[Path | None, typer.Option(help="--live: run folder of the hold.")] = None,
    socket: Annotated[Path | None, typer.Option(help="--live: control port of the hold.")] = None,
    take_over: Annotated[
        bool, typer.Option("--take-over", help="--live: take command from the client that has it.")
    ] = False,
) -> int:
    """Calibrate the optics: one geometry with its covariance, from sets at several pressures."""
    from membrane_ctrl.calibration.calibrate import calibrate_command
    from membrane_ctrl.calibration.calibrate_options import CalibrateOptions

    solving = CalibrateOptions(
        folders or (),
        geometry,
        out or Path("geometry.toml"),
        free or (),
        laser_sigma_um,
        json,
        pictures,
        priors=prior or (),
        film=film,
        radius_sigma_mm=radius_sigma_mm,
    )
    # Two uses of one command: sets that are there, or sets taken from a running hold. Options of
    # the other use are refused, not ignored: `--yes` without `--live` shows a misunderstanding.
    if not live:
        if not folders:
            raise InputError(
                "calibrate: name the capture sets, or use --live to take them from a running hold"
            )
        if any((range_um, sets, yes, session, run, socket, take_over)):
            raise InputError(
                "calibrate SET...: --range-um, --sets, --yes, --session and the hold need --live"
            )
        return calibrate_command(solving)
    from membrane_ctrl.calibration.live import LiveOptions, calibrate_live
    from membrane_ctrl.control_port.ctl import Where

    if folders or out:
        raise InputError(
            "calibrate --live stores its sets in its session folder: omit SET... and --out"
        )
    where = Where(socket, run, logs=logs)
    return calibrate_live(
        LiveOptions(where, session, session_name, range_um, sets, yes, take_over, solving)
    )
