"""`check`: the state of each interlock, and the request to test it."""

from dataclasses import dataclass

from rich.table import Table

from firmware_iface import interlocks, roles
from firmware_iface.links import modbus_rtu
from firmware_iface.role_bench import answer
from membrane_ctrl.config import device_places
from membrane_ctrl.config.schema import DevicesConfig
from membrane_ctrl.instruments import bench, interlock_sources

HOW_TO_TEST = (
    "test each interlock: open its circuit and see that `membrane-ctrl check` lists it as open, "
    "unplug its signal and see the same, then close it again (docs/how-to/operations.md, "
    "Interlocks)"
)
CLOSED, OPEN, NO_SIGNAL = "closed", "open", "no signal"


@dataclass(frozen=True, slots=True)
class InterlockProbe:
    """An interlock as its source shows it now: `state` is closed, open, or no signal."""

    name: str
    source: str
    state: str
    safe_level: str
    text: str
    problem: str = ""  # why there is no signal, and what to do


async def probe_interlocks(devices: DevicesConfig) -> list[InterlockProbe]:
    """Read every circuit once, without writing to any device, in the order of the configuration.

    Raises InputError for impossible settings, such as a GPIO line without the package that reads
    it.
    """
    if not devices.interlocks:
        return []
    polled = interlock_sources.list_polled_sources(devices, modbus_rtu.ModbusLinks())
    found = await _board_circuits(devices)
    for source in polled:
        found |= await _polled_circuits(devices, source)
    return [found[bit] for bit in sorted(found)]


def describe_effect(probes: list[InterlockProbe]) -> str:
    """What the circuits mean for a hold, in one line."""
    blocking = [f"{probe.name} ({probe.state})" for probe in probes if probe.state != CLOSED]
    if blocking:
        return f"no hold before they are closed: {', '.join(blocking)}"
    if not probes:
        return "none configured"
    return f"all {len(probes)} closed"


def make_interlock_table(probes: list[InterlockProbe]) -> Table:
    """The circuits for people."""
    table = Table("interlock", "source", "now", "enters", "text")
    for probe in probes:
        table.add_row(probe.name, probe.source, probe.state, probe.safe_level, probe.text)
    return table


async def _board_circuits(devices: DevicesConfig) -> dict[int, InterlockProbe]:
    """The circuits at the board's inputs, by bit."""
    inputs = bench.board_inputs(devices)
    if not inputs or devices.board is None:
        return {}
    board = bench.make_pump_board(devices, devices.board)
    open_mask, problem = 0, ""
    try:
        await board.identify()
        open_mask = interlocks.open_board_inputs(await board.read(), inputs)
    except roles.LinkError as error:
        problem = str(error)
    finally:
        await board.close()
    return {
        bit: _probe_interlock(devices, bit, bool(open_mask >> bit & 1), problem) for bit in inputs
    }


async def _polled_circuits(
    devices: DevicesConfig, polled: interlocks.PolledSource
) -> dict[int, InterlockProbe]:
    """The circuits of one source, by bit."""
    source, problem = polled.source, ""
    closed: tuple[bool, ...] = (False,) * len(polled.bits)
    try:
        await answer("interlock", source.open())
        closed = await answer("interlock", source.closed_circuits())
    except roles.LinkError as error:
        problem = str(error)
    finally:
        await source.close()
    if len(closed) != len(polled.bits):
        problem = f"{len(closed)} circuits in the answer, expected {len(polled.bits)}"
        closed = (False,) * len(polled.bits)
    return {
        bit: _probe_interlock(devices, bit, not is_closed, problem)
        for bit, is_closed in zip(polled.bits, closed, strict=True)
    }


def _probe_interlock(
    devices: DevicesConfig, bit: int, is_open: bool, problem: str
) -> InterlockProbe:
    interlock = devices.interlocks[bit]
    source = device_places.find_circuit_place("", interlock, device_places.normalise_link).words
    state = OPEN if is_open else CLOSED
    if problem:
        state = NO_SIGNAL
    return InterlockProbe(
        interlock.name, source, state, interlock.safe_level, interlock.text, problem
    )
