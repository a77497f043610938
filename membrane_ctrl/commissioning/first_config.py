"""The command `config init`: a first configuration, from what is connected and from answers."""

import json
from pathlib import Path
from typing import Any

import typer

from membrane_ctrl.commissioning.devices import FoundDevice, find_cameras, find_displays, find_ports
from membrane_ctrl.commissioning.guide.device_questions import (
    ask_device_tables,
    derive_other_tables,
    find_key_meaning,
)
from membrane_ctrl.commissioning.guide.session_state import TomlTable
from membrane_ctrl.commissioning.guide.text_display import TextDisplay
from membrane_ctrl.commissioning.interview import hold_interview
from membrane_ctrl.config import toml_file
from membrane_ctrl.config.schema import Config
from membrane_ctrl.instruments import bench
from membrane_ctrl.model import errors

_HEAD = """\
# Configuration of membrane-ctrl. Omitted keys use their defaults; `membrane-ctrl config explain KEY` shows what a key
# means, docs/reference/configuration.md lists them all, and `membrane-ctrl check {name}` checks this file and its devices.
# The loop holds the centre; `holds` of [loop] makes it hold the focus or a figure instead (docs/how-to/hold-a-figure.md).
"""  # noqa: E501
_TWIN = "tcp://127.0.0.1:{port}"


def write_first_config(path: Path, twin: bool, ask: bool) -> int:
    """Write a first configuration: for the twin, from answers, or, without a terminal, for the twin
    with what is connected.

    Parameters
    ----------
    path : Path
        The file.
    twin : bool
        For the twin.
    ask : bool
        There is a terminal.

    Returns
    -------
    int
        The exit code.

    Raises
    ------
    InputError
        The file exists or cannot be written, or answers contradict each other.
    """
    if path.exists() or path.is_symlink():
        raise errors.InputError(
            f"{path}: exists already, and is not overwritten; name another file"
        )
    found = [] if twin else _find_connected()
    # Without a terminal: the twin's board, and everything else by itself.
    if ask:
        tables = _ask_devices(path, found)
    else:
        board = _TWIN.format(port=Config().twin.port)
        tables = {"devices": {"board": board}, "shape": {"mode": "auto"}}
        tables |= {"estimator": {"process_value": "auto"}}
    # A file that is not valid is not written, nor over another one.
    parsed = toml_file.parse_tables(tables, Config, str(path))
    if parsed.devices is not None:
        bench.require_separate_ports(parsed.devices)
    text = "\n".join(
        [_HEAD.format(name=path.name), *_make_found_comments(found), *_format_tables("", tables)]
    )
    with errors.convert_write_errors(path), path.open("x", encoding="utf-8") as file:
        file.write(text + "\n")
    first = "" if ask else "start `membrane-ctrl twin`, then "
    typer.echo(f"{path}: written; {first}run `membrane-ctrl check {path}`", err=True)
    return errors.Exit.DONE


def _find_connected() -> list[FoundDevice]:
    cameras, notes = find_cameras()
    for note in notes:
        typer.echo(note, err=True)
    return [*find_ports(), *cameras, *find_displays()]


def _make_found_comments(found: list[FoundDevice]) -> list[str]:
    """Return what is connected, as comments to paste from."""
    lines = [
        f"# {found_one.kind} {found_one.name}: {' '.join(found_one.paste.split(chr(10)))}"
        for found_one in found
    ]
    return ["# Connected when this file was written:", *lines, ""] if lines else []


def _ask_devices(path: Path, found: list[FoundDevice]) -> TomlTable:
    """Ask for the devices; everything that follows from their absence is set as well."""
    display = TextDisplay(_read_answer, lambda line: typer.echo(line, err=True))
    display.show_line("At every prompt: `back` returns to the question before, `quit` or Ctrl-C")
    display.show_line("ends; nothing is lost.")
    answers = path.with_name(f"{path.name}.answers")
    section = hold_interview(answers, display, lambda dialogue: ask_device_tables(dialogue, found))
    return {"devices": section, **derive_other_tables(section)}


def _read_answer(key: str, prompt: str) -> str:
    """A line from the terminal. Raises EOFError at its end or at Ctrl-C."""
    try:
        asked = typer.prompt(prompt, default="", show_default=False, prompt_suffix=": ", err=True)
    except typer.Abort:
        raise EOFError from None
    return str(asked).strip()


def _format_tables(prefix: str, tables: TomlTable) -> list[str]:
    """Return the lines of tables: each key with its meaning."""
    lines: list[str] = []
    for name, value in tables.items():
        path = f"{prefix}{name}"
        if isinstance(value, dict):
            plain = {key: inner for key, inner in value.items() if not _holds_tables(inner)}
            if plain:
                lines += [f"[{path}]", *_format_keys(path, plain), ""]
            lines += _format_tables(f"{path}.", value)
        elif _holds_tables(value):
            for entry in value:
                lines += [f"[[{path}]]", *_format_keys(path, entry), ""]
    return lines


def _holds_tables(value: Any) -> bool:
    """Whether a value is a table, or a list of tables."""
    is_list_of_tables = isinstance(value, list) and any(isinstance(each, dict) for each in value)
    return isinstance(value, dict) or is_list_of_tables


def _format_keys(path: str, table: TomlTable) -> list[str]:
    """Return a line for each key of a table, with its meaning."""
    driver = table.get("driver", path)
    lines = []
    for key, value in table.items():
        meaning = "" if key == "driver" else f"  # {find_key_meaning(f'{driver}.{key}')}"
        lines.append(f"{key} = {json.dumps(value, ensure_ascii=False)}{meaning}")
    return lines
