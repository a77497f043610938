"""From the configuration's words to a bench of devices."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

from firmware_iface import role_bench, roles, settings
from firmware_iface.drivers import bronkhorst, bronkhorst_propar, modbus_map
from firmware_iface.drivers.keyence_dl_rs1a import KeyenceDlRs1a
from firmware_iface.drivers.optoncdt1420 import Optoncdt1420
from firmware_iface.drivers.pump_board import PumpBoard
from firmware_iface.drivers.vaisala_ptb330 import VaisalaPtb330
from firmware_iface.drivers.ventus import Ventus
from firmware_iface.links import modbus_rtu, serial_port
from membrane_ctrl.config.devices import DevicesConfig
from membrane_ctrl.model.errors import DeviceError, InputError

# From a `[devices.<role>]` table to the driver that fills the role.


ACTUATORS = ("pump", "vent")
_SERIAL_DRIVERS: dict[type[settings.Section], Callable[[Any], roles.Device]] = {
    settings.Optoncdt1420Config: Optoncdt1420,
    settings.KeyenceDlRs1aConfig: KeyenceDlRs1a,
    settings.VaisalaPtb330Config: VaisalaPtb330,
    settings.VentusConfig: Ventus,
}


def role_devices(devices: DevicesConfig) -> role_bench.RoleDevices:
    """The drivers that the tables name, not yet connected; those on one serial bus share it.

    Raises InputError (a port, URL, preset or setting that the driver does not take).
    """
    links = modbus_rtu.ModbusLinks()
    made: dict[str, Any] = {}
    for role, section in devices.roles().items():
        try:
            made[role] = _driver(role, section, links)
        except ValueError as error:
            raise InputError(f"devices.{role}: {error}") from None
    return role_bench.RoleDevices(**made)


def _driver(role: str, section: settings.AnyDriver, links: modbus_rtu.ModbusLinks) -> Any:
    match section:
        case settings.ModbusMapConfig():
            return _modbus_value(role, section, links)
        case settings.BronkhorstModbusConfig():
            link = links.link(section.link, section.unit_id, section.timeout_s)
            return _bronkhorst(role, bronkhorst.ModbusParameters(link), section.serial)
        case settings.BronkhorstProparConfig():
            port = serial_port.SerialPort(section.port, serial_port.SerialSettings(section.baud))
            return _bronkhorst(
                role, bronkhorst_propar.ProparParameters(port, section.node, section.timeout_s), section.serial
            )
        case _:
            return _SERIAL_DRIVERS[type(section)](section)


def _bronkhorst(
    role: str, port: bronkhorst.ParameterPort, serial: str
) -> bronkhorst.BronkhorstFlow | bronkhorst.BronkhorstPressure:
    return bronkhorst.BronkhorstFlow(port, serial) if role == "pump" else bronkhorst.BronkhorstPressure(port, serial)


def _modbus_value(
    role: str, section: settings.ModbusMapConfig, links: modbus_rtu.ModbusLinks
) -> modbus_map.ModbusValue:
    value_map, fence = modbus_map.make_map(map_keys(section), section.preset)
    link = links.link(section.link, section.unit_id, section.timeout_s, fence)
    return modbus_map.ModbusValue(link, value_map, rest=0.0 if role in ACTUATORS else None)


def map_keys(section: settings.ModbusMapConfig) -> dict[str, Any]:
    """The keys of a map in the words of `drivers.modbus_map`."""
    keys = section.model_dump(include={"function", "type", "word_order", "address", "raw", "value", "limits"})
    if section.identity_address is not None and section.identity_equals is not None:
        keys["identity"] = (section.identity_address, section.identity_equals)
    return keys


# A board that boots or a network that comes up is given this long before the command gives up
_PATIENCE_S = 5.0
_PAUSE_S = 0.25
_LAPSE_S = 1.0  # after the last moment at which a claim that nobody feeds has lapsed

T = TypeVar("T")


def open_bench(devices: DevicesConfig) -> roles.Bench:
    """The bench that the configuration names, not yet connected. Raises InputError for what no device can be."""
    if devices.board is None:
        return role_bench.RoleBench(role_devices(devices), devices.watchdog_s)
    return pump_board(devices, devices.board)


def pump_board(devices: DevicesConfig, url: str) -> PumpBoard:
    """The board at this URL, not yet connected. Raises InputError."""
    try:
        return PumpBoard(url, devices.unit_id, devices.timeout_s, devices.watchdog_s)
    except ValueError as error:
        raise InputError(f"devices.board: {error}") from None


async def connect(bench: roles.Bench, devices: DevicesConfig) -> roles.BenchIdentity:
    """Open the bench, with patience for a device that is not there yet and none for one that is the wrong one.

    Raises DeviceError (one line that names the device and what is wrong).
    """
    return await patiently(bench.open, devices.board or "devices")  # a composed bench names the role itself


async def patiently(attempt: Callable[[], Awaitable[T]], where: str) -> T:
    """Connect by this attempt, again and again; see `connect`."""
    loop = asyncio.get_running_loop()
    begin_s, patience_s = loop.time(), _PATIENCE_S
    failure = ""
    while True:
        try:
            return await attempt()
        except roles.LinkError as error:
            if not (isinstance(error, roles.LinkWaitsError) and failure):
                failure = str(error).removeprefix(f"{where}: ")
            if isinstance(
                error, roles.DeviceBusyError
            ):  # the claim of a program that was killed lapses with its watchdog
                patience_s = max(patience_s, error.lapses_in_s + _LAPSE_S)
            if isinstance(error, roles.DeviceRefusedError) or loop.time() > begin_s + patience_s:
                raise DeviceError(f"{where}: {failure}") from None
        await asyncio.sleep(_PAUSE_S)
