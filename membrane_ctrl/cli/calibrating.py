"""The commands that calibrate the optics."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from membrane_ctrl.cli.options import JsonOption


def add_commands(app: typer.Typer) -> None:
    """Add `calibrate`."""
    app.command()(calibrate)


def calibrate(
    sets: Annotated[list[Path], typer.Argument(metavar="SET...", help="Capture sets at different pressures.")],
    out: Annotated[Path, typer.Option(help="The new geometry.")] = Path("geometry.toml"),
    geometry: Annotated[Path | None, typer.Option(help="Measured by hand, instead of the sets'.")] = None,
    free: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME[=SIGMA]", help="Also calibrate this, as bow_mm; sigma 0 holds it; repeatable."),
    ] = None,
    laser_sigma_um: Annotated[float, typer.Option(min=0.001, help="Of a set's mean reading.")] = 1.0,
    pictures: Annotated[bool, typer.Option(help="Draw the residuals beside the geometry.")] = True,
    json: JsonOption = False,
) -> int:
    """Calibrate the optics: one geometry with its covariance, from sets at several pressures."""
    from membrane_ctrl.calibrate_command import CalibrateOptions, calibrate_command

    options = CalibrateOptions(sets, geometry, out, tuple(free or ()), laser_sigma_um, json, pictures)
    return calibrate_command(options)
