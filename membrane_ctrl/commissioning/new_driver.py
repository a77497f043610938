"""`devices new`: a driver for a device of one's own, its emulator and its tests, as a package to
install.
"""

import importlib.util
import keyword
import re
import string
from pathlib import Path
from typing import Any

import typer

from firmware_iface import drivers, roles
from membrane_ctrl.config import toml_file
from membrane_ctrl.config.schema import DevicesConfig
from membrane_ctrl.model import errors

_TEMPLATES = Path(__file__).parent / "scaffold"
_NAME = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")
_LONGEST = 30  # the lines of the files stay within 118 characters
# By what the driver is asked for (`roles.Role.reads`): what the instrument is, how the invented one
# answers, and two values in the role's unit
_WORDS: dict[str, dict[str, Any]] = {
    "displacement": {
        "what": "displacement sensor",
        "Role": "DisplacementSensor",
        "unit": "mm",
        "divisor": 1000.0,
    },
    "gauge_pressure_pa": {
        "what": "pressure gauge",
        "Role": "PressureSensor",
        "unit": "mbar",
        "divisor": 100.0,
    },
    "ambient_pressure_pa": {
        "what": "barometer",
        "Role": "Barometer",
        "unit": "hPa",
        "divisor": 100.0,
    },
    "air_temperature_c": {
        "what": "thermometer",
        "Role": "Thermometer",
        "unit": "degC",
        "divisor": 1.0,
    },
    "film_temperature_c": {
        "what": "film thermometer",
        "Role": "FilmThermometer",
        "unit": "degC",
        "divisor": 1.0,
    },
    "ring_temperature_c": {
        "what": "ring thermometer",
        "Role": "RingThermometer",
        "unit": "degC",
        "divisor": 1.0,
    },
    "humidity_percent": {
        "what": "hygrometer",
        "Role": "Hygrometer",
        "unit": "percent",
        "divisor": 1.0,
    },
    "pump_fraction": {"what": "pump", "Role": "Pump", "unit": "percent", "divisor": 100.0},
    "vent_fraction": {"what": "valve", "Role": "Vent", "unit": "percent", "divisor": 100.0},
}
_SCALES = {
    "mm": "UM_PER_MM",
    "mbar": "PA_PER_MBAR",
    "hPa": "PA_PER_HPA",
    "degC": "DEGC",
    "percent": "PERCENT",
}
_EXAMPLES = {
    "displacement": (12.0, 20.0),
    "gauge_pressure_pa": (600.0, 520.0),
    "ambient_pressure_pa": (101_325.0, 99_800.0),
}
_OTHERS = {
    "displacement": 'driver = "optoncdt1420"\nport = "/dev/ttyUSB0"\nrange_mm = 50\nrate_khz = 2\n',
    "pump": 'driver = "bronkhorst_modbus"\nlink = "rtu:///dev/ttyUSB1?baud=115200&parity=E"\nunit_id '  # noqa: E501
    "= 3\n",
    "gauge_pressure": 'driver = "bronkhorst_modbus"\nlink = "rtu:///dev/ttyUSB1?baud=115200&parity=E"\nunit_id '  # noqa: E501
    "= 5\n",
}


_OPTICS = {
    "camera": {"camera": 'driver = "external"\nname = "{name}"\n', "screen": 'driver = "pygame"\n'},
    "screen": {"camera": 'driver = "aravis"\n', "screen": 'driver = "external"\nname = "{name}"\n'},
}
ROLES_OF_DRIVERS = (*roles.ROLES, *_OPTICS)


def write_package(name: str, role: str, folder: Path) -> int:
    """Write the package of a new driver below a folder, never over an existing one, and print what
    to do next.

    Parameters
    ----------
    name : str
        Of the driver; the package's folder is `<name>-driver`.
    role : str
        That it fills.
    folder : Path
        In which the package is written.

    Returns
    -------
    int
        The exit code.

    Raises
    ------
    InputError
        The name is taken or is none, the role is unknown, or the folder cannot be written.
    """
    _require_free(name)
    if role not in ROLES_OF_DRIVERS:
        raise errors.InputError(
            f"--role {role}: no such role; {toml_file.suggest_word(role, list(ROLES_OF_DRIVERS))}"
        )
    words = _make_driver_names(name, role) | (
        _make_optics_tables(name, role) if role in _OPTICS else _make_instrument_terms(role)
    )
    # with a dash, Python never takes the folder for the module
    target = folder / f"{words['dashed']}-driver"
    kind = "value"
    if role in roles.ACTUATORS:
        kind = "actuator"
    elif role == "displacement":
        kind = "displacement"
    if role in _OPTICS:
        prefix, lab = f"{role}_", "optics_lab.toml.txt"
    else:
        prefix, lab = "", "lab.toml.txt"
    files = {
        "pyproject.toml": "pyproject.toml.txt",
        f"{name}.py": f"{prefix}driver.txt",
        f"{name}_emulator.py": f"{prefix}emulator.txt",
        f"test_{name}.py": f"{prefix}test.txt",
        "lab.toml": lab,
    }
    with errors.convert_write_errors(target):
        if target.exists() or target.is_symlink():
            raise errors.InputError(
                f"{target}: exists already, and is not overwritten; choose another name"
            )
        target.mkdir(parents=True)
        for file, template in files.items():
            text = _of_kind((_TEMPLATES / template).read_text(encoding="utf-8"), kind)
            (target / file).write_text(string.Template(text).substitute(words), encoding="utf-8")
    page = "docs/how-to/new-device.md"
    if role in _OPTICS:
        page = "docs/how-to/new-camera.md"
    typer.echo(
        f"{target}: a driver, its emulator, its tests and lab.toml are written. Next ({page}):\n"
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
    built_in = {
        tag for section in toml_file.list_sections(DevicesConfig) for tag in _find_drivers(section)
    }
    if name in built_in or keyword.iskeyword(name) or importlib.util.find_spec(name) is not None:
        raise errors.InputError(
            f"{name}: taken by a driver or a Python module; choose another name"
        )


def _find_drivers(section: type[Any]) -> set[str]:
    """Return the names of all drivers in a table and the tables below it."""
    inner = [
        each
        for field in section.model_fields.values()
        for each in toml_file.list_sections(field.annotation)
    ]
    return {str(tag) for tag in toml_file.list_driver_names(section)}.union(
        *(_find_drivers(each) for each in inner)
    )


def _make_driver_names(name: str, role: str) -> dict[str, Any]:
    """Return what every template calls the driver and its entry point groups."""
    kind = {"camera": drivers.CAMERAS, "screen": drivers.SCREENS}.get(role, drivers.INSTRUMENTS)
    return {
        "name": name,
        "dashed": name.replace("_", "-"),
        "title": name.replace("_", " ").title(),
        "Class": "".join(word.capitalize() for word in name.split("_")),
        "MODEL": name.replace("_", "").upper(),
        "role": role,
        "drivers": kind.group,
        "emulators": kind.emulators,
    }


def _make_optics_tables(name: str, role: str) -> dict[str, Any]:
    """Return what the configuration of a camera or screen has beside it."""
    tables = {device: table.format(name=name) for device, table in _OPTICS[role].items()}
    return {**tables, "others": _format_devices(_OTHERS)}


def _format_devices(devices: dict[str, str]) -> str:
    return "".join(f"[devices.{role}]\n{table}\n" for role, table in devices.items())


def _make_instrument_terms(role: str) -> dict[str, Any]:
    """Return what the templates of an instrument state of its role."""
    reads = roles.ROLES[role].reads
    words = _WORDS[reads]
    first, second = _EXAMPLES.get(reads, (21.5, 23.0))
    unit, divisor = words["unit"], words["divisor"]
    others = {other: table for other, table in _OTHERS.items() if other != role}
    return {
        **words,
        "read": reads,
        "role_unit": roles.ROLES[role].unit,
        "suffix": {"degC": "c"}.get(unit, unit.lower()),
        "quantity": "pressure" if reads.endswith("_pa") else "an error",
        "field": unit,
        "SCALE": _SCALES[unit],
        "scale": 1 / divisor if unit == "percent" else divisor,
        "example": first,
        "second": second,
        "barometer": str(role == "barometer").lower(),
        "thermometer": str(role == "thermometer").lower(),
        "others": _format_devices(others),
    }


def _of_kind(template: str, kind: str) -> str:
    """Return a template's lines for a kind of instrument: those between `%kind ...` and `%end` are
    only for these.
    """
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
