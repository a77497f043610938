"""Options that several commands share, and reading the configuration they name."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from membrane_ctrl.cli.completion import complete_run

if TYPE_CHECKING:  # loading the configuration's tables takes longer than all commands' help
    from firmware_iface.settings import Section
    from membrane_ctrl.config.schema import Config

S = TypeVar("S", bound="Section")

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
    """Return the configuration of a file, or the defaults without one; raises `InputError`.

    The file names in it are relative to its own folder, not to the current one. What the file does
    not state, a hold finds at its start (`schema.leave_to_start`).
    """
    from membrane_ctrl.config import schema, toml_file

    if path is None:
        return schema.leave_to_start(schema.Config())
    config = schema.leave_to_start(toml_file.load_toml(path, schema.Config))
    optics, port, alarms = config.optics, config.port, config.alarms
    folder = path.resolve().parent
    if optics.geometry_file is not None:
        optics = _resolve_beside(optics, folder, "geometry_file")
    alarms = _resolve_beside(alarms, folder, "urls_file", "escalation_urls_file")
    bridges = config.bridges
    if bridges.mqtt is not None:
        bridges = bridges.model_copy(
            update={"mqtt": _resolve_beside(bridges.mqtt, folder, "password_file", "ca_file")}
        )
    if bridges.opcua is not None:
        opcua = _resolve_beside(bridges.opcua, folder, "users_file", "certificate_file", "key_file")
        bridges = bridges.model_copy(update={"opcua": opcua})
    update = {"optics": optics, "port": port, "alarms": alarms, "bridges": bridges}
    return config.model_copy(update=update)


def _resolve_beside(section: S, folder: Path, *names: str) -> S:
    """Return the section with its file names relative to a folder; unset ones stay unset."""
    given = {name: getattr(section, name) for name in names}
    made = {
        name: type(file)(folder / Path(file).expanduser())
        for name, file in given.items()
        if file is not None
    }
    return section.model_copy(update=made)
