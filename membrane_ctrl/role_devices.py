"""From a `[devices.<role>]` table to the driver that fills the role."""

from __future__ import annotations

from typing import Any

from firmware_iface.drivers.bronkhorst import BronkhorstFlow, BronkhorstPressure, ParameterPort
from firmware_iface.drivers.bronkhorst_modbus import ModbusParameters
from firmware_iface.drivers.bronkhorst_propar import ProparParameters
from firmware_iface.drivers.keyence_dl_rs1a import KeyenceDlRs1a
from firmware_iface.drivers.modbus_map import ModbusValue, make_map
from firmware_iface.drivers.optoncdt1420 import Optoncdt1420
from firmware_iface.drivers.vaisala_ptb330 import VaisalaPtb330
from firmware_iface.drivers.ventus import Ventus
from firmware_iface.links.modbus_links import ModbusLinks
from firmware_iface.links.serial_port import SerialPort, SerialSettings
from firmware_iface.role_bench import RoleDevices
from membrane_ctrl import device_config as table
from membrane_ctrl.device_config import AnyDriver, DevicesConfig
from membrane_ctrl.errors import InputError

ACTUATORS = ("pump", "vent")
_SERIAL_DRIVERS = {
    "optoncdt1420": Optoncdt1420,
    "keyence_dl_rs1a": KeyenceDlRs1a,
    "vaisala_ptb330": VaisalaPtb330,
    "ventus": Ventus,
}


def role_devices(devices: DevicesConfig) -> RoleDevices:
    """The drivers that the tables name, not yet connected; those on one serial bus share it.

    Raises
    ------
    InputError
        A port, URL, preset or setting that the driver does not take.
    """
    links = ModbusLinks()
    made: dict[str, Any] = {}
    for role, section in devices.roles().items():
        try:
            made[role] = _driver(role, section, links)
        except ValueError as error:
            raise InputError(f"devices.{role}: {error}") from None
    return RoleDevices(**made)


def _driver(role: str, section: AnyDriver, links: ModbusLinks) -> Any:
    match section:
        case table.ModbusMap():
            return _modbus_value(role, section, links)
        case table.BronkhorstModbus():
            link = links.link(section.link, section.unit_id, section.timeout_s)
            return _bronkhorst(role, ModbusParameters(link), section.serial)
        case table.BronkhorstPropar():
            port = SerialPort(section.port, SerialSettings(section.baud))
            return _bronkhorst(role, ProparParameters(port, section.node, section.timeout_s), section.serial)
        case _:
            return _SERIAL_DRIVERS[section.driver](**section.model_dump(exclude={"driver"}))


def _bronkhorst(role: str, port: ParameterPort, serial: str) -> BronkhorstFlow | BronkhorstPressure:
    return BronkhorstFlow(port, serial) if role == "pump" else BronkhorstPressure(port, serial)


def _modbus_value(role: str, section: table.ModbusMap, links: ModbusLinks) -> ModbusValue:
    value_map, fence = make_map(map_keys(section), section.preset)
    link = links.link(section.link, section.unit_id, section.timeout_s, fence)
    return ModbusValue(link, value_map, rest=0.0 if role in ACTUATORS else None)


def map_keys(section: table.ModbusMap) -> dict[str, Any]:
    """The keys of a map in the words of `drivers.modbus_map`."""
    keys = section.model_dump(include={"function", "type", "word_order", "address", "raw", "value", "limits"})
    if section.identity_address is not None and section.identity_equals is not None:
        keys["identity"] = (section.identity_address, section.identity_equals)
    return keys
