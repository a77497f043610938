"""`devices`: hardware and drivers on this machine; `config init`: a first configuration from them
and answers.
"""

import json
import tomllib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import typer
from pydantic import TypeAdapter
from rich.table import Table

from firmware_iface import drivers, roles, settings
from firmware_iface.links import aravis
from firmware_iface.links.serial_port import serial_ports
from membrane_ctrl.config import reference, toml_file
from membrane_ctrl.config.schema import Config, DevicesConfig
from membrane_ctrl.instruments import bench
from membrane_ctrl.model import errors, terminal

_DRM = Path("/sys/class/drm")
_HEAD = """\
# Configuration of membrane-ctrl. Omitted keys use their defaults; `membrane-ctrl config explain KEY` tells what a key
# means, docs/reference/configuration.md lists them all, and `membrane-ctrl check {name}` checks this file and its devices.
"""  # noqa: E501
_TWIN = "tcp://127.0.0.1:{port}"

TomlTable = dict[str, Any]


@dataclass(frozen=True, slots=True)
class FoundDevice:
    """A port, camera or display, or a driver that another package provides."""

    # "port", "camera", "display", or a kind of driver: "driver", "camera driver", "screen driver"
    kind: str
    name: str  # its own description
    paste: str = ""  # configuration line that names it; may be empty


def list_devices(as_json: bool) -> int:
    """Print every device found, and the searches that failed."""
    cameras, missing = find_cameras()
    found = [*find_ports(), *cameras, *find_displays(), *find_drivers()]
    if as_json:
        listed = [asdict(device) for device in found]
        print(json.dumps({"schema": "membrane-devices/1", "devices": listed, "notes": missing}))
        return errors.Exit.DONE
    table = Table("kind", "name", "to paste")
    for device in found:
        table.add_row(device.kind, device.name, device.paste)
    console = terminal.table_console()
    console.print(table if found else "nothing found: no serial port, camera or display")
    for note in missing:
        console.print(note)
    return errors.Exit.DONE


def find_ports() -> list[FoundDevice]:
    """Serial ports, by USB identity if they have one: it survives replugging."""
    return [
        FoundDevice(
            "port", f"{port.path}: {port.description}", f'port = "{port.usb_name or port.path}"'
        )
        for port in serial_ports()
    ]


def find_cameras() -> tuple[list[FoundDevice], list[str]]:
    """GenICam cameras, and a note if the search is impossible."""
    try:
        cameras = list(aravis.find_cameras())
    except roles.LinkError as error:
        return [], [str(error)]
    return [
        FoundDevice("camera", f"{camera.vendor} {camera.model}", f'camera = "{camera.camera_id}"')
        for camera in cameras
    ], []


def find_displays(root: Path = _DRM) -> list[FoundDevice]:
    """Connected displays, as listed by the kernel; needs no desktop."""
    found = []
    for status in sorted(root.glob("card*-*/status")):
        if status.read_text(encoding="ascii").strip() != "connected":
            continue
        connector = status.parent.name.split("-", 1)[1]
        modes = (status.parent / "modes").read_text(encoding="ascii").split()
        size = modes[0] if modes else "size unknown"
        width, _, height = size.partition("x")
        paste = (
            f"width_px = {width}\nheight_px = {height}"
            if width.isdigit() and height.isdigit()
            else ""
        )
        found.append(FoundDevice("display", f"{connector}, {size}", paste))
    return found


def find_drivers() -> list[FoundDevice]:
    """Drivers that other packages provide (docs/how-to/new-device.md); none of them is loaded."""
    return [
        FoundDevice(
            kind.name,
            f"{entry.name}, of {entry.dist.name} {entry.dist.version}"
            if entry.dist
            else entry.name,
            f'driver = "external"\nname = "{entry.name}"',
        )
        for kind in drivers.KINDS
        for entry in drivers.list_installed(kind.group)
    ]


def write_first(path: Path, twin: bool, ask: bool) -> int:
    """Write the file: for the twin, from answers, or, with nobody to ask, for the twin with what is
    connected.

    Raises InputError for a file that exists or cannot be written, and for answers that contradict
    each other.
    """
    if path.exists() or path.is_symlink():
        raise errors.InputError(
            f"{path}: exists already, and is not overwritten; name another file"
        )
    found = [] if twin else _connected()
    tables = (
        _answers(found) if ask else {"devices": {"board": _TWIN.format(port=Config().twin.port)}}
    )
    parsed = toml_file.parse(tables, Config, str(path))
    if parsed.devices is not None:
        bench.require_places(parsed.devices)
    text = "\n".join([_HEAD.format(name=path.name), *_listed(found), *_written("", tables)])
    with errors.writing(path), path.open("x", encoding="utf-8") as file:
        file.write(text + "\n")
    first = "" if ask else "start `membrane-ctrl twin`, then "
    typer.echo(f"{path}: written; {first}run `membrane-ctrl check {path}`", err=True)
    return errors.Exit.DONE


def _connected() -> list[FoundDevice]:
    cameras, notes = find_cameras()
    for note in notes:
        typer.echo(note, err=True)
    return [*find_ports(), *cameras, *find_displays()]


def _listed(found: list[FoundDevice]) -> list[str]:
    """Return what is connected, as comments to paste from."""
    lines = [
        f"# {found_one.kind} {found_one.name}: {' '.join(found_one.paste.split(chr(10)))}"
        for found_one in found
    ]
    return ["# Connected when this file was written:", *lines, ""] if lines else []


def _answers(found: list[FoundDevice]) -> TomlTable:
    """Ask for the devices; everything that follows from their absence is set as well."""
    for line in _listed(found):
        typer.echo(line, err=True)
    board = _asked(
        "pump board, tcp://HOST:PORT or rtu:///dev/ttyUSB0?baud=115200 (empty: single instruments)"
    )
    section: TomlTable = {"board": board} if board else {}
    for role in () if board else roles.ROLES.values():
        section |= _role(role.name, optional=not role.needed)
    section |= (camera := _role("camera", optional=True))
    if camera and not _shows_patterns(camera["camera"]):
        section |= _role("screen", optional=False)
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


def _role(role: str, optional: bool) -> TomlTable:
    """Ask for the driver of a role and for the keys that it requires; empty without a driver."""
    sections = toml_file.sections(DevicesConfig.model_fields[role].annotation)
    known = {driver: section for section in sections for driver in toml_file.tags(section)}
    question = f"{role}: driver, {' or '.join(known)}" + (" (empty: none)" if optional else "")
    while True:
        driver = _asked(question)
        if not driver and optional:
            return {}
        if driver not in known:
            typer.echo(f"{driver!r} is no driver; {toml_file.hint(driver, [*known])}", err=True)
            continue
        table: TomlTable = {"driver": driver}
        for name, field in known[driver].model_fields.items():
            if name == "raw" or (
                field.is_required() and name != "driver"
            ):  # only a preset replaces `raw`
                answer = _asked(f"  {name} ({_comment(f'{driver}.{name}').rstrip('.')})")
                table[name] = answer if field.annotation is str else _value(answer)
        try:
            toml_file.parse(table, known[driver], role)
        except errors.InputError as error:
            typer.echo(f"{error}; once more", err=True)
            continue
        return {role: table}


def _asked(question: str) -> str:
    return str(
        typer.prompt(question, default="", show_default=False, prompt_suffix=": ", err=True)
    ).strip()


def _value(answer: str) -> Any:
    """Return an answer as TOML reads it, or as it is; the check of its table then names what is
    wrong.
    """
    try:
        return tomllib.loads(f"x = {answer}")["x"]
    except tomllib.TOMLDecodeError:
        return answer


def _comment(key: str) -> str:
    return reference.explained(key)[0].keys[0].meaning


def _written(prefix: str, tables: TomlTable) -> list[str]:
    """Return the lines of tables: each key with its meaning."""
    lines = []
    for name, value in tables.items():
        if isinstance(value, dict):
            plain = {key: inner for key, inner in value.items() if not isinstance(inner, dict)}
            lines += [*([f"[{prefix}{name}]"] if plain else [])]
            driver = plain.get("driver", f"{prefix}{name}")
            for key, inner in plain.items():
                meaning = "" if key == "driver" else f"  # {_comment(f'{driver}.{key}')}"
                lines.append(f"{key} = {json.dumps(inner, ensure_ascii=False)}{meaning}")
            lines += [*([""] if plain else []), *_written(f"{prefix}{name}.", value)]
    return lines
