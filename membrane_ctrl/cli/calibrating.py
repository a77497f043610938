"""The commands that calibrate the optics."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from membrane_ctrl.cli.options import JsonOption, PriorOption


def add_commands(app: typer.Typer) -> None:
    """Add `calibrate`."""
    app.command()(calibrate)


def calibrate(
    folders: Annotated[
        list[Path] | None, typer.Argument(metavar="SET...", help="Capture sets at different pressures.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="The new geometry; geometry.toml here without it.")] = None,
    geometry: Annotated[Path | None, typer.Option(help="Measured by hand, instead of the sets'.")] = None,
    free: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME[=SIGMA]", help="Also calibrate this, as bow_mm; sigma 0 holds it; repeatable."),
    ] = None,
    prior: PriorOption = None,
    laser_sigma_um: Annotated[float, typer.Option(min=0.001, help="Of a set's mean reading.")] = 1.0,
    pictures: Annotated[bool, typer.Option(help="Draw the residuals beside the geometry.")] = True,
    json: JsonOption = False,
    live: Annotated[bool, typer.Option("--live", help="Take the sets from a running hold, and ask.")] = False,
    range_um: Annotated[
        float | None, typer.Option(help="--live: from the first setpoint to the last; 8000, or what there is.")
    ] = None,
    sets: Annotated[int | None, typer.Option(min=2, max=20, help="--live: how many; 5.")] = None,
    yes: Annotated[bool, typer.Option("--yes", help="--live: move the mirror and adopt the result unasked.")] = False,
    session: Annotated[Path | None, typer.Option(help="--live: go on with this session folder.")] = None,
    session_name: Annotated[str, typer.Option("--name", help="--live: name of a new session.")] = "live",
    logs: Annotated[Path, typer.Option(help="--live: sessions are in LOGS/calibration.")] = Path("logs"),
    run: Annotated[Path | None, typer.Option(help="--live: run folder of the hold.")] = None,
    socket: Annotated[Path | None, typer.Option(help="--live: control port of the hold.")] = None,
    take_over: Annotated[bool, typer.Option("--take-over", help="--live: take the command from its holder.")] = False,
) -> int:
    """Calibrate the optics: one geometry with its covariance, from sets at several pressures."""
    from membrane_ctrl.calibration.sets_command import CalibrateOptions, calibrate_command
    from membrane_ctrl.errors import InputError

    names, priors = tuple(free or ()), tuple(prior or ())
    if not live:
        if not folders:
            raise InputError("calibrate: name the capture sets, or take them from a running hold with --live")
        if any((range_um, sets, yes, session, run, socket, take_over)):
            raise InputError("calibrate SET...: --range-um, --sets, --yes, --session and the hold are for --live")
        geometry_out = out or Path("geometry.toml")
        return calibrate_command(
            CalibrateOptions(folders, geometry, geometry_out, names, laser_sigma_um, json, pictures, priors=priors)
        )
    from membrane_ctrl.calibration.command import LiveOptions, calibrate_live
    from membrane_ctrl.ctl import Where
    from membrane_ctrl.port.unix import SOCKET_NAME

    if folders or out:
        raise InputError("calibrate --live takes its sets into its session's folder: leave out SET... and --out")
    where = Where(socket=logs / SOCKET_NAME if socket is None and run is None else socket, run=run)
    options = LiveOptions(
        where, logs, session, session_name, range_um, sets, yes, take_over,
        geometry, names, laser_sigma_um, json, pictures, priors,
    )  # fmt: skip
    return calibrate_live(options)
