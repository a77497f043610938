"""The commands of `config`: explain the keys of a configuration, write a first one."""

import json as json_text
import textwrap
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from membrane_ctrl.cli.options import JsonOption

_WIDTH = 100
config_app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="Explain the keys of a configuration; write a first one.",
)


def add_commands(app: typer.Typer) -> None:
    """Add `config`."""
    app.add_typer(config_app, name="config")


@config_app.command()
def explain(
    key: Annotated[
        str,
        typer.Argument(
            metavar="KEY",
            help="Key, table or driver: loop.kp_per_s, kp_per_s, devices.pump, ventus.",
        ),
    ],
    json: JsonOption = False,
) -> int:
    """Explain a key, or all keys of a table or driver: meaning, unit, range, default, when to
    change it.
    """
    from membrane_ctrl.config.reference import find_explained

    found = find_explained(key)
    if json:
        print(
            json_text.dumps(
                {"schema": "membrane-config-keys/1", "tables": [asdict(table) for table in found]}
            )
        )
        return 0
    for table in found:
        print(textwrap.fill(f"{table.title}: {table.meaning}", _WIDTH))
        for each in table.keys:
            if each.default == "required":
                default = each.default
            else:
                default = f"default {each.default}"
            print(f"  {each.name}: {each.range} {each.unit}".rstrip() + f"; {default}")
            print(textwrap.indent(textwrap.fill(f"{each.meaning} {each.advice}", _WIDTH), "    "))
    return 0


@config_app.command()
def reference() -> int:
    """Print every key of the configuration as one page of Markdown."""
    from membrane_ctrl.config.reference import make_reference_page

    print(make_reference_page(), end="")
    return 0


@config_app.command()
def schema() -> int:
    """Print the JSON schema of a configuration, for editors that complete and check TOML."""
    from membrane_ctrl.config.reference import json_schema

    print(json_text.dumps(json_schema(), indent=1))
    return 0


@config_app.command()
def init(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="File to write; an existing one is kept.")
    ] = Path("membrane-ctrl.toml"),
    twin: Annotated[
        bool, typer.Option("--twin", help="Ask nothing: a configuration for `membrane-ctrl twin`.")
    ] = False,
) -> int:
    """Write a first configuration, with what is connected; on a terminal, ask for the devices."""
    from membrane_ctrl.commissioning.first_config import write_first_config

    return write_first_config(file, twin, ask=typer.get_text_stream("stdin").isatty() and not twin)


@config_app.command()
def upgrade(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Configuration to upgrade.")],
    write: Annotated[
        bool, typer.Option("--write", help="Write it; the former file stays as FILE.former.")
    ] = False,
) -> int:
    """Rename the keys that later releases have renamed; shows the difference."""
    from membrane_ctrl.config.upgrade import CHANGED_KEYS, upgrade_file

    difference = upgrade_file(file, write)
    if not difference:
        print(f"{file}: every key is that of this release ({len(CHANGED_KEYS)} changed so far)")
        return 0
    print(difference)
    if not write:
        print(f"nothing is written; `membrane-ctrl config upgrade --write {file}` writes it")
    return 0
