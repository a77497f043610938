"""Makes the bench of the configured devices, and connects it."""

from collections.abc import Hashable

from firmware_iface import interlocks, role_bench, roles, settings
from firmware_iface.drivers.pump_board import PumpBoard
from firmware_iface.links import modbus_rtu
from firmware_iface.observed_board import ObservedBoard
from membrane_ctrl.config import device_places
from membrane_ctrl.config.schema import DevicesConfig
from membrane_ctrl.instruments import interlock_sources
from membrane_ctrl.instruments.device_names import host_addresses, serial_name
from membrane_ctrl.instruments.role_drivers import make_role_devices
from membrane_ctrl.model.errors import InputError


def make_bench(devices: DevicesConfig, observe: bool = False) -> roles.Bench:
    """Make the configured bench, not yet connected.

    Parameters
    ----------
    devices : DevicesConfig
        A pump board, or an instrument for each role; interlocks.
    observe : bool
        Whether it is only to be read.

    Raises
    ------
    InputError
        For impossible devices.
    """
    require_separate_ports(devices)
    links = modbus_rtu.ModbusLinks()
    made: roles.Bench
    if devices.board is None and observe:
        raise InputError(
            "devices: --observe needs a pump board; single instruments are set up when they are "
            "opened, and their ports cannot be shared"
        )
    if devices.board is None:
        made = role_bench.RoleBench(make_role_devices(devices, links), devices.watchdog_s)
    else:
        board = make_pump_board(devices, devices.board, links)
        made = ObservedBoard(board) if observe else board
    if not devices.interlocks:
        return made
    return interlocks.InterlockBench(
        made, board_inputs(devices), interlock_sources.list_polled_sources(devices, links)
    )


def make_pump_board(
    devices: DevicesConfig, url: str, links: modbus_rtu.ModbusLinks | None = None
) -> PumpBoard:
    """Make the driver of a pump board, not yet connected.

    Parameters
    ----------
    devices : DevicesConfig
        Unit, time-out and watchdog of the board.
    url : str
        `tcp://HOST:PORT` or `rtu:///dev/PORT?baud=...`.
    links : ModbusLinks, optional
        The links of the bench: devices on one line share one connection, which sends their requests
        one after the other. None: a link of its own.

    Raises
    ------
    InputError
        The address cannot be.
    """
    try:
        link = (links or modbus_rtu.ModbusLinks()).link(url, devices.unit_id, devices.timeout_s)
        return PumpBoard(url, devices.unit_id, devices.timeout_s, devices.watchdog_s, link)
    except ValueError as error:
        raise InputError(f"devices.board: {error}") from None


def board_inputs(devices: DevicesConfig) -> dict[int, int]:
    """By interlock, the input of the board that it is wired to."""
    return {
        index: interlock.input
        for index, interlock in enumerate(devices.interlocks)
        if isinstance(interlock, settings.BoardInputConfig)
    }


def require_separate_ports(devices: DevicesConfig) -> None:
    """Refuse two roles on one place, also if their links are spelt differently.
    Raises InputError.
    """
    shared = device_places.find_shared(devices.roles(), devices.interlocks, _device_of_link)
    if shared:
        raise InputError(shared)
    ports: dict[str, tuple[str, str]] = {}
    for role, port, link in devices.list_ports():
        other, other_link = ports.setdefault(serial_name(port), (role, link))
        if other != role and not (link and link == other_link):
            raise InputError(
                f"devices.{other} and devices.{role} name the same port, {port}; only Modbus "
                "devices on one link may "
                "share it"
            )


def _device_of_link(link: str) -> Hashable:
    """One value for all spellings of a link: of a TCP link the host's addresses, else the serial
    port or file.
    """
    plain = device_places.normalise_link(link)
    if isinstance(plain, tuple):
        host, port = plain
        return frozenset(host_addresses(host)), port
    return serial_name(str(plain))
