"""The command line: one thin function a command; errors end in one line and an exit code (INTERFACES section 4)."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from membrane_ctrl import __version__
from membrane_ctrl.config import Config
from membrane_ctrl.config_file import load
from membrane_ctrl.durations import parse_duration_s
from membrane_ctrl.errors import CommandError, Exit

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)

ConfigOption = Annotated[Path | None, typer.Option("--config", help="Configuration, one TOML file.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


def run(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code; every expected failure is one line on stderr."""
    try:
        result = app(list(arguments), prog_name="membrane-ctrl", standalone_mode=False)
    except CommandError as error:
        print(f"membrane-ctrl: {error}", file=sys.stderr)
        return error.exit
    except typer.TyperException as error:
        print(f"membrane-ctrl: {error.format_message()} (see --help)", file=sys.stderr)
        return Exit.BAD_INPUT
    except (KeyboardInterrupt, typer.Abort):
        print("membrane-ctrl: interrupted", file=sys.stderr)
        return Exit.INTERRUPTED
    return int(result or 0)


@app.callback(invoke_without_command=True)
def top(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    """Hold a pneumatic membrane mirror to the micrometre and measure its figure while it is held."""
    if version:
        print(__version__)
        raise typer.Exit


@app.command()
def hold(
    config: ConfigOption = None,
    twin: Annotated[bool, typer.Option("--twin", help="Hold the simulated bench instead of devices.")] = False,
    duration: Annotated[str | None, typer.Option(help="Stop after this long, e.g. 90s, 3m, 2h30m.")] = None,
    name: Annotated[str, typer.Option(help="Name of the run folder.")] = "hold",
    logs: Annotated[Path | None, typer.Option(help="Where run folders go.")] = None,
    clear_faults: Annotated[
        bool, typer.Option("--clear-faults", help="Clear what the board has latched, once you know why.")
    ] = False,
    json: JsonOption = False,
) -> int:
    """Hold the mirror until told to stop: the main job."""
    from membrane_ctrl.hold import HoldOptions, hold_mirror

    options = HoldOptions(
        config=_config(config),
        source=str(config or "the defaults"),
        twin=twin,
        duration_s=None if duration is None else parse_duration_s(duration),
        name=name,
        logs_dir=logs,
        clear_faults=clear_faults,
        json=json,
    )
    return hold_mirror(options)


@app.command()
def twin(
    config: ConfigOption = None,
    speed: Annotated[float, typer.Option(min=0.01, max=1000.0, help="Simulated seconds a second.")] = 1.0,
) -> int:
    """Serve the simulated bench on its real protocol, for any client, until interrupted."""
    from membrane_ctrl.serve_twin import serve_twin

    return serve_twin(_config(config), speed)


@app.command()
def check(
    config: Annotated[Path, typer.Argument(help="Configuration, one TOML file.", metavar="CONFIG")],
    json: JsonOption = False,
) -> int:
    """Validate a configuration, probe the devices it names, and say what would happen."""
    from membrane_ctrl.check import check_config

    return check_config(_config(config), str(config), json)


def _config(path: Path | None) -> Config:
    return Config() if path is None else load(path, Config)
