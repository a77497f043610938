"""Modbus TCP with checks and prompt errors that the library's client lacks.

It closes these gaps of pymodbus 3.16: a reply with too few registers, of another function or with
transaction id 0 is accepted; a connection lost in mid-request waits for the full timeout; a retry
repeats a write; a server that accepts and hangs up is called ten times a second.
"""

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Sequence

from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ConnectionException, ModbusIOException
from pymodbus.pdu import ExceptionResponse, ModbusPDU

from firmware_iface.links import serial_port
from firmware_iface.links.late_answers import LateAnswers
from firmware_iface.links.modbus_link import (
    READ_COILS,
    READ_DISCRETE,
    READ_HOLDING,
    READ_INPUT,
    SHORT_REPLY,
    WRITE_MULTIPLE,
    WRITE_SINGLE,
    bytes_of_bits,
    exception_error,
)
from firmware_iface.roles import (
    Clock,
    LinkDownError,
    LinkError,
    LinkWaitsError,
)

# the library also logs what it raises; without a handler that would go to the console
logging.getLogger("pymodbus").addHandler(logging.NullHandler())

# a peer that lost its power does not close the connection: after this many unanswered requests in a
# row, and one more that finds the count exhausted, the connection is abandoned (the count is the
# library's)
_UNANSWERED_MAX = 3
# Bytes from the device for one request: a reply has 260 at most, and late ones of earlier requests
# may precede it. A peer that sends without end would keep the library, and so the control process,
# busy for seconds.
_REPLY_BYTES_MAX = 1024
_REMEMBERED_REQUESTS = 16


class GuardedModbusTcp:
    """One Modbus TCP device.

    One request is in flight at a time. After its caller is cancelled, a sent request still runs to
    its reply or timeout, so that nothing is abandoned on the wire. Nothing is sent twice or
    reconnects automatically: the owner calls `connect`, which refuses to try before its back-off
    (0.1 s, doubling to 5 s, until the device can be read) is over.

    Parameters
    ----------
    host, port : str, int
        Of the device or its gateway.
    unit_id : int
        Modbus unit behind the address.
    timeout_s : float
        For connecting, and for each reply.
    clock : callable
        Monotonic time of back-off and late replies, s.
    """

    def __init__(
        self, host: str, port: int, unit_id: int, timeout_s: float, clock: Clock = time.monotonic
    ) -> None:
        self._host = host
        self._port = port
        self._unit_id = unit_id
        self._timeout_s = timeout_s
        self._clock = clock
        self._client: AsyncModbusTcpClient | None = None
        # released when the request ends, whatever happens to its caller
        self._turn = asyncio.Lock()
        self._in_flight: asyncio.Task[ModbusPDU] | None = None
        self._back_off = serial_port.BackOff()
        self._received_bytes = 0  # since the last request was sent
        self._request_times_s: dict[int, float] = {}  # the newest requests, by transaction number
        self._late = LateAnswers()

    @property
    def name(self) -> str:
        """For messages."""
        return f"tcp://{self._host}:{self._port}"

    @property
    def connected(self) -> bool:
        """Whether the connection is up."""
        return self._client is not None and self._client.connected

    @property
    def retry_in_s(self) -> float:
        """Time until `connect` will try."""
        return self._back_off.remaining_s(self._clock())

    async def connect(self) -> None:
        """Connect again. Raises LinkDownError (no connection, or not yet time for the next
        attempt).
        """
        if (wait_s := self.retry_in_s) > 0:
            raise LinkWaitsError(f"{self.name}: next attempt to connect in {wait_s:.1f} s")
        await self.close()
        self._back_off.attempted(self._clock())
        self._request_times_s.clear()

        def changed(connected: bool) -> None:
            if not connected:
                _fail_in_flight(client, f"{self.name}: connection lost")

        # The library must neither repeat a request nor connect by itself: a repeated write could
        # move gas twice.
        client = AsyncModbusTcpClient(
            self._host,
            port=self._port,
            timeout=self._timeout_s,
            retries=0,
            reconnect_delay=0,
            trace_connect=changed,
        )
        client.set_max_no_responses(_UNANSWERED_MAX)
        if not await client.connect():
            client.close()
            raise LinkDownError(
                f"{self.name}: no connection; is the device on, and is this its address?"
            )
        self._client = client
        self._bound_replies(client)

    def _bound_replies(self, client: AsyncModbusTcpClient) -> None:
        """Give up the connection to a peer that sends more than a device does, before the library
        reads it. Measure how late its replies are.
        """
        # The library calls `data_received` with the bytes of each segment: this stands in front of
        # it. A frame begins with its transaction number (16 bit, big end first), and a reply of a
        # device usually arrives as one segment.
        read = client.ctx.data_received
        self._received_bytes = 0

        def read_if_bounded(data: bytes) -> None:
            self._received_bytes += len(data)
            self._note_reply(int.from_bytes(data[:2], "big"), client.ctx.request_transaction_id)
            if self._received_bytes <= _REPLY_BYTES_MAX:
                read(data)
                return
            _fail_in_flight(client, f"{self.name}: sends more than an answer; connection given up")
            client.close()

        client.ctx.data_received = read_if_bounded  # type: ignore[method-assign]

    def _note_request(self, transaction: int) -> None:
        """Remember when a request is sent, to recognise its reply if that comes late."""
        self._late.note_question()
        self._request_times_s[transaction] = self._clock()
        while len(self._request_times_s) > _REMEMBERED_REQUESTS:
            del self._request_times_s[next(iter(self._request_times_s))]

    def _note_reply(self, transaction: int, newest: int) -> None:
        """Measure how late a reply comes after its time-out; `newest` is the present request."""
        request_s = self._request_times_s.pop(transaction, None)
        if request_s is None:
            return
        if transaction == newest:
            self._late.note_in_time()
        else:
            self._late.note_late(self._clock() - request_s)

    async def read_holding(self, address: int, count: int) -> list[int]:
        """Read holding registers (function code 3).

        Parameters
        ----------
        address : int
            First register on the wire, from 0.
        count : int
            Registers, 1..125.

        Returns
        -------
        list of int
            `count` words, unsigned 16 bit.

        Raises
        ------
        LinkError
            No valid reply in time.
        LinkDownError
            The connection is gone.
        DeviceRefusedError
            The device does not have these registers.
        """
        return await self._read(READ_HOLDING, address, count)

    async def read_input(self, address: int, count: int) -> list[int]:
        """Read input registers (function code 4). Raises as `read_holding`.

        Parameters
        ----------
        address : int
            First register on the wire, from 0.
        count : int
            Registers, 1..125.
        """
        return await self._read(READ_INPUT, address, count)

    async def read_coils(self, address: int, count: int) -> list[bool]:
        """Read coils (function code 1). Raises as `read_holding`.

        Parameters
        ----------
        address : int
            First coil on the wire, from 0.
        count : int
            Coils, 1..2000.
        """
        return await self._read_bits(READ_COILS, address, count)

    async def read_discrete(self, address: int, count: int) -> list[bool]:
        """Read discrete inputs (function code 2). Raises as `read_holding`.

        Parameters
        ----------
        address : int
            First input on the wire, from 0.
        count : int
            Inputs, 1..2000.
        """
        return await self._read_bits(READ_DISCRETE, address, count)

    async def write_register(self, address: int, word: int) -> None:
        """Write one holding register (function code 6) and check the echo. Raises as
        `write_registers`.

        Parameters
        ----------
        address : int
            The register on the wire, from 0.
        word : int
            Unsigned 16 bit.
        """
        what = f"{self.name}: writing {address}"
        reply = await self._exchange_pdu(
            lambda client: client.write_register(address, word, device_id=self._unit_id),
            WRITE_SINGLE,
            what,
        )
        if (reply.address, list(reply.registers)) != (address, [word]):
            raise LinkError(
                f"{what}: the reply confirms {list(reply.registers)} in {reply.address}"
            )

    async def write_registers(self, address: int, words: Sequence[int]) -> None:
        """Write holding registers (function code 16) and check the echo.

        Parameters
        ----------
        address : int
            First register on the wire, from 0.
        words : sequence of int
            1..123 words, unsigned 16 bit.

        Raises
        ------
        LinkError
            No valid reply in time: the device may or may not have carried it out.
        LinkDownError
            The connection is gone; the same holds.
        DeviceRefusedError
            The device refused and changed nothing.
        """
        what = f"{self.name}: writing {address}..{address + len(words) - 1}"
        reply = await self._exchange_pdu(
            lambda client: client.write_registers(address, list(words), device_id=self._unit_id),
            WRITE_MULTIPLE,
            what,
        )
        if (reply.address, reply.count) != (address, len(words)):
            raise LinkError(
                f"{what}: the reply confirms {reply.count} registers from {reply.address}"
            )

    async def _read(self, function_code: int, address: int, count: int) -> list[int]:
        what = f"{self.name}: reading {address}..{address + count - 1}"

        def send(client: AsyncModbusTcpClient) -> Awaitable[ModbusPDU]:
            if function_code == READ_INPUT:
                read = client.read_input_registers
            else:
                read = client.read_holding_registers
            return read(address, count=count, device_id=self._unit_id)

        reply = await self._exchange_pdu(send, function_code, what)
        if len(reply.registers) != count:
            raise LinkError(
                f"{what}: {len(reply.registers)} registers instead of {count}; {SHORT_REPLY}"
            )
        self._back_off.succeeded(self._clock())
        return list(reply.registers)

    async def _read_bits(self, function_code: int, address: int, count: int) -> list[bool]:
        what = f"{self.name}: reading bits {address}..{address + count - 1}"

        def send(client: AsyncModbusTcpClient) -> Awaitable[ModbusPDU]:
            if function_code == READ_DISCRETE:
                read = client.read_discrete_inputs
            else:
                read = client.read_coils
            return read(address, count=count, device_id=self._unit_id)

        reply = await self._exchange_pdu(send, function_code, what)
        # the library gives all bits of the bytes that came
        if len(reply.bits) != 8 * bytes_of_bits(count):
            raise LinkError(
                f"{what}: {len(reply.bits)} bits in the reply, expected {8 * bytes_of_bits(count)}"
            )
        self._back_off.succeeded(self._clock())
        return [bool(bit) for bit in reply.bits[:count]]

    async def close(self) -> None:
        """Close the connection; a request in flight fails at once."""
        if self._client is None:
            return
        self._client.close()
        _fail_in_flight(self._client, f"{self.name}: closed")
        self._client = None
        if self._in_flight is not None:
            await asyncio.wait([self._in_flight])

    async def _exchange_pdu(
        self,
        send: Callable[[AsyncModbusTcpClient], Awaitable[ModbusPDU]],
        function_code: int,
        what: str,
    ) -> ModbusPDU:
        # The turn belongs to the request, not to its caller: the task runs to its end and releases
        # it, while `shield` lets a cancelled caller go at once.
        await self._turn.acquire()  # cancelled while waiting here, a request is never sent
        self._in_flight = asyncio.create_task(self._transact(send, function_code, what))
        self._in_flight.add_done_callback(self._release_turn)
        return await asyncio.shield(self._in_flight)

    def _release_turn(self, task: asyncio.Task[ModbusPDU]) -> None:
        self._turn.release()
        if not task.cancelled():
            task.exception()  # after a cancelled caller no other task retrieves it

    async def _transact(
        self,
        send: Callable[[AsyncModbusTcpClient], Awaitable[ModbusPDU]],
        function_code: int,
        what: str,
    ) -> ModbusPDU:
        client = self._client
        if client is None or not client.connected:
            raise LinkDownError(f"{what}: not connected")
        # The bytes received for this request are bounded, and its transaction number is noted, so
        # that a late answer is recognised
        self._received_bytes = 0
        self._note_request(client.ctx.next_tid + 1)
        try:
            reply = await send(client)
        except ConnectionException as error:
            raise LinkDownError(f"{what}: not connected") from error
        except ModbusIOException as error:
            slow = self._late.explain()
            if slow:
                slow = f"; {slow}"
            # The library itself closes a connection after `_UNANSWERED_MAX` requests.
            if not client.connected:
                raise LinkDownError(
                    f"{what}: connection given up, no answer to several requests{slow}"
                ) from error
            raise LinkError(
                f"{what}: no valid answer within {self._timeout_s:g} s{slow}"
            ) from error
        _check_reply(reply, function_code, client.ctx.request_transaction_id, what)
        return reply


def _check_reply(reply: ModbusPDU, function_code: int, transaction_id: int, what: str) -> None:
    """Require that this is the answer to that request; raises LinkError or DeviceRefusedError."""
    if reply.transaction_id != transaction_id:
        raise LinkError(
            f"{what}: answer to transaction {reply.transaction_id}, expected {transaction_id}"
        )
    if reply.function_code & 0x7F != function_code:
        raise LinkError(
            f"{what}: answer has function code {reply.function_code}, expected {function_code}"
        )
    if isinstance(reply, ExceptionResponse):
        raise exception_error(what, reply.exception_code)


def _fail_in_flight(client: AsyncModbusTcpClient, message: str) -> None:
    """End the wait for a reply that can no longer come."""
    waiting = client.ctx.response_future  # initially a future that no task awaits
    if not waiting.done() and client.ctx.request_transaction_id:
        waiting.set_exception(LinkDownError(message))
