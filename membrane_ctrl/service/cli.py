"""`membrane-ctrl service`: installs and removes the units of systemd."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="Install the service as a unit of systemd, or remove it.",
)
RootOption = Annotated[
    Path, typer.Option(help="Write below this folder only: for packages and images.")
]


@app.command()
def install(
    root: RootOption = Path("/"),
    program: Annotated[
        Path | None, typer.Option(help="Path of membrane-ctrl for the units; this one by default.")
    ] = None,
) -> None:
    """Write the units of service and holds, access rules for devices and real-time limits; make the
    user; start the service.
    """
    from membrane_ctrl.service.units import install_units, own_program

    for path in install_units(root, program or own_program()):
        print(f"written: {path}", file=sys.stderr)


@app.command()
def uninstall(root: RootOption = Path("/")) -> None:
    """Stop the service and remove its units, rules and limits; configurations and runs stay."""
    from membrane_ctrl.service.units import remove_units

    for path in remove_units(root):
        print(f"removed: {path}", file=sys.stderr)
