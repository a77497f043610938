"""The command `config init`: a first configuration, from what is connected and from answers."""

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import typer
from pydantic import BaseModel, TypeAdapter

from firmware_iface import roles, settings
from membrane_ctrl.commissioning.devices import FoundDevice, find_cameras, find_displays, find_ports
from membrane_ctrl.config import reference, toml_file
from membrane_ctrl.config.schema import Config, DevicesConfig
from membrane_ctrl.instruments import bench
from membrane_ctrl.model import errors

_HEAD = """\
# Configuration of membrane-ctrl. Omitted keys use their defaults; `membrane-ctrl config explain KEY` shows what a key
# means, docs/reference/configuration.md lists them all, and `membrane-ctrl check {name}` checks this file and its devices.
"""  # noqa: E501
_TWIN = "tcp://127.0.0.1:{port}"

TomlTable = dict[str, Any]


def write_first_config(path: Path, twin: bool, ask: bool) -> int:
    """Write the file: for the twin, from answers, or, without a terminal, for the twin with what is
    connected.

    Raises InputError for a file that exists or cannot be written, and for answers that contradict
    each other.
    """
    if path.exists() or path.is_symlink():
        raise errors.InputError(
            f"{path}: exists already, and is not overwritten; name another file"
        )
    found = [] if twin else _find_connected()
    if ask:
        tables = _ask_devices(found)
    else:
        board = _TWIN.format(port=Config().twin.port)
        tables = {"devices": {"board": board}, "shape": {"mode": "auto"}}
    tables |= {"estimator": {"process_value": "auto"}}
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


def _ask_devices(found: list[FoundDevice]) -> TomlTable:
    """Ask for the devices; everything that follows from their absence is set as well."""
    for line in _make_found_comments(found):
        typer.echo(line, err=True)
    board = _ask_question(
        "pump board, tcp://HOST:PORT or rtu:///dev/ttyUSB0?baud=115200 (empty: single instruments)"
    )
    section: TomlTable = {}
    if board:
        section["board"] = board
    else:
        for role in roles.ROLES.values():
            section |= _ask_role(role.name, optional=not role.needed)
    section |= (camera := _ask_role("camera", optional=True))
    if camera and not camera_shows_patterns(camera["camera"]):
        section |= _ask_role("screen", optional=False)
    if interlocks := _ask_interlocks(with_board=bool(board)):
        section["interlocks"] = interlocks
    tables: TomlTable = {"devices": section}
    if not board:
        sensors = {"feedforward_barometer": "barometer", "feedforward_temperature": "thermometer"}
        missing = {key: False for key, role in sensors.items() if role not in section}
        if missing:
            tables["loop"] = missing
        if list_driver_sections("pump")[section["pump"]["driver"]] in settings.FLOW_CONTROLLERS:
            tables["pump"] = dict.fromkeys(
                ("dead_fraction", "start_fraction", "stall_fraction"), 0.0
            )
    if "camera" in section:
        return tables | {"shape": {"mode": "auto"}}
    return tables | {"shape": {"enabled": False}}


def camera_shows_patterns(camera: TomlTable) -> bool:
    """Whether this camera's table needs no screen beside it."""
    section: settings.CameraSection = TypeAdapter(settings.CameraConfig).validate_python(camera)
    return section.shows_patterns


def _ask_interlocks(with_board: bool) -> list[TomlTable]:
    """Ask for one interlock after the other; only a pump board has inputs of its own."""
    known = list_driver_sections("interlocks")
    if not with_board:
        del known["board_input"]
    asked: list[TomlTable] = []
    while table := _ask_table(
        f"interlock {len(asked) + 1} (emergency stop, door, oxygen monitor)", known, optional=True
    ):
        asked.append(table)
    return asked


def _ask_role(role: str, optional: bool) -> TomlTable:
    """Ask for the device of a role; empty without one."""
    table = _ask_table(role, list_driver_sections(role), optional)
    return {role: table} if table else {}


def list_driver_sections(field: str) -> dict[str, type[BaseModel]]:
    """The sections of the configuration that a field of `[devices]` may hold."""
    sections = toml_file.list_sections(DevicesConfig.model_fields[field].annotation)
    return {
        driver: section for section in sections for driver in toml_file.list_driver_names(section)
    }


def _ask_table(name: str, known: Mapping[str, type[BaseModel]], optional: bool) -> TomlTable:
    """Ask for a driver and for the keys that it requires; empty without a driver."""
    question = f"{name}: driver, {' or '.join(known)}" + (" (empty: none)" if optional else "")
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
        for key, field in known[driver].model_fields.items():
            # only a preset replaces `raw`
            if key == "raw" or (field.is_required() and key != "driver"):
                answer = _ask_question(
                    f"  {key} ({find_key_meaning(f'{driver}.{key}').rstrip('.')})"
                )
                if field.annotation is str:
                    table[key] = answer
                else:
                    table[key] = _parse_answer(answer)
        try:
            toml_file.parse_tables(table, known[driver], name)
        except errors.InputError as error:
            typer.echo(f"{error}; once more", err=True)
            continue
        return table


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


def find_key_meaning(key: str) -> str:
    return reference.find_explained(key)[0].keys[0].meaning


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
