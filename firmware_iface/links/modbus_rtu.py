"""Modbus RTU with checked answers: several devices on one serial bus, each with the interface of
the TCP link.

RTU has no transaction numbers. `exchange` prevents a late answer from being taken for the next one;
the fence is "return query data" (function 8, sub-function 0) with a number that counts up: it comes
back as sent, or as an exception of function 8, and neither can be taken for anything else.

Source: Modbus over serial line 1.02, sections 2.5.1 (RTU framing) and 6.2.2 (CRC); application
protocol 1.1b3.
"""

import struct
from collections.abc import Sequence
from functools import cache
from urllib.parse import parse_qsl, urlsplit

from firmware_iface.links import exchange, modbus_link, modbus_tcp, serial_port
from firmware_iface.roles import LinkError

DEFAULT_PORT = 502  # of Modbus TCP
DEFAULT_BAUD = 19_200  # section 2.5.1: the default of the standard
_FAST_BAUD = 19_200
_FAST_GAP_S = 1.75e-3  # above 19200 baud the standard fixes the silence between frames
_EXCEPTION_BYTES, _WRITE_BYTES = 5, 8
_READS_REGISTERS = (modbus_link.READ_HOLDING, modbus_link.READ_INPUT)
_READS_BITS = (modbus_link.READ_COILS, modbus_link.READ_DISCRETE)
_TOKENS = 2**16


def compute_crc16(data: bytes) -> int:
    """The CRC of Modbus: polynomial 0xA001 (reflected 0x8005), start 0xFFFF;
    sent low byte first.
    """
    table = _make_crc_table()
    crc = 0xFFFF
    for byte in data:
        crc = (crc >> 8) ^ table[(crc ^ byte) & 0xFF]
    return crc


@cache
def _make_crc_table() -> tuple[int, ...]:
    """Return the CRC of each byte alone, so that a frame needs one step a byte."""
    return tuple(_make_crc_entry(index) for index in range(256))


def _make_crc_entry(index: int) -> int:
    for _ in range(8):
        lowest_bit = index & 1
        index >>= 1
        if lowest_bit:
            index ^= 0xA001
    return index


def rtu_frame(unit_id: int, pdu: bytes) -> bytes:
    """A frame as sent: unit, PDU and CRC.

    Parameters
    ----------
    unit_id : int
        Address of the device on its bus, 1..247 (0 is a broadcast, which no device answers).
    pdu : bytes
        Function code and its data, at most 253 bytes.
    """
    body = bytes([unit_id]) + pdu
    return body + struct.pack("<H", compute_crc16(body))


def parse_rtu_url(url: str) -> tuple[str, serial_port.SerialSettings]:
    """Port and settings of `rtu://PORT[?baud=..&parity=..&data_bits=..&stop_bits=..]`.

    PORT is a path (`rtu:///dev/ttyUSB0`) or a USB identity (`rtu://usb:0403:6001:A50285BI`). Raises
    ValueError.
    """
    parts = urlsplit(url)
    options = {}
    if parts.query:
        options = dict(parse_qsl(parts.query, strict_parsing=True))
    # A path stands after three slashes, a USB identity where other URLs have the host.
    port = parts.netloc + parts.path
    if (
        parts.scheme != "rtu"
        or not port
        or not options.keys() <= {"baud", "parity", "data_bits", "stop_bits"}
    ):
        raise ValueError(f"{url}: expected rtu:///dev/ttyUSB0?baud=19200&parity=E")
    try:
        numbers = {key: int(value) for key, value in options.items() if key != "parity"}
    except ValueError as error:
        raise ValueError(f"{url}: {error}") from error
    numbers.setdefault("baud", DEFAULT_BAUD)
    return port, serial_port.SerialSettings(**numbers, parity=options.get("parity", "E"))


class RtuBus:
    """A serial bus with any number of Modbus devices, served in turn.

    Parameters
    ----------
    port : SerialPort
        The line.
    quiet_s : float
        Silence after a loss: the usual upper limit of late answers.
    """

    def __init__(self, port: serial_port.SerialPort, quiet_s: float = 0.2) -> None:
        # Frames end with a silence of 3.5 characters (section 2.5.1.1).
        baud = port.settings.baud
        if baud > _FAST_BAUD:
            gap_s = _FAST_GAP_S
        else:
            gap_s = 3.5 * port.settings.char_s
        self.exchange = exchange.SerialExchange(port, gap_s, quiet_s)
        self._tokens = 0

    @classmethod
    def from_url(cls, url: str) -> "RtuBus":
        """The bus at `rtu://...`. Raises ValueError."""
        port, settings = parse_rtu_url(url)
        return cls(serial_port.SerialPort(port, settings))

    def device(self, unit_id: int, timeout_s: float, fence: bool = True) -> "GuardedModbusRtu":
        """Return the device with a unit id on this bus.

        Parameters
        ----------
        unit_id : int
            From 1 to 247.
        timeout_s : float
            Of one exchange.
        fence : bool
            See `links.exchange`.

        Raises
        ------
        ValueError
            The unit id is none.
        """
        return GuardedModbusRtu(self, unit_id, timeout_s, fence)

    def find_token(self) -> int:
        """A number not used by recent fences."""
        self._tokens = (self._tokens + 1) % _TOKENS
        return self._tokens


class GuardedModbusRtu:
    """One Modbus RTU device of a bus: the first to connect opens the bus, any of them closes it for
    all.

    Parameters
    ----------
    bus : RtuBus
        Shared with the other devices of the line.
    unit_id : int
        From 1 to 247.
    timeout_s : float
        Of the device; the time on the wire is added.
    fence : bool
        False for a device that ignores function 8 instead of answering or refusing it.

    Raises
    ------
    ValueError
        The unit id is none.
    """

    def __init__(self, bus: RtuBus, unit_id: int, timeout_s: float, fence: bool = True) -> None:
        if not 1 <= unit_id <= 247:
            raise ValueError(f"unit_id = {unit_id}: Modbus RTU has 1..247")
        self._bus = bus
        self._unit_id = unit_id
        self._timeout_s = timeout_s
        self._fence = fence

    @property
    def name(self) -> str:
        """For messages."""
        return f"rtu://{self._bus.exchange.port.name}#{self._unit_id}"

    @property
    def connected(self) -> bool:
        """Whether the bus is open."""
        return self._bus.exchange.port.is_open

    async def connect(self) -> None:
        """Open the bus, if no other of its devices has. Raises LinkDownError."""
        if not self.connected:
            self._bus.exchange.connect()

    async def close(self) -> None:
        """Close the bus for all its devices; a request in flight fails at once."""
        await self._bus.exchange.close()

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
            The port is gone.
        DeviceRefusedError
            The device does not have these registers.
        """
        return await self._read(modbus_link.READ_HOLDING, address, count)

    async def read_input(self, address: int, count: int) -> list[int]:
        """Read input registers (function code 4). Raises as `read_holding`.

        Parameters
        ----------
        address : int
            First register on the wire, from 0.
        count : int
            Registers, 1..125.
        """
        return await self._read(modbus_link.READ_INPUT, address, count)

    async def read_coils(self, address: int, count: int) -> list[bool]:
        """Read coils (function code 1). Raises as `read_holding`.

        Parameters
        ----------
        address : int
            First coil on the wire, from 0.
        count : int
            Coils, 1..2000.
        """
        return await self._read_bits(modbus_link.READ_COILS, address, count)

    async def read_discrete(self, address: int, count: int) -> list[bool]:
        """Read discrete inputs (function code 2). Raises as `read_holding`.

        Parameters
        ----------
        address : int
            First input on the wire, from 0.
        count : int
            Inputs, 1..2000.
        """
        return await self._read_bits(modbus_link.READ_DISCRETE, address, count)

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
        pdu = struct.pack(">BHH", modbus_link.WRITE_SINGLE, address, word)
        if (await self._transact(pdu, _WRITE_BYTES, what, repeats=True)) != pdu:
            raise LinkError(f"{what}: the reply confirms another write")

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
            No valid reply in time: the device may or may not have executed it.
        LinkDownError
            The port is gone; the same holds.
        DeviceRefusedError
            The device refused and changed nothing.
        """
        what = f"{self.name}: writing {address}..{address + len(words) - 1}"
        pdu = struct.pack(
            f">BHHB{len(words)}H",
            modbus_link.WRITE_MULTIPLE,
            address,
            len(words),
            2 * len(words),
            *words,
        )
        reply = await self._transact(pdu, _WRITE_BYTES, what)
        if reply != pdu[:5]:
            raise LinkError(f"{what}: the reply confirms another write")

    async def _read(self, function_code: int, address: int, count: int) -> list[int]:
        what = f"{self.name}: reading {address}..{address + count - 1}"
        request = struct.pack(">BHH", function_code, address, count)
        reply_bytes = 5 + 2 * count
        reply = await self._transact(request, reply_bytes, what)
        return list(struct.unpack(f">{count}H", reply[2:]))

    async def _read_bits(self, function_code: int, address: int, count: int) -> list[bool]:
        what = f"{self.name}: reading bits {address}..{address + count - 1}"
        answer_bytes = 5 + modbus_link.bytes_of_bits(count)
        reply = await self._transact(
            struct.pack(">BHH", function_code, address, count), answer_bytes, what
        )
        # the first coil is the lowest bit of the first byte
        packed = int.from_bytes(reply[2:], "little")
        return [bool(packed >> place & 1) for place in range(count)]

    async def _transact(
        self, pdu: bytes, answer_bytes: int, what: str, repeats: bool = False
    ) -> bytes:
        question = self._make_question(pdu, answer_bytes, what, repeats=repeats)
        reply = await self._bus.exchange.ask(
            question, self._timeout_s, self._fence_question(), self._unit_id
        )
        if reply[0] & modbus_link.EXCEPTION_FLAG:
            raise modbus_link.exception_error(what, reply[1])
        return reply

    def _fence_question(self) -> exchange.WireQuestion | None:
        if not self._fence:
            return None
        pdu = struct.pack(">BHH", modbus_link.DIAGNOSTICS, 0, self._bus.find_token())
        return self._make_question(
            pdu,
            _WRITE_BYTES,
            f"{self.name}: echo test after a loss (function 8)",
            pdu,
            repeats=True,
        )

    def _make_question(
        self,
        pdu: bytes,
        answer_bytes: int,
        what: str,
        exactly: bytes = b"",
        repeats: bool = False,
    ) -> exchange.WireQuestion:
        def extract_answer(received_bytes: bytes) -> bytes | None:
            reply = extract_reply(received_bytes, self._unit_id, pdu[0], answer_bytes, what)
            # The fence must come back as sent: an echo with another number answers an earlier one.
            if (
                exactly
                and reply is not None
                and reply != exactly
                and not reply[0] & modbus_link.EXCEPTION_FLAG
            ):
                raise LinkError(f"{what}: the echo differs from what was sent")
            return reply

        reads = pdu[0] in _READS_REGISTERS + _READS_BITS
        frame = rtu_frame(self._unit_id, pdu)
        return exchange.WireQuestion(frame, extract_answer, answer_bytes, what, repeats, reads)


class ModbusLinks:
    """Makes links; one per bench, because a serial bus has one owner."""

    def __init__(self) -> None:
        self._buses: dict[str, RtuBus] = {}

    def link(
        self, url: str, unit_id: int, timeout_s: float, fence: bool = True
    ) -> modbus_link.AnyModbusLink:
        """Return the link to a device, not yet connected.

        Parameters
        ----------
        url : str
            `tcp://HOST[:PORT]` or `rtu://PORT[?baud=..&parity=..]`; devices of one serial port
            share its bus.
        unit_id : int
            Modbus unit.
        timeout_s : float
            Of one exchange.
        fence : bool
            See `links.exchange`; TCP does not use it.

        Raises
        ------
        ValueError
            The URL is neither.
        """
        if not url.startswith("rtu:"):
            host, port = parse_tcp_url(url)
            return modbus_tcp.GuardedModbusTcp(host, port, unit_id, timeout_s)
        if url not in self._buses:
            self._buses[url] = RtuBus.from_url(url)
        return self._buses[url].device(unit_id, timeout_s, fence)


def parse_tcp_url(url: str) -> tuple[str, int]:
    """Host and port of `tcp://HOST[:PORT]`. Raises ValueError."""
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError as error:  # a port that is no number, or above 65535
        raise ValueError(f"{url}: {error}") from error
    if (
        parts.scheme != "tcp"
        or not host
        or parts.path
        or parts.query
        or parts.fragment
        or parts.username
    ):
        raise ValueError(f"{url}: expected tcp://HOST:PORT")
    return host, DEFAULT_PORT if port is None else port


def extract_reply(
    received_bytes: bytes, unit_id: int, function_code: int, answer_bytes: int, what: str
) -> bytes | None:
    """Return the PDU of a whole reply; None while bytes are missing.

    The length is known beforehand: silences between bytes, by which RTU frames are delimited on the
    wire, do not survive the buffers of adapters and kernels.

    Parameters
    ----------
    received_bytes : bytes
        So far; at least one.
    unit_id, function_code : int
        Of the request.
    answer_bytes : int
        Length of the answer to the request, with unit and CRC.
    what : str
        The request, for messages.

    Raises
    ------
    LinkError
        Another unit, function, length or CRC.
    """
    if received_bytes[0] != unit_id:
        raise LinkError(f"{what}: answer from unit {received_bytes[0]}, expected unit {unit_id}")
    if len(received_bytes) < 3:
        return None
    # An exception has a length of its own
    if received_bytes[1] == function_code | modbus_link.EXCEPTION_FLAG:
        length = _EXCEPTION_BYTES
    elif received_bytes[1] == function_code:
        length = answer_bytes
    else:
        raise LinkError(
            f"{what}: answer has function code {received_bytes[1]}, expected {function_code}"
        )
    # The device counts its bytes of data: they must be as many as were requested
    data_bytes = answer_bytes - 5
    if (
        length == answer_bytes
        and function_code in _READS_REGISTERS
        and received_bytes[2] != data_bytes
    ):
        raise LinkError(
            f"{what}: {received_bytes[2] / 2:g} registers instead of {data_bytes // 2}; "
            f"{modbus_link.SHORT_REPLY}"
        )
    if length == answer_bytes and function_code in _READS_BITS and received_bytes[2] != data_bytes:
        raise LinkError(f"{what}: {received_bytes[2]} bytes of bits instead of {data_bytes}")
    if len(received_bytes) < length:
        return None
    if len(received_bytes) > length:
        raise LinkError(f"{what}: {len(received_bytes)} bytes instead of {length}")
    if compute_crc16(received_bytes):  # over a frame with its own CRC the sum is 0
        raise LinkError(f"{what}: wrong checksum; noise on the line, or wrong baud rate")
    return received_bytes[1:-2]
