"""The guarded link against servers whose answers are wrong, late, incomplete or missing."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import AsyncIterator, Callable

import pytest
from counting_plant import ManualClock

from firmware_iface.emulators.modbus_server import Answer, ModbusTcpServer
from firmware_iface.links.late_answers import LateAnswers
from firmware_iface.links.modbus_tcp import GuardedModbusTcp
from firmware_iface.links.serial_port import FIRST_S, LONGEST_S, PROVEN_S, BackOff
from firmware_iface.roles import DeviceRefusedError, LinkDownError, LinkError

NEVER_S = 30.0  # a timeout that no test waits for
SOON_S = 0.3  # one that a test waits for; a busy machine connects and answers within it
GUARD_S = 5.0


class ScriptedServer(asyncio.Protocol):
    """Answers each request with whatever bytes `reply` makes of its transaction id,
    unit and PDU.
    """

    def __init__(self, reply: Callable[[int, int, bytes], list[bytes]]) -> None:
        self.reply = reply
        self.accepted = 0
        self.requests: list[bytes] = []
        self.asked = asyncio.Event()
        self.transports: list[asyncio.Transport] = []

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self.transports.append(transport)
        self.accepted += 1

    def data_received(self, data: bytes) -> None:
        transaction, _, _, unit = struct.unpack_from(">HHHB", data)
        self.requests.append(data)
        self.asked.set()
        for piece in self.reply(transaction, unit, data[7:]):
            self.transports[-1].write(piece)


def frame(transaction: int, unit: int, pdu: bytes) -> bytes:
    return struct.pack(">HHHB", transaction, 0, len(pdu) + 1, unit) + pdu


class Setup:
    """A scripted server and a link to it."""

    def __init__(self, server: ScriptedServer, port: int) -> None:
        self.server = server
        self.port = port
        self.clock = ManualClock()
        self.links: list[GuardedModbusTcp] = []

    def link(self, timeout_s: float = NEVER_S) -> GuardedModbusTcp:
        self.links.append(GuardedModbusTcp("127.0.0.1", self.port, 1, timeout_s, self.clock))
        return self.links[-1]

    async def connected(self, timeout_s: float = NEVER_S) -> GuardedModbusTcp:
        link = self.link(timeout_s)
        await link.connect()
        return link


@pytest.fixture
async def setup() -> AsyncIterator[Setup]:
    server = ScriptedServer(lambda transaction, unit, pdu: [])
    listening = await asyncio.get_running_loop().create_server(lambda: server, "127.0.0.1", 0)
    made = Setup(server, listening.sockets[0].getsockname()[1])
    yield made
    listening.close()
    for link in made.links:
        await link.close()
    for transport in server.transports:
        transport.abort()
    await listening.wait_closed()
    await asyncio.sleep(0)


def good_read(words: list[int]) -> bytes:
    return struct.pack(f">BB{len(words)}H", 3, 2 * len(words), *words)


async def test_a_right_answer_is_taken(setup: Setup) -> None:
    setup.server.reply = lambda transaction, unit, pdu: [
        frame(transaction, unit, good_read([5, 65_535]))
    ]
    link = await setup.connected()
    assert await link.read_holding(3, 2) == [5, 65_535]
    assert setup.server.requests[0][7:] == struct.pack(">BHH", 3, 3, 2)


async def test_an_answer_in_pieces_is_taken(setup: Setup) -> None:
    def halves(transaction: int, unit: int, pdu: bytes) -> list[bytes]:
        whole = frame(transaction, unit, good_read([1, 2]))
        return [whole[:5], whole[5:9], whole[9:]]

    setup.server.reply = halves
    link = await setup.connected()
    assert await link.read_holding(0, 2) == [1, 2]


@pytest.mark.parametrize(
    ("pdu", "message"),
    [
        (good_read([1]), "1 registers instead of 2"),
        (good_read([1, 2, 3]), "3 registers instead of 2"),
        (bytes([23, 4, 0, 1, 0, 2]), "function code 23"),
        (struct.pack(">BHH", 16, 0, 2), "function code 16"),
        (bytes([0x90, 2]), "function code 144"),
        (bytes([0x83, 6]), r"exception 6 \(device busy\)"),
        (bytes([0x83, 99]), r"exception 99 \(unknown\)"),
    ],
)
async def test_a_wrong_answer_to_a_read_is_an_error(setup: Setup, pdu: bytes, message: str) -> None:
    setup.server.reply = lambda transaction, unit, _: [frame(transaction, unit, pdu)]
    link = await setup.connected()
    with pytest.raises(LinkError, match=message):
        await link.read_holding(0, 2)
    assert link.connected


@pytest.mark.parametrize(
    ("pdu", "message"),
    [
        (struct.pack(">BHH", 16, 5, 1), "confirms 1 registers from 5"),
        (struct.pack(">BHH", 16, 4, 2), "confirms 2 registers from 4"),
        (struct.pack(">BHH", 6, 5, 2), "function code 6"),
    ],
)
async def test_a_wrong_echo_of_a_write_is_an_error(setup: Setup, pdu: bytes, message: str) -> None:
    setup.server.reply = lambda transaction, unit, _: [frame(transaction, unit, pdu)]
    link = await setup.connected()
    with pytest.raises(LinkError, match=message):
        await link.write_registers(5, [1, 2])


@pytest.mark.parametrize("code", [1, 2, 3])
async def test_a_refusal_has_its_own_type(setup: Setup, code: int) -> None:
    setup.server.reply = lambda transaction, unit, pdu: [
        frame(transaction, unit, bytes([pdu[0] | 0x80, code]))
    ]
    link = await setup.connected()
    with pytest.raises(DeviceRefusedError, match=f"writing 5..6: exception {code}"):
        await link.write_registers(5, [1, 2])


async def test_transaction_0_is_not_an_answer(setup: Setup) -> None:
    setup.server.reply = lambda transaction, unit, pdu: [frame(0, unit, good_read([1, 2]))]
    link = await setup.connected()
    with pytest.raises(LinkError, match="answer to transaction 0"):
        await link.read_holding(0, 2)


async def test_answers_of_other_transactions_and_units_are_passed_over(setup: Setup) -> None:
    setup.server.reply = lambda transaction, unit, pdu: [
        frame(transaction + 1, unit, good_read([8, 8]))
        + frame(transaction, unit + 1, good_read([9, 9])),
        frame(transaction, unit, good_read([1, 2])),
    ]
    link = await setup.connected()
    assert await link.read_holding(0, 2) == [1, 2]


async def test_a_late_answer_is_not_the_next_one(setup: Setup) -> None:
    held: list[bytes] = []

    def hold_first(transaction: int, unit: int, pdu: bytes) -> list[bytes]:
        reply = frame(transaction, unit, good_read([transaction]))
        if not held:
            held.append(reply)
            return []
        return [held[0], reply]

    setup.server.reply = hold_first
    link = await setup.connected(timeout_s=SOON_S)
    with pytest.raises(LinkError, match=r"no valid answer within 0.3 s"):
        await link.read_holding(0, 1)
    assert await link.read_holding(0, 1) == [2]


async def test_garbage_is_never_a_value(setup: Setup) -> None:
    setup.server.reply = lambda transaction, unit, pdu: [b"\x00" * 3, bytes(range(40))]
    link = await setup.connected(timeout_s=SOON_S)
    with pytest.raises(LinkError):
        await link.read_holding(0, 2)


async def test_an_undecodable_answer_is_a_lost_link(setup: Setup) -> None:
    setup.server.reply = lambda transaction, unit, pdu: [
        frame(transaction, unit, bytes([3, 200, 1]))
    ]
    link = await setup.connected()
    asyncio.get_running_loop().set_exception_handler(
        lambda loop, context: None
    )  # asyncio reports what it cuts
    with pytest.raises(LinkDownError, match="connection lost"):
        async with asyncio.timeout(GUARD_S):
            await link.read_holding(0, 2)


async def test_a_link_killed_in_mid_request_fails_at_once(setup: Setup) -> None:
    link = await setup.connected()
    reading = asyncio.create_task(link.read_holding(0, 2))
    await setup.server.asked.wait()
    setup.server.transports[-1].abort()
    with pytest.raises(LinkDownError, match="connection lost"):
        async with asyncio.timeout(GUARD_S):
            await reading
    assert not link.connected
    with pytest.raises(LinkDownError, match="not connected"):
        await link.write_registers(0, [1])


async def test_closing_ends_a_request_at_once(setup: Setup) -> None:
    link = await setup.connected()
    reading = asyncio.create_task(link.read_holding(0, 2))
    await setup.server.asked.wait()
    await link.close()
    with pytest.raises(LinkDownError, match="closed"):
        async with asyncio.timeout(GUARD_S):
            await reading


async def test_one_request_at_a_time_and_none_sent_twice(setup: Setup) -> None:
    link = await setup.connected()
    tasks = [asyncio.create_task(link.read_holding(address, 1)) for address in range(3)]
    await setup.server.asked.wait()
    assert len(setup.server.requests) == 1
    setup.server.reply = lambda transaction, unit, pdu: [
        frame(transaction, unit, good_read([transaction]))
    ]
    first = setup.server.requests[0]
    setup.server.transports[-1].write(frame(first[1], 1, good_read([1])))
    assert await asyncio.gather(*tasks) == [[1], [2], [3]]
    assert len(setup.server.requests) == 3


async def test_a_cancelled_request_is_finished_before_the_next(setup: Setup) -> None:
    link = await setup.connected()
    cancelled = asyncio.create_task(link.read_holding(7, 1))
    await setup.server.asked.wait()
    cancelled.cancel()
    with pytest.raises(asyncio.CancelledError):
        await cancelled
    setup.server.asked.clear()
    following = asyncio.create_task(link.read_holding(8, 1))
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(setup.server.asked.wait(), 0.05)  # it is not sent yet
    setup.server.reply = lambda transaction, unit, pdu: [frame(transaction, unit, good_read([22]))]
    setup.server.transports[-1].write(frame(1, 1, good_read([11])))
    assert await following == [22]


async def test_a_request_cancelled_before_its_turn_is_never_sent(setup: Setup) -> None:
    link = await setup.connected()
    first = asyncio.create_task(link.read_holding(7, 1))
    await setup.server.asked.wait()
    waiting = asyncio.create_task(link.write_registers(8, [1]))
    await asyncio.sleep(0)
    waiting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await waiting
    setup.server.reply = lambda transaction, unit, pdu: [
        frame(transaction, unit, good_read([transaction]))
    ]
    setup.server.transports[-1].write(frame(1, 1, good_read([1])))
    assert await first == [1]
    assert await link.read_holding(9, 1) == [2]
    assert [request[7] for request in setup.server.requests] == [3, 3]


async def test_a_cancelled_request_leaves_nothing_behind_a_close(setup: Setup) -> None:
    link = await setup.connected()
    cancelled = asyncio.create_task(link.read_holding(7, 1))
    await setup.server.asked.wait()
    cancelled.cancel()
    await asyncio.wait([cancelled])
    await link.close()
    assert asyncio.all_tasks() == {asyncio.current_task()}


async def test_a_silent_peer_is_given_up_after_some_requests(setup: Setup) -> None:
    link = await setup.connected(timeout_s=SOON_S)
    outcomes = []
    while link.connected:
        with pytest.raises(LinkError) as raised:
            await link.read_holding(0, 1)
        outcomes.append(raised.type)
    assert outcomes == [LinkError] * 4 + [LinkDownError]
    assert len(setup.server.requests) == 5


async def test_nothing_listening_is_link_down(setup: Setup) -> None:
    unused = await asyncio.get_running_loop().create_server(asyncio.Protocol, "127.0.0.1", 0)
    setup.port = unused.sockets[0].getsockname()[1]
    unused.close()
    await unused.wait_closed()
    link = setup.link()
    with pytest.raises(LinkDownError, match="no connection"):
        await link.connect()
    with pytest.raises(LinkDownError, match=r"next attempt to connect in 0\.1 s"):
        await link.connect()


async def test_a_server_that_accepts_and_hangs_up_is_not_hammered(setup: Setup) -> None:
    def slam(transaction: int, unit: int, pdu: bytes) -> list[bytes]:
        setup.server.transports[-1].abort()
        return []

    setup.server.reply = slam
    link = setup.link()
    for _ in range(1000):  # ten seconds at 100 Hz
        try:
            await link.connect()
            await link.read_holding(0, 1)
        except LinkDownError:
            setup.clock.now_s += 0.01
    assert 6 <= setup.server.accepted <= 8  # at 0, 0.1, 0.3, 0.7, 1.5, 3.1, 6.3 s


async def test_a_valid_answer_ends_the_back_off(setup: Setup) -> None:
    setup.server.reply = lambda transaction, unit, pdu: [frame(transaction, unit, good_read([1]))]
    link = await setup.connected()
    assert link.retry_in_s == pytest.approx(FIRST_S)
    await link.read_holding(0, 1)
    assert link.retry_in_s == 0
    await link.connect()
    assert setup.server.accepted == 2


def test_back_off_doubles_up_to_its_longest() -> None:
    back_off = BackOff()
    waits = []
    for _ in range(8):
        back_off.attempted(100.0)
        waits.append(back_off.remaining_s(100.0))
    assert waits == pytest.approx([0.1, 0.2, 0.4, 0.8, 1.6, 3.2, LONGEST_S, LONGEST_S])
    assert back_off.remaining_s(100.0 + LONGEST_S) == 0


async def test_the_servers_wrong_transaction_ids_time_out(setup: Setup) -> None:
    server = ModbusTcpServer(
        lambda unit, pdu: Answer(good_read([1]), transaction_offset=1), "127.0.0.1", 0
    )
    await server.start()
    setup.port = server.port
    link = await setup.connected(timeout_s=SOON_S)
    with pytest.raises(LinkError, match="no valid answer"):
        await link.read_holding(0, 1)
    await link.close()
    await server.stop()


@pytest.mark.parametrize("data", [b"x" * 65536, b"\0" * 65536, b"\0\1\0\0\xff\xff" + b"\1" * 65530])
async def test_a_peer_that_sends_without_end_is_given_up_before_it_delays_the_process(
    setup: Setup, data: bytes
) -> None:
    setup.server.reply = lambda transaction, unit, pdu: [data] * 20
    link = await setup.connected(timeout_s=5.0)
    loop = asyncio.get_running_loop()
    began_s = loop.time()
    with pytest.raises(LinkDownError, match="sends more than an answer"):
        await link.read_holding(0, 2)
    assert loop.time() - began_s < 1.0
    assert not link.connected


async def test_short_replies_to_long_reads_do_not_let_the_link_be_hammered(setup: Setup) -> None:
    """A gateway with a small buffer: the identity can be read, the sensors cannot."""

    def cut(transaction: int, unit: int, pdu: bytes) -> list[bytes]:
        (count,) = struct.unpack_from(">H", pdu, 3)
        return [frame(transaction, unit, good_read([1] * min(count, 8)))]

    setup.server.reply = cut
    link = setup.link()
    for _ in range(300):  # three seconds at 100 Hz
        try:
            await link.connect()
            await link.read_holding(0, 2)
            await link.read_holding(16, 26)
        except LinkError:
            await link.close()
            setup.clock.now_s += 0.01
    assert setup.server.accepted <= 7  # at 0, 0, 0.1, 0.3, 0.7, 1.5 s


async def test_a_write_does_not_end_the_back_off(setup: Setup) -> None:
    setup.server.reply = lambda transaction, unit, pdu: [frame(transaction, unit, pdu[:5])]
    link = await setup.connected()
    setup.clock.now_s += 0.05
    await link.write_register(0, 1)
    assert link.retry_in_s == pytest.approx(FIRST_S - 0.05)


async def test_a_reply_after_its_time_out_is_named_with_its_delay(setup: Setup) -> None:
    """The second request gets the reply to the first."""
    first: list[bytes] = []

    def keep(transaction: int, unit: int, pdu: bytes) -> list[bytes]:
        first.append(frame(transaction, unit, good_read([1])))
        setup.clock.now_s += 0.35
        return first[:1] if len(first) == 2 else []

    setup.server.reply = keep
    link = await setup.connected(SOON_S)
    with pytest.raises(LinkError, match="no valid answer within") as alone:
        await link.read_holding(0, 1)
    assert "late" not in str(alone.value)
    with pytest.raises(LinkError, match=r"answers come late, the last one 0\.70 s"):
        await link.read_holding(0, 1)


async def test_a_line_that_is_cut_after_a_late_reply_is_not_called_slow(setup: Setup) -> None:
    late = LateAnswers()
    late.note_question()
    late.note_late(0.35)
    for _ in range(3):
        late.note_question()
        assert "0.35 s" in late.explain()
    late.note_question()
    assert late.explain() == ""
    late.note_late(0.2)
    late.note_in_time()
    assert late.explain() == ""


def test_a_young_connection_does_not_end_the_back_off() -> None:
    back_off = BackOff()
    back_off.attempted(0.0)
    back_off.succeeded(0.01)  # the first retry is free
    assert back_off.remaining_s(0.01) == 0
    back_off.attempted(0.02)
    back_off.succeeded(0.03)
    assert back_off.remaining_s(0.03) == pytest.approx(0.19)
    back_off.succeeded(0.02 + PROVEN_S)
    back_off.attempted(2.0)
    assert back_off.remaining_s(2.0) == pytest.approx(FIRST_S)
