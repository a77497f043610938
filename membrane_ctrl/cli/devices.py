"""The commands that talk to devices without holding a mirror."""

from typing import Annotated

import typer

from membrane_ctrl.cli.options import ConfigArgument, JsonOption, configured


def add_commands(app: typer.Typer) -> None:
    """Add `check`, `devices`, `conformance`."""
    app.command()(check)
    app.command()(devices)
    app.command()(conformance)


def check(config: ConfigArgument, json: JsonOption = False) -> int:
    """Validate a configuration, probe its devices, and say what a hold would do."""
    from membrane_ctrl.commissioning.check import check_config

    return check_config(configured(config), str(config), json)


def devices(json: JsonOption = False) -> int:
    """List serial ports, cameras and displays, with the text to paste into a configuration."""
    from membrane_ctrl.commissioning.devices import list_devices

    return list_devices(json)


def conformance(
    url: Annotated[
        str, typer.Argument(metavar="URL", help="Pump board: tcp://HOST:PORT or rtu:///dev/ttyUSB0?baud=115200.")
    ],
    unit_id: Annotated[int, typer.Option(min=1, max=247, help="Modbus unit identifier.")] = 1,
    json: JsonOption = False,
) -> int:
    """Test a pump board against its specification. The pump runs at a few per cent: vent the mirror first."""
    from membrane_ctrl.commissioning.devices import run_conformance

    return run_conformance(url, unit_id, json)
