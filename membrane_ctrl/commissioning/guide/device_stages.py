"""Step 2: which devices fill which roles."""

import tomllib
from collections.abc import Mapping
from typing import Any, get_args, get_origin

from pydantic import BaseModel

from firmware_iface import roles, settings
from firmware_iface.drivers.modbus_map import PRESETS
from membrane_ctrl.commissioning.devices import FoundDevice
from membrane_ctrl.commissioning.first_config import (
    camera_shows_patterns,
    find_key_meaning,
    list_driver_sections,
)
from membrane_ctrl.commissioning.guide.dialogue import Choice
from membrane_ctrl.commissioning.guide.session_state import TomlTable
from membrane_ctrl.commissioning.guide.stage import (
    StageContext,
    StageFailedError,
)
from membrane_ctrl.config import toml_file
from membrane_ctrl.controller.cross_check import cross_check
from membrane_ctrl.instruments import bench
from membrane_ctrl.model import errors

_BOARD, _SINGLE, _NONE, _OTHER = "board", "instruments", "none", "other"
_DEFAULT_BOARD = "tcp://127.0.0.1:5020"
_PAIR = "two numbers separated by a comma, such as 4000, 20000"
_INTERLOCK = "emergency stop, door, oxygen monitor, supply pressure"


def ask_devices(context: StageContext) -> None:
    """Ask for the devices and write their tables."""
    dialogue = context.dialogue
    found = context.access.find_devices()
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
            section |= _ask_role(context, role.name, found, optional=not role.needed)
    section |= (camera := _ask_role(context, "camera", found, optional=True))
    if camera and not camera_shows_patterns(camera["camera"]):
        section |= _ask_role(context, "screen", found, optional=False)
    if interlocks := _ask_interlocks(context, found, with_board=kind == _BOARD):
        section["interlocks"] = interlocks
    _write_devices(context, section)
    _judge_configuration(context)


def _ask_role(
    context: StageContext, role: str, found: list[FoundDevice], optional: bool
) -> TomlTable:
    """Ask for the device of a role; empty without one."""
    table = _ask_table(context, role, role, list_driver_sections(role), found, optional)
    return {role: table} if table else {}


def _ask_interlocks(
    context: StageContext, found: list[FoundDevice], with_board: bool
) -> list[TomlTable]:
    """Ask for one interlock after the other; only a pump board has inputs of its own."""
    known = dict(list_driver_sections("interlocks"))
    if not with_board:
        del known["board_input"]
    asked: list[TomlTable] = []
    while True:
        key = f"interlock{len(asked) + 1}"
        name = f"interlock {len(asked) + 1} ({_INTERLOCK})"
        table = _ask_table(context, key, name, known, found, optional=True)
        if not table:
            return asked
        asked.append(table)


def _ask_table(
    context: StageContext,
    key: str,
    name: str,
    known: Mapping[str, type[BaseModel]],
    found: list[FoundDevice],
    optional: bool,
) -> TomlTable:
    """Ask for a driver and for its required keys, until its table is valid; empty without one."""
    dialogue = context.dialogue
    choices = [
        Choice(name=driver, meaning=_first_line(section)) for driver, section in known.items()
    ]
    if optional:
        choices.insert(0, Choice(name=_NONE, meaning="not on this bench"))
    while True:
        driver = dialogue.ask_choice(f"{key}.driver", f"{name}: which driver?", choices)
        if driver == _NONE:
            return {}
        table: TomlTable = {"driver": driver}
        if "preset" in known[driver].model_fields:
            table |= _ask_preset(context, key)
        for field, about in known[driver].model_fields.items():
            is_asked = about.is_required() or (field == "raw" and "preset" not in table)
            if is_asked and field != "driver":
                table[field] = _ask_key(context, key, driver, field, about.annotation, found)
        try:
            toml_file.parse_tables(table, known[driver], name)
        except errors.InputError as error:
            dialogue.show(f"  {error}", "  the answers are kept: Enter repeats one")
            continue
        return table


def _ask_preset(context: StageContext, key: str) -> TomlTable:
    """Ask for the preset of a register map; empty without one."""
    presets = sorted(path.stem for path in PRESETS.glob("*.toml"))
    choices = [Choice(name=_NONE, meaning="I have the manual: ask for each key")]
    choices += [Choice(name=name, meaning="known device") for name in presets]
    preset = context.dialogue.ask_choice(f"{key}.preset", "preset?", choices, _NONE)
    return {} if preset == _NONE else {"preset": preset}


def _ask_key(
    context: StageContext, key: str, driver: str, field: str, kind: Any, found: list[FoundDevice]
) -> Any:
    """Ask for a key of a driver's table; a port is chosen from those that are connected."""
    dialogue = context.dialogue
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
        text = dialogue.ask_text(f"{key}.{field}", f"  {field} ({meaning}): {_PAIR}")
        return _parse_toml(f"[{text.strip('[] ')}]")
    text = dialogue.ask_text(f"{key}.{field}", f"  {field} ({meaning})")
    return text if kind is str else _parse_toml(text)


def _parse_toml(text: str) -> Any:
    """A value as TOML reads it, or the text; the check of its table then names what is wrong."""
    try:
        return tomllib.loads(f"x = {text}")["x"]
    except tomllib.TOMLDecodeError:
        return text


def _first_line(section: type[BaseModel]) -> str:
    return (section.__doc__ or "").strip().partition("\n")[0]


def _write_devices(context: StageContext, section: TomlTable) -> None:
    """Write the tables, with what follows from the absence of a device."""
    context.replace_table("devices", section)
    context.set_keys("estimator", process_value="auto")
    if "board" not in section:
        context.set_keys(
            "loop",
            feedforward_barometer="barometer" in section,
            feedforward_temperature="thermometer" in section,
        )
        drivers = list_driver_sections("pump")
        if drivers[section["pump"]["driver"]] in settings.FLOW_CONTROLLERS:
            context.set_keys("pump", dead_fraction=0.0, start_fraction=0.0, stall_fraction=0.0)
    if "camera" in section:
        context.set_keys("shape", enabled=True, mode="auto")
    else:
        context.set_keys("shape", enabled=False)


def _judge_configuration(context: StageContext) -> None:
    """Record what `check` finds in the configuration alone."""
    config = context.config
    if config.devices is not None:
        try:
            bench.require_separate_ports(config.devices)
        except errors.InputError as error:
            raise StageFailedError(str(error)) from None
    findings = cross_check(config)
    for finding in findings:
        context.require(
            finding.field,
            finding.severity == "warning",
            f"{finding.severity}: {finding.value}: {finding.why}",
            finding.remedy,
        )
    if not findings:
        context.require("configuration", True, "no finding")
