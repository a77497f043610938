"""The command `config init`: a first configuration, from what is connected and from answers."""

import json
import tomllib
from pathlib import Path
from typing import Any

import typer
from pydantic import TypeAdapter

from firmware_iface import roles, settings
from membrane_ctrl.commissioning.devices import FoundDevice, find_cameras, find_displays, find_ports
from membrane_ctrl.config import reference, toml_file
from membrane_ctrl.config.schema import Config, DevicesConfig
from membrane_ctrl.instruments import bench
from membrane_ctrl.model import errors

_HEAD = """\
# Configuration of membrane-ctrl. Omitted keys use their defaults; `membrane-ctrl config explain KEY` tells what a key
# means, docs/reference/configuration.md lists them all, and `membrane-ctrl check {name}` checks this file and its devices.
"""  # noqa: E501
_TWIN = "tcp://127.0.0.1:{port}"

TomlTable = dict[str, Any]


def write_first_config(path: Path, twin: bool, ask: bool) -> int:
    """Write the file: for the twin, from answers, or, with nobody to ask, for the twin with what is
    connected.

    Raises InputError for a file that exists or cannot be written, and for answers that contradict
    each other.
    """
    if path.exists() or path.is_symlink():
        raise errors.InputError(
            f"{path}: exists already, and is not overwritten; name another file"
        )
    found = [] if twin else _find_connected()
    tables = (
        _ask_devices(found)
        if ask
        else {"devices": {"board": _TWIN.format(port=Config().twin.port)}}
    )
    parsed = toml_file.parse_tables(tables, Config, str(path))
    if parsed.devices is not None:
        bench.require_separate_ports(parsed.devices)
    text = "\n".join(
        [_HEAD.format(name=path.name), *_comment_found(found), *_format_tables("", tables)]
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


def _comment_found(found: list[FoundDevice]) -> list[str]:
    """Return what is connected, as comments to paste from."""
    lines = [
        f"# {found_one.kind} {found_one.name}: {' '.join(found_one.paste.split(chr(10)))}"
        for found_one in found
    ]
    return ["# Connected when this file was written:", *lines, ""] if lines else []


def _ask_devices(found: list[FoundDevice]) -> TomlTable:
    """Ask for the devices; everything that follows from their absence is set as well."""
    for line in _comment_found(found):
        typer.echo(line, err=True)
    board = _ask_question(
        "pump board, tcp://HOST:PORT or rtu:///dev/ttyUSB0?baud=115200 (empty: single instruments)"
    )
    section: TomlTable = {"board": board} if board else {}
    for role in () if board else roles.ROLES.values():
        section |= _ask_role(role.name, optional=not role.needed)
    section |= (camera := _ask_role("camera", optional=True))
    if camera and not _shows_patterns(camera["camera"]):
        section |= _ask_role("screen", optional=False)
    tables: TomlTable = {"devices": section}
    if not board:
        sensors = {"feedforward_barometer": "barometer", "feedforward_temperature": "thermometer"}
        missing = {key: False for key, role in sensors.items() if role not in section}
        tables |= {"loop": missing} if missing else {}
        if str(section["pump"]["driver"]).startswith("bronkhorst"):  # linear from 0
            tables["pump"] = dict.fromkeys(
                ("dead_fraction", "start_fraction", "stall_fraction"), 0.0
            )
    return tables if "camera" in section else tables | {"shape": {"enabled": False}}


def _shows_patterns(camera: TomlTable) -> bool:
    """Whether this camera's table needs no screen beside it."""
    section: settings.CameraSection = TypeAdapter(settings.CameraConfig).validate_python(camera)
    return section.shows_patterns


def _ask_role(role: str, optional: bool) -> TomlTable:
    """Ask for the driver of a role and for the keys that it requires; empty without a driver."""
    sections = toml_file.list_sections(DevicesConfig.model_fields[role].annotation)
    known = {
        driver: section for section in sections for driver in toml_file.list_driver_names(section)
    }
    question = f"{role}: driver, {' or '.join(known)}" + (" (empty: none)" if optional else "")
    while True:
        driver = _ask_question(question)
        if not driver and optional:
            return {}
        if driver not in known:
            typer.echo(
                f"{driver!r} is no driver; {toml_file.suggest_word(driver, [*known])}", err=True
            )
            continue
        table: TomlTable = {"driver": driver}
        for name, field in known[driver].model_fields.items():
            if name == "raw" or (
                field.is_required() and name != "driver"
            ):  # only a preset replaces `raw`
                answer = _ask_question(f"  {name} ({_key_meaning(f'{driver}.{name}').rstrip('.')})")
                table[name] = answer if field.annotation is str else _parse_answer(answer)
        try:
            toml_file.parse_tables(table, known[driver], role)
        except errors.InputError as error:
            typer.echo(f"{error}; once more", err=True)
            continue
        return {role: table}


def _ask_question(question: str) -> str:
    return str(
        typer.prompt(question, default="", show_default=False, prompt_suffix=": ", err=True)
    ).strip()


def _parse_answer(answer: str) -> Any:
    """Return an answer as TOML reads it, or as it is; the check of its table then names what is
    wrong.
    """
    try:
        return tomllib.loads(f"x = {answer}")["x"]
    except tomllib.TOMLDecodeError:
        return answer


def _key_meaning(key: str) -> str:
    return reference.find_explained(key)[0].keys[0].meaning


def _format_tables(prefix: str, tables: TomlTable) -> list[str]:
    """Return the lines of tables: each key with its meaning."""
    lines = []
    for name, value in tables.items():
        if isinstance(value, dict):
            plain = {key: inner for key, inner in value.items() if not isinstance(inner, dict)}
            lines += [*([f"[{prefix}{name}]"] if plain else [])]
            driver = plain.get("driver", f"{prefix}{name}")
            for key, inner in plain.items():
                meaning = "" if key == "driver" else f"  # {_key_meaning(f'{driver}.{key}')}"
                lines.append(f"{key} = {json.dumps(inner, ensure_ascii=False)}{meaning}")
            lines += [*([""] if plain else []), *_format_tables(f"{prefix}{name}.", value)]
    return lines
