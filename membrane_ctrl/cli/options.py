"""Options that several commands share, and reading the configuration they name."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from membrane_ctrl.cli.completion import complete_run
from membrane_ctrl.model.numbers import parse_number

if TYPE_CHECKING:  # loading the configuration's tables takes longer than all commands' help
    from membrane_ctrl.config.schema import Config

ConfigArgument = Annotated[
    Path, typer.Argument(help="Configuration, one TOML file.", metavar="CONFIG")
]
ConfigOption = Annotated[
    Path | None,
    typer.Option("--config", help="Configuration, one TOML file; defaults apply without it."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
PriorOption = Annotated[
    list[Path] | None,
    typer.Option(
        metavar="FILE",
        help="Result of calibrate-camera or calibrate-pose; repeatable, the last one wins.",
    ),
]
RunArgument = Annotated[
    Path,
    typer.Argument(
        metavar="RUN",
        help="Run folder, its name or part of the name, or `last`.",
        autocompletion=complete_run,
    ),
]
FromOption = Annotated[
    str | None,
    typer.Option(
        "--from", help="Start of the part: 03:12 (UTC), an ISO time, or +90m from the start."
    ),
]
ToOption = Annotated[str | None, typer.Option("--to", help="End of the part, as --from.")]
SetArgument = Annotated[
    Path, typer.Argument(metavar="SET", help="Folder with capture.toml and its images.")
]
SeedOption = Annotated[int, typer.Option(min=0, help="Seed of the random numbers.")]
TrialsOption = Annotated[int, typer.Option(min=2, help="Monte Carlo trials.")]


def load_configuration(path: Path | None) -> "Config":
    """Return the configuration of a file, or the defaults without one; raises `InputError`."""
    from membrane_ctrl.config.configuration_file import load_configuration

    return load_configuration(path)


def parse_number_argument(text: str) -> float:
    """Return the number of an argument; typer reports what is wrong with it."""
    try:
        return parse_number(text)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
