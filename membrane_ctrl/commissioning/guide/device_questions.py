"""Questions about devices: which fills which role, for `commission` and `config init`."""

import tomllib
from collections.abc import Mapping, Sequence
from typing import Any, get_args, get_origin

from pydantic import BaseModel, TypeAdapter

from firmware_iface import roles, settings
from firmware_iface.drivers.modbus_map import PRESETS
from membrane_ctrl.commissioning.devices import FoundDevice
from membrane_ctrl.commissioning.guide.dialogue import Choice, Dialogue
from membrane_ctrl.commissioning.guide.session_state import TomlTable
from membrane_ctrl.config import reference, toml_file
from membrane_ctrl.config.schema import DevicesConfig
from membrane_ctrl.model import errors

_BOARD, _SINGLE, _NONE, _OTHER = "board", "instruments", "none", "other"
_DEFAULT_BOARD = "tcp://127.0.0.1:5020"
_PAIR = "two numbers separated by a comma, such as 4000, 20000"
_INTERLOCK = "emergency stop, door, oxygen monitor, supply pressure"


def ask_device_tables(dialogue: Dialogue, found: Sequence[FoundDevice]) -> TomlTable:
    """Ask for the devices of every role, and for interlocks.

    Parameters
    ----------
    dialogue : Dialogue
        Asks, and keeps the answers for the next start.
    found : sequence of FoundDevice
        What is connected; it is shown, and its ports are offered as choices.

    Returns
    -------
    TomlTable
        The table `devices`, each of its parts valid by itself.
    """
    for each in found:
        dialogue.show(f"  found: {each.kind} {each.name}")
    kind = dialogue.ask_choice(
        "devices.kind",
        "what drives the pump?",
        (
            Choice(
                name=_BOARD,
                meaning="a pump board, with laser and sensors behind it: it has a watchdog",
            ),
            Choice(name=_SINGLE, meaning="single instruments, one per role"),
        ),
        _BOARD,
    )
    section: TomlTable = {}
    if kind == _BOARD:
        section["board"] = dialogue.ask_text(
            "devices.board",
            "address, tcp://HOST:PORT or rtu:///dev/ttyUSB0?baud=115200",
            _DEFAULT_BOARD,
        )
    else:
        for role in roles.ROLES.values():
            section |= _ask_role(dialogue, role.name, found, optional=not role.needed)
    section |= (camera := _ask_role(dialogue, "camera", found, optional=True))
    if camera and not camera_shows_patterns(camera["camera"]):
        section |= _ask_role(dialogue, "screen", found, optional=False)
    if interlocks := _ask_interlocks(dialogue, found, with_board=kind == _BOARD):
        section["interlocks"] = interlocks
    return section


def derive_other_tables(section: TomlTable) -> dict[str, TomlTable]:
    """What follows for other tables from devices that are there, or are not."""
    tables: dict[str, TomlTable] = {"estimator": {"process_value": "auto"}}
    if "board" not in section:
        sensors = {"feedforward_barometer": "barometer", "feedforward_temperature": "thermometer"}
        if missing := {key: False for key, role in sensors.items() if role not in section}:
            tables["loop"] = missing
        if list_driver_sections("pump")[section["pump"]["driver"]] in settings.FLOW_CONTROLLERS:
            keys = ("dead_fraction", "start_fraction", "stall_fraction")
            tables["pump"] = dict.fromkeys(keys, 0.0)
    tables["shape"] = {"mode": "auto"} if "camera" in section else {"enabled": False}
    return tables


def camera_shows_patterns(camera: TomlTable) -> bool:
    """Whether this camera's table needs no screen beside it."""
    section: settings.CameraSection = TypeAdapter(settings.CameraConfig).validate_python(camera)
    return section.shows_patterns


def list_driver_sections(field: str) -> dict[str, type[BaseModel]]:
    """The sections of the configuration that a field of `[devices]` may hold."""
    sections = toml_file.list_sections(DevicesConfig.model_fields[field].annotation)
    return {
        driver: section for section in sections for driver in toml_file.list_driver_names(section)
    }


def find_key_meaning(key: str) -> str:
    """The meaning of a driver's key, such as `ventus.port`."""
    return reference.find_explained(key)[0].keys[0].meaning


def _ask_role(
    dialogue: Dialogue, role: str, found: Sequence[FoundDevice], optional: bool
) -> TomlTable:
    """Ask for the device of a role; empty without one."""
    table = _ask_table(dialogue, role, role, list_driver_sections(role), found, optional)
    return {role: table} if table else {}


def _ask_interlocks(
    dialogue: Dialogue, found: Sequence[FoundDevice], with_board: bool
) -> list[TomlTable]:
    """Ask for one interlock after the other; only a pump board has inputs of its own."""
    known = dict(list_driver_sections("interlocks"))
    if not with_board:
        del known["board_input"]
    asked: list[TomlTable] = []
    while True:
        key = f"interlock{len(asked) + 1}"
        name = f"interlock {len(asked) + 1} ({_INTERLOCK})"
        table = _ask_table(dialogue, key, name, known, found, optional=True)
        if not table:
            return asked
        asked.append(table)


def _ask_table(
    dialogue: Dialogue,
    key: str,
    name: str,
    known: Mapping[str, type[BaseModel]],
    found: Sequence[FoundDevice],
    optional: bool,
) -> TomlTable:
    """Ask for a driver and for its required keys, until its table is valid; empty without one."""
    choices = [
        Choice(name=driver, meaning=_first_sentence(section)) for driver, section in known.items()
    ]
    if optional:
        choices.insert(0, Choice(name=_NONE, meaning="not on this bench"))
    # The driver first, then what its table cannot do without: a preset of a register map replaces
    # most of its keys. A refused table is asked again, with the answers as defaults.
    while True:
        default = _NONE if optional else ""
        driver = dialogue.ask_choice(f"{key}.driver", f"{name}: which driver?", choices, default)
        if driver == _NONE:
            return {}
        table: TomlTable = {"driver": driver}
        if "preset" in known[driver].model_fields:
            table |= _ask_preset(dialogue, key)
        for field, about in known[driver].model_fields.items():
            is_asked = about.is_required() or (field == "raw" and "preset" not in table)
            if is_asked and field != "driver":
                table[field] = _ask_key(dialogue, key, driver, field, about.annotation, found)
        try:
            toml_file.parse_tables(table, known[driver], name)
        except errors.InputError as error:
            dialogue.show(f"  {error}", "  the answers are kept: Enter repeats one")
            continue
        return table


def _ask_preset(dialogue: Dialogue, key: str) -> TomlTable:
    """Ask for the preset of a register map; empty without one."""
    presets = sorted(path.stem for path in PRESETS.glob("*.toml"))
    choices = [Choice(name=_NONE, meaning="I have the manual: ask for each key")]
    choices += [Choice(name=name, meaning="known device") for name in presets]
    preset = dialogue.ask_choice(f"{key}.preset", "preset?", choices, _NONE)
    return {} if preset == _NONE else {"preset": preset}


def _ask_key(
    dialogue: Dialogue, key: str, driver: str, field: str, kind: Any, found: Sequence[FoundDevice]
) -> Any:
    """Ask for a key of a driver's table; a port is chosen from those that are connected."""
    meaning = find_key_meaning(f"{driver}.{field}").rstrip(".")
    ports = [tomllib.loads(each.paste)["port"] for each in found if each.kind == "port"]
    if field == "port" and ports:
        choices = [
            *(Choice(name=port) for port in ports),
            Choice(name=_OTHER, meaning="type another one"),
        ]
        port = dialogue.ask_choice(f"{key}.port_of_list", f"  {meaning}", choices)
        if port != _OTHER:
            return port
    is_pair = any(get_origin(each) is tuple for each in (kind, *get_args(kind)))
    if is_pair:
        text = dialogue.ask_text(
            f"{key}.{field}", f"  {field} ({meaning}): {_PAIR}", is_needed=True
        )
        return _parse_toml(f"[{text.strip('[] ')}]")
    text = dialogue.ask_text(f"{key}.{field}", f"  {field} ({meaning})", is_needed=True)
    return text if kind is str else _parse_toml(text)


def _parse_toml(text: str) -> Any:
    """A value as TOML reads it, or the text; the check of its table then names what is wrong."""
    try:
        return tomllib.loads(f"x = {text}")["x"]
    except tomllib.TOMLDecodeError:
        return text


def _first_sentence(section: type[BaseModel]) -> str:
    """What a driver is for, from its table's text."""
    return " ".join((section.__doc__ or "").split()).partition(". ")[0].rstrip(".")
