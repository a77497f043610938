"""`devices`: hardware and drivers on this machine; `config init`: a first configuration from them and answers.

`devices new`: a driver for an instrument of one's own, its emulator and its tests, as a package to install.
"""

import importlib.util
import json
import keyword
import re
import string
import tomllib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import typer
from rich.table import Table

from firmware_iface import drivers, roles
from firmware_iface.links import aravis
from firmware_iface.links.serial_port import serial_ports
from membrane_ctrl.config import reference, toml_file
from membrane_ctrl.config.schema import NEEDED, ROLES, Config, DevicesConfig
from membrane_ctrl.instruments import bench
from membrane_ctrl.model import errors, terminal

_DRM = Path("/sys/class/drm")
_HEAD = """\
# Configuration of membrane-ctrl. Omitted keys use their defaults; `membrane-ctrl config explain KEY` tells what a key
# means, docs/configuration.md lists them all, and `membrane-ctrl check {name}` checks this file and its devices.
"""
_TWIN = "tcp://127.0.0.1:{port}"

TomlTable = dict[str, Any]


@dataclass(frozen=True, slots=True)
class FoundDevice:
    """A port, camera or display, or a driver that another package provides."""

    kind: str  # "port", "camera", "display" or "driver"
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
        FoundDevice("port", f"{port.path}: {port.description}", f'port = "{port.usb_name or port.path}"')
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
        paste = f"width_px = {width}\nheight_px = {height}" if width.isdigit() and height.isdigit() else ""
        found.append(FoundDevice("display", f"{connector}, {size}", paste))
    return found


def find_drivers() -> list[FoundDevice]:
    """Drivers that other packages provide (docs/new-device.md); none of them is loaded."""
    return [
        FoundDevice(
            "driver",
            f"{entry.name}, of {entry.dist.name} {entry.dist.version}" if entry.dist else entry.name,
            f'driver = "external"\nname = "{entry.name}"',
        )
        for entry in drivers.installed()
    ]


def write_first(path: Path, twin: bool, ask: bool) -> int:
    """Write the file: for the twin, from answers, or, with nobody to ask, for the twin with what is connected.

    Raises InputError for a file that exists or cannot be written, and for answers that contradict each other.
    """
    if path.exists() or path.is_symlink():
        raise errors.InputError(f"{path}: exists already, and is not overwritten; name another file")
    found = [] if twin else _connected()
    tables = _answers(found) if ask else {"devices": {"board": _TWIN.format(port=Config().twin.port)}}
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
        f"# {found_one.kind} {found_one.name}: {' '.join(found_one.paste.split(chr(10)))}" for found_one in found
    ]
    return ["# Connected when this file was written:", *lines, ""] if lines else []


def _answers(found: list[FoundDevice]) -> TomlTable:
    """Ask for the devices; everything that follows from their absence is set as well."""
    for line in _listed(found):
        typer.echo(line, err=True)
    board = _asked("pump board, tcp://HOST:PORT or rtu:///dev/ttyUSB0?baud=115200 (empty: single instruments)")
    section: TomlTable = {"board": board} if board else {}
    for role in () if board else ROLES:
        section |= _role(role, optional=role not in NEEDED)
    section |= _role("camera", optional=True)
    if "camera" in section and section["camera"]["driver"] != "folder":
        section |= _role("screen", optional=False)
    tables: TomlTable = {"devices": section}
    if not board:
        sensors = {"feedforward_barometer": "barometer", "feedforward_temperature": "thermometer"}
        missing = {key: False for key, role in sensors.items() if role not in section}
        tables |= {"loop": missing} if missing else {}
        if str(section["pump"]["driver"]).startswith("bronkhorst"):  # linear from 0
            tables["pump"] = dict.fromkeys(("dead_fraction", "start_fraction", "stall_fraction"), 0.0)
    return tables if "camera" in section else tables | {"shape": {"enabled": False}}


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
            if name == "raw" or (field.is_required() and name != "driver"):  # only a preset replaces `raw`
                answer = _asked(f"  {name} ({_comment(f'{driver}.{name}').rstrip('.')})")
                table[name] = answer if field.annotation is str else _value(answer)
        try:
            toml_file.parse(table, known[driver], role)
        except errors.InputError as error:
            typer.echo(f"{error}; once more", err=True)
            continue
        return {role: table}


def _asked(question: str) -> str:
    return str(typer.prompt(question, default="", show_default=False, prompt_suffix=": ", err=True)).strip()


def _value(answer: str) -> Any:
    """Return an answer as TOML reads it, or as it is; the check of its table then names what is wrong."""
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


_TEMPLATES = Path(__file__).parent / "scaffold"
_NAME = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")
_LONGEST = 30  # the lines of the files stay within 118 characters
# What a role's instrument is, how the invented one answers, and two values in the role's unit
_WORDS: dict[str, dict[str, Any]] = {
    "displacement": {"what": "displacement sensor", "Role": "DisplacementSensor", "unit": "mm", "divisor": 1000.0},
    "gauge_pressure": {"what": "pressure gauge", "Role": "PressureSensor", "unit": "mbar", "divisor": 100.0},
    "barometer": {"what": "barometer", "Role": "Barometer", "unit": "hPa", "divisor": 100.0},
    "thermometer": {"what": "thermometer", "Role": "Thermometer", "unit": "degC", "divisor": 1.0},
    "pump": {"what": "pump", "Role": "Pump", "unit": "percent", "divisor": 100.0},
    "vent": {"what": "valve", "Role": "Vent", "unit": "percent", "divisor": 100.0},
}
_SCALES = {"mm": "UM_PER_MM", "mbar": "PA_PER_MBAR", "hPa": "PA_PER_HPA", "degC": "DEGC", "percent": "PERCENT"}
_EXAMPLES = {"displacement": (12.0, 20.0), "gauge_pressure": (600.0, 520.0), "barometer": (101_325.0, 99_800.0)}
_OTHERS = {
    "displacement": 'driver = "optoncdt1420"\nport = "/dev/ttyUSB0"\nrange_mm = 50\nrate_khz = 2\n',
    "pump": 'driver = "bronkhorst_modbus"\nlink = "rtu:///dev/ttyUSB1?baud=115200&parity=E"\nunit_id = 3\n',
    "gauge_pressure": 'driver = "bronkhorst_modbus"\nlink = "rtu:///dev/ttyUSB1?baud=115200&parity=E"\nunit_id = 5\n',
}


def write_package(name: str, role: str, folder: Path) -> int:
    """Write the folder `<name>-driver` below another one, never over an existing one, and print what to do next.

    Raises InputError for a name that is taken or is none, an unknown role, and a folder that cannot be written.
    """
    _require_free(name)
    if role not in ROLES:
        raise errors.InputError(f"--role {role}: no such role; {toml_file.hint(role, list(ROLES))}")
    words = _substitutes(name, role)
    target = folder / f"{words['dashed']}-driver"  # with a dash, Python never takes the folder for the module
    kind = "actuator" if role in ("pump", "vent") else "displacement" if role == "displacement" else "value"
    files = {
        "pyproject.toml": "pyproject.toml.txt",
        f"{name}.py": "driver.txt",
        f"{name}_emulator.py": "emulator.txt",
        f"test_{name}.py": "test.txt",
        "lab.toml": "lab.toml.txt",
    }
    with errors.writing(target):
        if target.exists() or target.is_symlink():
            raise errors.InputError(f"{target}: exists already, and is not overwritten; choose another name")
        target.mkdir(parents=True)
        for file, template in files.items():
            text = _of_kind((_TEMPLATES / template).read_text(encoding="utf-8"), kind)
            (target / file).write_text(string.Template(text).substitute(words), encoding="utf-8")
    typer.echo(
        f"{target}: a driver, its emulator, its tests and lab.toml are written. Next (docs/new-device.md):\n"
        f"  pip install --no-deps --editable {target}\n"
        f"  python -m pytest {target}\n"
        f"  membrane-ctrl hold --twin --devices {target / 'lab.toml'} --duration 1m",
        err=True,
    )
    return errors.Exit.DONE


def _require_free(name: str) -> None:
    if not _NAME.fullmatch(name) or len(name) > _LONGEST:
        rule = f"use at most {_LONGEST} small letters, digits and _, such as acme_gauge"
        raise errors.InputError(f"{name}: not a name for a driver; {rule}")
    built_in = {tag for section in toml_file.sections(DevicesConfig) for tag in _drivers(section)}
    if name in built_in or keyword.iskeyword(name) or importlib.util.find_spec(name) is not None:
        raise errors.InputError(f"{name}: taken by a driver or a Python module; choose another name")


def _drivers(section: type[Any]) -> set[str]:
    """Return the names of all drivers in a table and the tables below it."""
    inner = [each for field in section.model_fields.values() for each in toml_file.sections(field.annotation)]
    return {str(tag) for tag in toml_file.tags(section)}.union(*(_drivers(each) for each in inner))


def _substitutes(name: str, role: str) -> dict[str, Any]:
    words = _WORDS[role]
    first, second = _EXAMPLES.get(role, (21.5, 23.0))
    unit, divisor = words["unit"], words["divisor"]
    others = {other: table for other, table in _OTHERS.items() if other != role}
    return {
        **words,
        "name": name,
        "dashed": name.replace("_", "-"),
        "title": name.replace("_", " ").title(),
        "Class": "".join(word.capitalize() for word in name.split("_")),
        "MODEL": name.replace("_", "").upper(),
        "role": role,
        "read": roles.READS[role][0],
        "role_unit": roles.READS[role][1],
        "suffix": {"degC": "c"}.get(unit, unit.lower()),
        "quantity": {"thermometer": "an error"}.get(role, "pressure"),
        "field": unit,
        "SCALE": _SCALES[unit],
        "scale": 1 / divisor if unit == "percent" else divisor,
        "example": first,
        "second": second,
        "barometer": str(role == "barometer").lower(),
        "thermometer": str(role == "thermometer").lower(),
        "others": "".join(f"[devices.{other}]\n{table}\n" for other, table in others.items()),
    }


def _of_kind(template: str, kind: str) -> str:
    """Return a template's lines for a kind of instrument: those between `%kind ...` and `%end` are only for these."""
    kept: list[str] = []
    wanted = [True]
    for line in template.splitlines():
        if line == "%end":
            wanted.pop()
        elif line.startswith("%"):
            wanted.append(kind in line[1:].split())
        elif all(wanted):
            kept.append(line)
    return "\n".join([*kept, ""])
