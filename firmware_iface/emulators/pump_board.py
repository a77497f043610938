"""The membrane pump board as a Modbus TCP device over any plant."""

import asyncio
from collections.abc import Callable
from typing import Protocol

from firmware_iface.emulators import board_state, modbus_server
from firmware_iface.register_map import RegisterMap, default_map

_PERIOD_S = 0.01  # the board's own loop; the pump is off at most this and one wake-up after the watchdog period
_GATEWAY_NO_RESPONSE = 11


class BoardPlant(Protocol):
    """The plant on the board's wires."""

    def sample(self) -> board_state.BoardSample:
        """The newest sample of the sensors; called every 10 ms and at every request."""

    def actuate(self, pump_fraction: float, vent_fraction: float) -> None:
        """Drive pump and vent, both 0..1; called when one of them changes."""


class PumpBoardEmulator:
    """Serves `plant` on Modbus TCP, from the event loop's thread.

    Port 0 takes any free one (see `port` after `start`). The watchdog runs on `clock`, by default the event loop's.
    Requests to other units get exception 11, as from a gateway. `registers` may be those of an earlier map version.
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
        self._plant = plant
        self._clock = clock or (lambda: asyncio.get_running_loop().time())
        self._unit_id = unit_id
        self._sample = plant.sample()
        self.state = board_state.BoardState(registers or default_map(), self._sample)
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
        self._sample = self.newest()
        self.state.advance(self._clock(), self._sample)
        self._actuate()

    def newest(self) -> board_state.BoardSample:
        """The sample of the sensors now."""
        return self._plant.sample()

    def _actuate(self) -> None:
        outputs = (self.state.pump_fraction, self.state.vent_fraction)
        if outputs != self._actuated:
            self._actuated = outputs
            self._plant.actuate(*outputs)

    def _handle(self, unit: int, pdu: bytes) -> modbus_server.Answer:
        if unit != self._unit_id:
            return modbus_server.Answer(modbus_server.exception_pdu(pdu, _GATEWAY_NO_RESPONSE))
        return self.answer(pdu)

    def answer(self, pdu: bytes) -> modbus_server.Answer:
        """Carry out a request."""
        self._advance()
        reply = modbus_server.respond(pdu, self.state)
        self._actuate()
        return modbus_server.Answer(reply)
