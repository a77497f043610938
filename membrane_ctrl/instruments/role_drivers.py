"""Makes the driver of a role from its `[devices.<role>]` table."""

from typing import Any

from firmware_iface import drivers, role_bench, roles, settings
from firmware_iface.drivers import bronkhorst, bronkhorst_modbus, bronkhorst_propar, modbus_map
from firmware_iface.links import modbus_rtu, serial_port
from membrane_ctrl.config.schema import DevicesConfig
from membrane_ctrl.instruments import driver_loading
from membrane_ctrl.model.errors import InputError


def make_role_devices(
    devices: DevicesConfig, links: modbus_rtu.ModbusLinks | None = None
) -> role_bench.RoleDevices:
    """Make the drivers named in the tables, not yet connected.

    Parameters
    ----------
    devices : DevicesConfig
        A table for each role, no pump board.
    links : ModbusLinks, optional
        Serial lines: drivers on one of them share it.

    Raises
    ------
    InputError
        For a port, URL, preset or setting that the driver does not accept.
    """
    links = links or modbus_rtu.ModbusLinks()
    made: dict[str, Any] = {}
    for role, section in devices.roles().items():
        try:
            made[role] = _make_driver(role, section, links)
        except ValueError as error:
            raise InputError(f"devices.{role}: {error}") from None
    displacement = made.pop("displacement", None)  # a bench held by its optics may have none
    vent = made.pop("vent", None)
    return role_bench.RoleDevices(
        displacement, made.pop("pump"), made.pop("gauge_pressure"), vent, made
    )


def _make_driver(role: str, section: settings.AnyDriver, links: modbus_rtu.ModbusLinks) -> Any:
    """Make the driver that a table names, for its role. Raises ValueError, InputError."""
    match section:
        case settings.ModbusMapConfig():
            return _make_modbus_value(role, section, links)
        case settings.BronkhorstModbusConfig():
            link = links.link(section.link, section.unit_id, section.timeout_s)
            return _make_bronkhorst(role, bronkhorst_modbus.ModbusParameters(link), section.serial)
        case settings.BronkhorstProparConfig():
            port = serial_port.SerialPort(section.port, serial_port.SerialSettings(section.baud))
            return _make_bronkhorst(
                role,
                bronkhorst_propar.ProparParameters(port, section.node, section.timeout_s),
                section.serial,
            )
        case _:
            device = driver_loading.make_driver(section, f"devices.{role}", drivers.INSTRUMENTS)
            if not hasattr(device, roles.ROLES[role].reads):
                name = driver_loading.name_of(section)
                raise ValueError(
                    f"the driver {name} has no {roles.ROLES[role].reads}, so it is no {role}"
                )
            return device


def _make_bronkhorst(
    role: str, port: bronkhorst.ParameterPort, serial: str
) -> bronkhorst.BronkhorstFlow | bronkhorst.BronkhorstPressure:
    if role == "pump":
        return bronkhorst.BronkhorstFlow(port, serial)
    return bronkhorst.BronkhorstPressure(port, serial)


def _make_modbus_value(
    role: str, section: settings.ModbusMapConfig, links: modbus_rtu.ModbusLinks
) -> modbus_map.ModbusValue:
    value_map, fence = modbus_map.make_map(map_keys(section), section.preset)
    link = links.link(section.link, section.unit_id, section.timeout_s, fence)
    return modbus_map.ModbusValue(link, value_map, rest=0.0 if role in roles.ACTUATORS else None)


def map_keys(section: settings.ModbusMapConfig) -> dict[str, Any]:
    """The keys of a map, in the terms of `drivers.modbus_map`."""
    keys = section.model_dump(
        include={"function", "type", "word_order", "address", "raw", "value", "limits"}
    )
    if section.identity_address is not None and section.identity_equals is not None:
        keys["identity"] = (section.identity_address, section.identity_equals)
    return keys
