"""The membrane pump board as a Modbus TCP device over any plant, with faults that can be switched on."""

import asyncio
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

from firmware_iface.emulators import board_state, modbus_server
from firmware_iface.register_map import RegisterMap, default_map

_PERIOD_S = 0.01  # the board's own loop; the pump is off at most this and one wake-up after the watchdog period
_GATEWAY_NO_RESPONSE = 11


class BoardPlant(Protocol):
    """What hangs on the board's wires."""

    def sample(self) -> board_state.BoardSample:
        """The newest sample of the sensors; called every 10 ms and at every request."""

    def actuate(self, pump_fraction: float, vent_fraction: float) -> None:
        """Drive pump and vent, both 0..1; called when one of them changes."""


@dataclass(slots=True)
class Faults:
    """What is wrong with the emulated board; each can be switched on and off while it runs."""

    silent: bool = False  # requests are carried out and not answered
    delay_s: float = 0.0  # answers come this much later
    frozen: bool = False  # the sensor block stays as it was (counter and time too)
    no_displacement: bool = False  # the laser has no value
    exception_code: int = 0  # every request is answered with this Modbus exception and not carried out; 0: off
    map_version: int = 0  # what the board says of its map; 0: the true one
    hang_up: bool = False  # the connection is dropped at every request
    short_reply: bool = False  # reads answer with one register too few, in a frame that is otherwise right
    wrong_function: bool = False  # answers carry function code 23 in place of 3, and 6 in place of 16
    wrong_transaction: bool = False  # answers carry another transaction id


class PumpBoardEmulator:
    """Serves `plant` on Modbus TCP, from the event loop's thread.

    Port 0 takes any free one (see `port` after `start`). The watchdog runs on `clock`, by default the event loop's.
    Requests to other units are answered with exception 11, as a gateway does. `registers` may be those of an earlier
    map version.
    """

    def __init__(
        self,
        plant: BoardPlant,
        host: str = "127.0.0.1",
        port: int = 0,
        clock: Callable[[], float] | None = None,
        unit_id: int = 1,
        registers: RegisterMap | None = None,
    ) -> None:
        self.faults = Faults()
        self._plant = plant
        self._clock = clock or (lambda: asyncio.get_running_loop().time())
        self._unit_id = unit_id
        self._sample = plant.sample()
        self._registers = registers or default_map()
        self.state = board_state.BoardState(self._registers, self._sample)
        self._actuated = (0.0, 0.0)
        self._server = modbus_server.ModbusTcpServer(self._handle, host, port)
        self._task: asyncio.Task[None] | None = None

    @property
    def port(self) -> int:
        """The port in use."""
        return self._server.port

    async def start(self) -> None:
        """Switch the board on. Raises OSError when it cannot listen, for example on a busy port."""
        await self._server.start()
        self._plant.actuate(*self._actuated)
        self._task = asyncio.create_task(self._run(), name="pump board emulator")

    async def stop(self) -> None:
        """Switch the board off: connections dropped, pump off, vent as it was. Raises what the plant raised."""
        task, self._task = self._task, None
        if task is None:
            return
        await self._server.stop()
        task.cancel()
        try:
            await task
        except asyncio.CancelledError:
            self._plant.actuate(0.0, self._actuated[1])

    def power_cycle(self) -> None:
        """Restart the board; connections live on, as behind a gateway (see also `drop_connections`)."""
        self.state.restart()
        self._actuate()

    def drop_connections(self) -> None:
        """Hang up on all clients."""
        self._server.drop_connections()

    async def _run(self) -> None:
        while True:
            self._advance()
            await asyncio.sleep(_PERIOD_S)

    def _advance(self) -> None:
        if not self.faults.frozen:
            sample = self._plant.sample()
            self._sample = replace(sample, displacement_um=math.nan) if self.faults.no_displacement else sample
        self.state.advance(self._clock(), self._sample)
        self._actuate()

    def _actuate(self) -> None:
        outputs = (self.state.pump_fraction, self.state.vent_fraction)
        if outputs != self._actuated:
            self._actuated = outputs
            self._plant.actuate(*outputs)

    def _handle(self, unit: int, pdu: bytes) -> modbus_server.Answer:
        if unit != self._unit_id:
            return modbus_server.Answer(modbus_server.exception_pdu(pdu, _GATEWAY_NO_RESPONSE))
        faults = self.faults
        if faults.hang_up:
            return modbus_server.Answer(hang_up=True)
        if faults.exception_code:
            return modbus_server.Answer(modbus_server.exception_pdu(pdu, faults.exception_code), faults.delay_s)
        self.state.map_version = faults.map_version or self._registers.map_version
        self._advance()
        reply = modbus_server.respond(pdu, self.state)
        self._actuate()
        if faults.silent:
            return modbus_server.Answer()
        if faults.short_reply and reply[0] == 3:
            reply = bytes([3, reply[1] - 2]) + reply[2:-2]
        if faults.wrong_function:
            reply = bytes([{3: 23, 16: 6}.get(reply[0], reply[0])]) + reply[1:]
        return modbus_server.Answer(reply, faults.delay_s, transaction_offset=int(faults.wrong_transaction))
