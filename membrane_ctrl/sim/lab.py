"""Emulates a configuration's instruments byte by byte over one plant: a lab without a pump board.

Each serial port of the configuration becomes a pseudo-terminal, each Modbus TCP address a port of
this machine; the drivers are given these in place of the real ones.
"""

import tempfile
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from firmware_iface import drivers, settings
from firmware_iface.drivers.modbus_map import ValueMap, load_preset, make_map
from firmware_iface.emulators import (
    input_module,
    keyence_dl_rs1a,
    modbus_pdu,
    modbus_server,
    optoncdt1420,
    pressure_gauges,
    pump_board,
    pumps,
    rtu_bus,
    serial_device,
)
from firmware_iface.links import modbus_rtu, serial_port
from firmware_iface.roles import ROLES
from membrane_ctrl.config.schema import DevicesConfig
from membrane_ctrl.instruments import driver_loading, role_drivers

_GATEWAY_NO_RESPONSE = 11
_PRESSURE_FULL_MBAR = 10.0  # an EL-PRESS of 1 kPa suits the mirror's 600 Pa
_FLOW_FULL_MLN_MIN = 360.0  # 6 mL/s
_VERSION = 100  # V1.00
_READ_INPUT = 4


class Lab:
    """Emulated instruments over a plant.

    Parameters
    ----------
    plant : BoardPlant
        What the instruments measure and drive.
    devices : DevicesConfig
        The configured instruments, each of which is emulated.

    Attributes
    ----------
    serial : dict of str to SerialDevice
        Devices by configured port.
    wires : dict of str to PtyWire
        Their pseudo-terminals, once started.
    """

    def __init__(self, plant: pump_board.BoardPlant, devices: DevicesConfig) -> None:
        self.serial: dict[str, serial_device.SerialDevice] = {}
        self.wires: dict[str, serial_device.PtyWire] = {}
        self._plant = plant
        self._devices = devices
        self._outputs = {"pump": 0.0, "vent": 0.0}
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._servers: dict[str, modbus_server.ModbusTcpServer] = {}
        self._tables: defaultdict[str, dict[int, modbus_pdu.RegisterTable]] = defaultdict(dict)

        # Instruments on lines of their own, and registers of those on Modbus, by link and unit.
        for role, section in devices.roles().items():
            if isinstance(section, settings.BronkhorstModbusConfig):
                instrument = self._make_bronkhorst(role, section.serial)
                registers = pumps.BronkhorstRegisters(instrument)
                self._tables[section.link][section.unit_id] = registers
            elif not isinstance(section, settings.ModbusMapConfig):
                self.serial[section.port] = self._make_device(role, section)
        self._map_devices()
        self._board: pump_board.PumpBoardEmulator | None = None
        if devices.board is not None:
            self._board = pump_board.PumpBoardEmulator(plant)
            self._tables[devices.board][devices.unit_id] = self._board.state
        self._modules: defaultdict[str, dict[int, input_module.InputModule]] = defaultdict(dict)
        self._add_modules()

        # A Modbus RTU bus is a serial line with several units.
        for url in self._modbus_urls:
            if url.startswith("rtu:"):
                _, line = modbus_rtu.parse_rtu_url(url)
                handlers = {
                    unit: partial(self._answer_unit, url, unit) for unit in self._find_units(url)
                }
                self.serial[url] = rtu_bus.RtuBusEmulator(line, handlers)

    async def start(self) -> DevicesConfig:
        """Plug everything in; returns the configuration with the emulators' addresses. Raises
        OSError.
        """
        # A pseudo-terminal for each serial line, and a server for each Modbus TCP link.
        self._folder = tempfile.TemporaryDirectory(prefix="membrane-lab-")
        for number, (port, device) in enumerate(self.serial.items()):
            self.wires[port] = serial_device.PtyWire(
                device, Path(self._folder.name, f"tty{number}")
            )
            self.wires[port].plug()
        for url in self._modbus_urls:
            if url.startswith("tcp:"):
                self._servers[url] = modbus_server.ModbusTcpServer(
                    partial(self._answer_unit_safely, url), "127.0.0.1", 0
                )
                await self._servers[url].start()

        # The same configuration, with the addresses of the emulators.
        interlocks = tuple(
            self._moved_interlock(interlock) for interlock in self._devices.interlocks
        )
        moved: dict[str, object] = {"interlocks": interlocks}
        if self._board is not None:
            await self._board.start()
            moved["board"] = self._find_address(str(self._devices.board))
        moved |= {
            role: self._redirect_table(section) for role, section in self._devices.roles().items()
        }
        return self._devices.model_copy(update=moved)

    async def stop(self) -> None:
        """Unplug everything."""
        for wire in self.wires.values():
            wire.unplug()
        for server in self._servers.values():
            await server.stop()
        if self._board is not None:
            await self._board.stop()
        if self._folder is not None:
            self._folder.cleanup()

    def _redirect_table(self, section: settings.AnyDriver) -> settings.AnyDriver:
        """The table with the emulator's address."""
        if not isinstance(section, settings.ON_MODBUS):
            return section.model_copy(update={"port": str(self.wires[section.port].path)})
        return section.model_copy(update={"link": self._find_address(section.link)})

    def _moved_interlock(self, interlock: settings.InterlockDriver) -> settings.InterlockDriver:
        """The interlock's table with the emulator's address; a GPIO line becomes an input of an
        emulated module.
        """
        match interlock:
            case settings.ModbusInputConfig():
                return interlock.model_copy(update={"link": self._find_address(interlock.link)})
            case settings.GpioLineConfig():
                common = interlock.model_dump(
                    include=set(settings.PolledInterlockConfig.model_fields)
                )
                link = self._find_address(_gpio_url(interlock.chip))
                return settings.ModbusInputConfig(
                    driver="modbus_input", link=link, address=interlock.line, **common
                )
            case _:
                return interlock

    @property
    def _modbus_urls(self) -> list[str]:
        """Links of everything emulated on Modbus."""
        return list(dict.fromkeys((*self._tables, *self._modules)))

    def _find_units(self, url: str) -> list[int]:
        return list(dict.fromkeys((*self._tables.get(url, {}), *self._modules.get(url, {}))))

    def _answer_unit(self, url: str, unit: int, pdu: bytes) -> bytes:
        """The answer of a unit: its bits from the module, everything else from its registers."""
        module = self._modules.get(url, {}).get(unit)
        found = module.respond(pdu) if module is not None else None
        if found is not None:
            return found
        table = self._tables.get(url, {}).get(unit)
        if table is None:
            return modbus_pdu.exception_pdu(pdu, modbus_pdu.ILLEGAL_FUNCTION)
        return respond_to_input(pdu, table)

    def _answer_unit_safely(self, url: str, unit: int, pdu: bytes) -> modbus_server.Answer:
        if unit not in self._find_units(url):
            return modbus_server.Answer(modbus_pdu.exception_pdu(pdu, _GATEWAY_NO_RESPONSE))
        return modbus_server.Answer(self._answer_unit(url, unit, pdu))

    def _add_modules(self) -> None:
        """One module for all interlocks at the same unit, and one for each GPIO chip; every circuit
        is closed.
        """
        # Circuits by link, unit, table of bits and address.
        bits: defaultdict[tuple[str, int], dict[str, dict[int, Callable[[], bool]]]] = defaultdict(
            lambda: {"discrete": {}, "coil": {}}
        )
        for interlock in self._devices.interlocks:
            match interlock:
                case settings.ModbusInputConfig():
                    bits[interlock.link, interlock.unit_id][interlock.function][
                        interlock.address
                    ] = _read_closed_circuit
                case settings.GpioLineConfig():
                    bits[_gpio_url(interlock.chip), 1]["discrete"][interlock.line] = (
                        _read_closed_circuit
                    )
        for (url, unit), tables in bits.items():
            self._modules[url][unit] = input_module.InputModule(tables["discrete"], tables["coil"])

    def _find_address(self, url: str) -> str:
        """Address of the emulators of a Modbus URL."""
        if url in self._servers:
            return f"tcp://127.0.0.1:{self._servers[url].port}"
        _, mark, options = url.partition("?")
        return f"rtu://{self.wires[url].path}{mark}{options}"

    def _make_device(self, role: str, section: settings.AnyDriver) -> serial_device.SerialDevice:
        match section:
            case settings.Optoncdt1420Config():
                return optoncdt1420.Optoncdt1420Emulator(
                    self._read_sensor(role),
                    round(section.range_mm or 50),
                    section.direction,
                    section.baud,
                )
            case settings.KeyenceDlRs1aConfig():
                return keyence_dl_rs1a.KeyenceDlRs1aEmulator(
                    self._read_sensor(role),
                    section.direction,
                    section.baud,
                    section.parity,
                    section.amplifier + 1,
                )
            case settings.VaisalaPtb330Config():
                return pressure_gauges.VaisalaPtb330Emulator(self._read_sensor(role), section.baud)
            case settings.Mks937bConfig():
                return pressure_gauges.Mks937bEmulator(
                    self._read_sensor(role),
                    section.baud,
                    section.parity,
                    section.address,
                    section.channel,
                )
            case settings.VentusConfig():
                return pumps.VentusEmulator(self._make_actuator("pump"), section.power_max_mw)
            case settings.BronkhorstProparConfig():
                return pumps.ProparDevice(
                    self._make_bronkhorst(role, section.serial),
                    serial_port.SerialSettings(section.baud),
                )
            case settings.ExternalConfig():
                end: Callable[..., float | None] = self._read_sensor(role)
                if role in self._outputs:
                    end = self._make_actuator(role)
                made: serial_device.SerialDevice = driver_loading.make_emulator(
                    section, f"devices.{role}", drivers.INSTRUMENTS, end
                )
                return made
            case _:
                raise AssertionError(section)

    def _map_devices(self) -> None:
        """One device for all maps that name the same unit of the same link."""
        # Roles by the link and unit of their device.
        units: defaultdict[tuple[str, int], list[tuple[str, settings.ModbusMapConfig]]] = (
            defaultdict(list)
        )
        for role, section in self._devices.roles().items():
            if isinstance(section, settings.ModbusMapConfig):
                units[section.link, section.unit_id].append((role, section))
        # One table of registers for each unit: sensors to read, actuators to write, constants.
        for (link, unit_id), members in units.items():
            sensors: dict[ValueMap, Callable[[], float]] = {}
            outputs: dict[ValueMap, Callable[[float], None]] = {}
            constants: dict[int, int] = {}
            raw_limits = (0, 0xFFFF)
            for role, section in members:
                value_map, _ = make_map(role_drivers.map_keys(section), section.preset)
                if value_map.version_address is not None:
                    constants[value_map.version_address] = _VERSION
                if value_map.identity is not None:
                    constants[value_map.identity[0]] = value_map.identity[1]
                if role in self._outputs:
                    outputs[value_map] = self._make_actuator(role)
                else:
                    sensors[value_map] = self._read_sensor(role)
                if section.preset:
                    low, high = load_preset(section.preset).get("raw_limits", raw_limits)
                    raw_limits = (low, high)
            self._tables[link][unit_id] = MapDevice(sensors, outputs, constants, raw_limits)

    def _make_bronkhorst(self, role: str, serial: str) -> pumps.Instrument:
        if role == "pump":
            return pumps.Instrument(
                "DMFC",
                serial or "M20000001A",
                _FLOW_FULL_MLN_MIN,
                "mln/min",
                None,
                self._make_actuator(role),
            )
        gauge_pa = self._read_sensor(role)
        return pumps.Instrument(
            "DEPC", serial or "M20000002A", _PRESSURE_FULL_MBAR, "mbar(g)", lambda: gauge_pa() / 100
        )

    def _read_sensor(self, role: str) -> Callable[[], float]:
        """Present value of a role's sensor, in the role's unit."""
        name = "displacement_um"
        if role != "displacement":
            name = ROLES[role].reads
        return lambda: float(getattr(self._plant.sample(), name))

    def _make_actuator(self, role: str) -> Callable[[float], None]:
        def drive(fraction: float) -> None:
            self._outputs[role] = fraction
            self._plant.actuate(self._outputs["pump"], self._outputs["vent"])

        return drive


def _read_closed_circuit() -> bool:
    """A closed circuit."""
    return True


def _gpio_url(chip: str) -> str:
    """Link under which the module that stands for a GPIO chip is listed; nothing connects to it."""
    return f"tcp:{chip}"


class MapDevice:
    """A `RegisterTable` for any server.

    Parameters
    ----------
    sensors : mapping of ValueMap to callable
        Maps that are read; the function returns the present value in the map's unit.
    outputs : mapping of ValueMap to callable
        Maps that are written; the function receives each new value.
    constants : mapping of int to int, optional
        Words by address, for identity and version.
    raw_limits : (int, int)
        Written words outside are refused with exception 3.
    """

    def __init__(
        self,
        sensors: Mapping[ValueMap, Callable[[], float]],
        outputs: Mapping[ValueMap, Callable[[float], None]],
        constants: Mapping[int, int] | None = None,
        raw_limits: tuple[int, int] = (0, 0xFFFF),
    ) -> None:
        self._sensors = sensors
        self._outputs = outputs
        self._constants = dict(constants or {})
        self._raw_limits = raw_limits
        self.restart()

    def restart(self) -> None:
        """Power-up: every output at the raw value 0, with its effect on the plant, if any."""
        self._written = {
            found.address + n: 0 for found in self._outputs for n in range(found.words)
        }
        for found, set_output in self._outputs.items():
            self._apply_output(found, set_output)

    def read(self, address: int, count: int) -> list[int]:
        """Return words of consecutive registers: outputs as last written, sensors as they read now.

        Parameters
        ----------
        address, count : int
            First register, and number of registers.

        Raises
        ------
        RegisterRefusal
            A register does not exist.
        """
        words = {**self._constants, **self._written}
        for found, value in self._sensors.items():
            words.update(enumerate(found.encode(value()), found.address))
        try:
            return [words[at] for at in range(address, address + count)]
        except KeyError:
            raise modbus_pdu.RegisterRefusal(modbus_pdu.ILLEGAL_ADDRESS) from None

    def write(self, address: int, words: Sequence[int]) -> None:
        """Write words to consecutive output registers, all or none, and drive the outputs.

        Parameters
        ----------
        address : int
            First register.
        words : sequence of int
            Raw words.

        Raises
        ------
        RegisterRefusal
            A register is no output, or a word is outside `raw_limits`.
        """
        places = range(address, address + len(words))
        if not all(at in self._written for at in places):
            raise modbus_pdu.RegisterRefusal(modbus_pdu.ILLEGAL_ADDRESS)
        if not all(self._raw_limits[0] <= word <= self._raw_limits[1] for word in words):
            raise modbus_pdu.RegisterRefusal(modbus_pdu.ILLEGAL_VALUE)
        self._written.update(zip(places, words, strict=True))
        for found, set_output in self._outputs.items():
            self._apply_output(found, set_output)

    def _apply_output(self, found: ValueMap, set_output: Callable[[float], None]) -> None:
        value = found.decode([self._written[found.address + n] for n in range(found.words)])
        # a current below 4 mA means a broken wire to the driven device: off
        set_output(value if found.allows(value) else 0.0)


def respond_to_input(pdu: bytes, table: modbus_pdu.RegisterTable) -> bytes:
    """Answer a request as `modbus_pdu.answer_request`, and function 4 from the same registers.

    Parameters
    ----------
    pdu : bytes
        The request, from the function code on; function 4 reads input registers.
    table : RegisterTable
        The registers, which this device offers as holding and as input registers.

    Returns
    -------
    bytes
        The reply's PDU, or an exception's.
    """
    if pdu[0] != _READ_INPUT:
        return modbus_pdu.answer_request(pdu, table)
    reply = modbus_pdu.answer_request(bytes([modbus_pdu.READ_HOLDING]) + pdu[1:], table)
    return bytes([reply[0] - modbus_pdu.READ_HOLDING + _READ_INPUT]) + reply[1:]
