"""Makes the sources of the configured interlocks that are not inputs of the pump board.

Interlocks at one Modbus device, or at one GPIO chip, are read by one source, as often as the
fastest of them needs and with the strictest age of an answer.
"""

from collections import defaultdict
from collections.abc import Hashable

from firmware_iface import roles, settings
from firmware_iface.drivers.gpio_line import GpioCircuit, GpioLines
from firmware_iface.drivers.modbus_input import ModbusInputs
from firmware_iface.interlocks import PolledSource
from firmware_iface.links.modbus_rtu import ModbusLinks
from membrane_ctrl.config.schema import DevicesConfig
from membrane_ctrl.model.errors import InputError

_OPENING_TIMEOUTS = 3  # a first answer takes connecting, opening and reading
_GPIO_FIRST_S = 0.5

Member = tuple[int, settings.ModbusInputConfig | settings.GpioLineConfig]


def list_polled_sources(devices: DevicesConfig, links: ModbusLinks) -> list[PolledSource]:
    """List the sources of interlocks, not yet opened.

    Parameters
    ----------
    devices : DevicesConfig
        Its interlocks, without those of the pump board's own inputs.
    links : ModbusLinks
        Serial lines that several devices share.

    Raises
    ------
    InputError
        For a link or a missing package.
    """
    return [_make_source(members, links) for members in _by_device(devices).values()]


def _by_device(devices: DevicesConfig) -> dict[Hashable, list[Member]]:
    """The interlocks of each device, each with its bit."""
    groups: defaultdict[Hashable, list[Member]] = defaultdict(list)
    for bit, interlock in enumerate(devices.interlocks):
        match interlock:
            case settings.ModbusInputConfig():
                groups[interlock.link, interlock.unit_id].append((bit, interlock))
            case settings.GpioLineConfig():
                groups[interlock.chip].append((bit, interlock))
    return groups


def _make_source(members: list[Member], links: ModbusLinks) -> PolledSource:
    """Make the source that asks one device for all of its circuits. Raises InputError."""
    bits = tuple(bit for bit, _ in members)
    source: roles.InterlockSource
    try:
        first_s = _GPIO_FIRST_S
        # All members are circuits of one device: inputs of a Modbus unit, or lines of a GPIO chip.
        modbus = [found for _, found in members if isinstance(found, settings.ModbusInputConfig)]
        if modbus:
            timeout_s = max(found.timeout_s for found in modbus)
            link = links.link(modbus[0].link, modbus[0].unit_id, timeout_s)
            source = ModbusInputs(link, [(found.function, found.address) for found in modbus])
            first_s = _OPENING_TIMEOUTS * timeout_s
        else:
            lines = [found for _, found in members if isinstance(found, settings.GpioLineConfig)]
            source = GpioLines(
                lines[0].chip, [GpioCircuit(f.line, f.wiring, f.pull) for f in lines]
            )
    except ValueError as error:
        raise InputError(f"devices.interlocks.{bits[0]}: {error}") from None
    # Read as often, and no older, than the strictest of them needs.
    return PolledSource(
        source=source,
        bits=bits,
        period_s=min(found.period_s for _, found in members),
        age_max_s=min(found.age_max_s for _, found in members),
        first_s=first_s,
    )
