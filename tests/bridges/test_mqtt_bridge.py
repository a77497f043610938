"""The MQTT bridge against floods, garbage, old messages, lost connections, and brokers that do not
answer.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import json
import os
import random
import signal
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import aiomqtt
import pytest

from membrane_ctrl.bridges import mqtt, mqtt_owner
from membrane_ctrl.bridges.bridge import Bridge
from membrane_ctrl.bridges.mqtt_client import CancellableClient
from membrane_ctrl.bridges.mqtt_inbox import Reports
from membrane_ctrl.bridges.mqtt_owner import OwnerClaim
from membrane_ctrl.config.bridges import MqttConfig
from membrane_ctrl.control_port.safety_commands import SAFETY
from membrane_ctrl.model.errors import DeviceError
from membrane_ctrl.model.telemetry import State
from tests.bridges.test_bridge_clients import broker, program
from tests.bridges.test_bridges import STRANGE_NUMBERS, bridge_with, seen_hold
from tests.support.machine_needs import needs, program_path
from tests.support.peak_memory import peak_mb, reset_peak
from tests.worlds.free_port import free_port
from tests.worlds.port_run import PortRun, port_run

pytestmark = [
    pytest.mark.real_time,
    needs("mosquitto"),
    pytest.mark.usefixtures("slow_answers_allowed"),
]
BASE = "membrane/mirror"
ANSWER_S = 1.0
PATIENCE_S = 30.0
WATCHED_S = 2.0
NOT_OURS = "0" * 16


@pytest.fixture(autouse=True)
def fast(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mqtt, "_KEEPALIVE_S", 1)
    monkeypatch.setattr(mqtt, "_AGAIN_S", 0.2)
    monkeypatch.setattr(mqtt_owner, "SILENT_S", 2.5)
    monkeypatch.setattr(mqtt_owner, "BEAT_S", 1.0)


def loop_time_s() -> float:
    """Time in which this process ran or waited: a machine that pauses delays no answer."""
    return asyncio.get_running_loop().time()


def bridge_to(folder: Path, role: str = "operate") -> Bridge:
    seen = dataclasses.replace(
        seen_hold(error_um=0.25), name="the-run", seen_s=time.monotonic() + 1e6
    )
    return bridge_with(role, seen, folder / "control.sock")


@asynccontextmanager
async def serving(port: int, bridge: Bridge) -> AsyncIterator[asyncio.Task[None]]:
    """A bridge in this process; ended cleanly."""
    task = asyncio.create_task(mqtt.serve(MqttConfig(port=port, discovery_prefix=""), bridge))
    try:
        yield task
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError, ExceptionGroup):
            await task
        await bridge.close()


class Listener:
    """Everything that the broker publishes below the bridge's topic."""

    def __init__(self, client: aiomqtt.Client) -> None:
        self.client = client
        self.seen: list[tuple[str, str]] = []

    async def run(self) -> None:
        async for message in self.client.messages:
            payload = (
                message.payload.decode("utf-8", "replace")
                if isinstance(message.payload, bytes)
                else ""
            )
            self.seen.append((str(message.topic).removeprefix(f"{BASE}/"), payload))

    def of(self, topic: str) -> list[str]:
        return [payload for each, payload in self.seen if each == topic]

    async def until(self, condition: Callable[[], bool], limit_s: float = PATIENCE_S) -> float:
        """Wait for a condition; returns how long that took."""
        begin_s = loop_time_s()
        async with asyncio.timeout(limit_s):
            while not condition():  # noqa: ASYNC110  the condition is about messages
                await asyncio.sleep(0.01)
        return loop_time_s() - begin_s

    async def answer(self, text: str, limit_s: float = PATIENCE_S) -> str:
        await self.until(lambda: any(text in each for each in self.of("answer")), limit_s)
        return next(each for each in self.of("answer") if text in each)


@asynccontextmanager
async def listening(port: int) -> AsyncIterator[Listener]:
    async with aiomqtt.Client("127.0.0.1", port) as client:
        await client.subscribe(f"{BASE}/#", qos=1)
        listener = Listener(client)
        task = asyncio.create_task(listener.run())
        try:
            yield listener
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


@asynccontextmanager
async def bridge(folder: Path) -> AsyncIterator[tuple[PortRun, Listener, int]]:
    """A run, a broker, a bridge between them, and a listener."""
    port = free_port()
    async with (
        port_run(folder) as run,
        broker(port),
        listening(port) as listener,
        serving(port, bridge_to(folder)),
    ):
        await listener.until(lambda: "online" in listener.of("availability"))
        yield run, listener, port


async def send(port: int, topic: str, payload: str | bytes, **more: object) -> None:
    async with aiomqtt.Client("127.0.0.1", port) as client:
        await client.publish(f"{BASE}/{topic}", payload, qos=1, **more)  # type: ignore[arg-type]


def kinds(run: PortRun) -> list[str]:
    return [command.kind for command in run.asked]


@pytest.mark.fast_cases("quiet-latch", "quiet-stop", "mark-lower", "mark-vent")
@pytest.mark.parametrize("kind", sorted(SAFETY))
@pytest.mark.parametrize("flood", ["quiet", "mark"])
async def test_a_safety_command_behind_150_others_is_answered_within_a_second(
    tmp_path: Path, kind: str, flood: str
) -> None:
    async with (
        bridge(tmp_path) as (run, listener, port),
        aiomqtt.Client("127.0.0.1", port) as client,
    ):
        for number in range(150):
            await client.publish(f"{BASE}/do/{flood}", f"x{number}", qos=1)
        begin_s = loop_time_s()
        await client.publish(f"{BASE}/do/{kind}", "hands inside", qos=1)
        assert (await listener.answer(f"mqtt: {kind}")).endswith(f"{kind}: done")
        assert loop_time_s() - begin_s < ANSWER_S
        assert kind in kinds(run)


async def test_a_latch_behind_a_flood_that_the_broker_itself_drops_arrives(tmp_path: Path) -> None:
    """The broker keeps 1000 messages for a slow client;
    the safety commands are another client's.
    """
    async with (
        bridge(tmp_path) as (run, listener, port),
        aiomqtt.Client("127.0.0.1", port) as client,
    ):
        flooding = [asyncio.create_task(flood_for(port, 3.0)) for _ in range(3)]
        await asyncio.sleep(1.5)
        begin_s = loop_time_s()
        await client.publish(f"{BASE}/do/latch", "hands inside", qos=1)
        await listener.until(lambda: "latch" in kinds(run))
        assert loop_time_s() - begin_s < ANSWER_S
        await listener.answer("latch: done")
        await asyncio.gather(*flooding)


async def flood_for(port: int, duration_s: float) -> None:
    end_s = time.monotonic() + duration_s
    async with aiomqtt.Client("127.0.0.1", port) as client:
        while time.monotonic() < end_s:
            for _ in range(20):
                await client.publish(f"{BASE}/do/quiet", "", qos=0)
            await asyncio.sleep(0)


async def test_what_a_flood_loses_is_reported(tmp_path: Path) -> None:
    async with (
        bridge(tmp_path) as (run, listener, port),
        aiomqtt.Client("127.0.0.1", port) as client,
    ):
        for number in range(150):
            await client.publish(f"{BASE}/do/mark", f"x{number}", qos=1)
        await client.publish(f"{BASE}/do/mark", "the last", qos=1)

        def reported() -> int:
            answers = listener.of("answer")
            counted = sum(int(each.split()[0]) for each in answers if "more commands" in each)
            return counted + sum("mark" in each for each in answers)

        with contextlib.suppress(TimeoutError):
            await listener.until(lambda: reported() == 151)
        assert reported() == 151, listener.of("answer")
        done = sum(each.endswith("mark: done") for each in listener.of("answer"))
        assert done == len(run.asked)


@pytest.mark.fast_cases("0-0", "0-1", "150-0", "150-1")
@pytest.mark.parametrize("qos", [0, 1])
@pytest.mark.parametrize("before", [0, 4, 150])
async def test_a_hold_published_before_a_lower_is_not_obeyed_after_it(
    tmp_path: Path, qos: int, before: int
) -> None:
    async with (
        bridge(tmp_path) as (run, listener, port),
        aiomqtt.Client("127.0.0.1", port) as client,
    ):
        run.state = State.STANDBY
        for round_ in range(2):
            listener.seen.clear()
            run.asked.clear()
            for _ in range(before):
                await client.publish(f"{BASE}/do/mark", "x", qos=qos)
            await client.publish(f"{BASE}/do/hold", "", qos=qos)
            await client.publish(f"{BASE}/do/lower", "", qos=qos)
            await listener.answer("lower: done")
            await asyncio.sleep(1.0)
            assert "hold" not in kinds(run)[kinds(run).index("lower") :], round_
            await client.publish(f"{BASE}/do/hold", "", qos=qos)
            await listener.answer("hold: done")


@pytest.mark.fast_cases("hold", "latch")
@pytest.mark.parametrize("command", ["hold", "latch", "vent"])
async def test_a_retained_command_is_never_obeyed(tmp_path: Path, command: str) -> None:
    port = free_port()
    async with port_run(tmp_path) as run, broker(port), listening(port) as listener:
        run.state = State.STANDBY
        await send(port, f"do/{command}", "old", retain=True)
        for _ in range(2):  # at the first connection, and at the next one
            listener.seen.clear()
            async with serving(port, bridge_to(tmp_path)):
                assert (
                    await listener.answer(command)
                    == f"{command} refused: a retained message is no command"
                )
        assert run.asked == []


@pytest.mark.parametrize("text", STRANGE_NUMBERS)
async def test_a_text_that_is_no_number_is_refused(tmp_path: Path, text: str) -> None:
    bridge = bridge_to(tmp_path)
    async with port_run(tmp_path) as run:
        for payload in (text, text.encode()):
            assert "Setpoint: enter a number in µm" in await bridge.ask("mqtt", "setpoint", payload)
        assert run.asked == []


async def test_garbage_on_every_topic_is_answered_and_the_bridge_continues(tmp_path: Path) -> None:
    rng = random.Random(5)
    payloads = [
        b"",
        b"\xff\xfe",
        b"\0" * 10,
        rng.randbytes(600),
        b"9" * 300_000,
        b"NaN",
        b'{"value": 1}',
    ]
    async with (
        bridge(tmp_path) as (run, listener, port),
        aiomqtt.Client("127.0.0.1", port) as client,
    ):
        for name in ("setpoint", "manual", "open_the_roof", "__class__", "mark"):
            for payload in payloads:
                listener.seen.clear()
                await client.publish(f"{BASE}/do/{name}", payload, qos=1)
                try:
                    await listener.until(lambda: bool(listener.of("answer")), 5.0)
                except TimeoutError:
                    raise AssertionError(f"no answer to {name} {payload[:20]!r}") from None
                await asyncio.sleep(0.02)
        for topic in ("owner", "availability", "values", "answer"):
            for payload in payloads:
                await client.publish(f"{BASE}/{topic}", payload, qos=1)
        assert {"setpoint", "manual"}.isdisjoint(kinds(run))
        await listener.until(lambda: listener.of("availability")[-1] == "online", 5.0)
        listener.seen.clear()
        await client.publish(f"{BASE}/do/setpoint", "1.5", qos=1)
        await listener.answer("setpoint: done")


async def test_a_latch_with_a_bad_text_is_obeyed(tmp_path: Path) -> None:
    bridge = bridge_to(tmp_path)
    async with port_run(tmp_path) as run:
        for payload in (b"\xff\xfe", b"hands\ninside", b"x" * 100_000, "ü" * 400, ""):
            assert (await bridge.ask("mqtt", "latch", payload)).endswith("latch: done")
        assert [command.text for command in run.asked][:2] == ["\ufffd\ufffd", "hands?inside"]


async def test_an_old_will_is_corrected_within_seconds(tmp_path: Path) -> None:
    """The bridge's side of its connections is reset, the broker's side stays open until its
    keep-alive ends.
    """
    port, relay_port = free_port(), free_port()
    async with (
        port_run(tmp_path),
        broker(port),
        listening(port) as listener,
        relay(relay_port, port) as reset,
        serving(relay_port, bridge_to(tmp_path)),
    ):
        await listener.until(lambda: "online" in listener.of("availability"))
        for _ in range(2):
            reset()
            listener.seen.clear()
            await listener.until(lambda: "offline" in listener.of("availability"))
            await listener.until(lambda: listener.of("availability")[-1] == "online", 3.0)
            await asyncio.sleep(1.0)
        await asyncio.sleep(2.5)
        assert listener.of("availability")[-1] == "online"


@asynccontextmanager
async def relay(listens: int, port: int) -> AsyncIterator[Callable[[], None]]:
    """A relay to the broker; what it yields resets the clients' sides and forgets the broker's, as
    a NAT box does.
    """
    live: list[tuple[asyncio.StreamWriter, asyncio.StreamWriter, asyncio.Event]] = []
    forgotten = []

    async def pump(
        reader: asyncio.StreamReader, writer: asyncio.StreamWriter, dead: asyncio.Event
    ) -> None:
        with contextlib.suppress(OSError):
            while (data := await reader.read(65536)) and not dead.is_set():
                writer.write(data)
                await writer.drain()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        broker_reader, broker_writer = await asyncio.open_connection("127.0.0.1", port)
        dead = asyncio.Event()
        live.append((writer, broker_writer, dead))
        pumps = [asyncio.create_task(pump(reader, broker_writer, dead))]
        pumps.append(asyncio.create_task(pump(broker_reader, writer, dead)))
        await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
        if not dead.is_set():
            writer.close()
            broker_writer.close()

    def reset() -> None:
        for writer, broker_writer, dead in live:
            dead.set()
            writer.transport.abort()
            forgotten.append(broker_writer)
        live.clear()

    server = await asyncio.start_server(serve, "127.0.0.1", listens)
    try:
        yield reset
    finally:
        server.close()
        for writer in (*forgotten, *(each for pair in live for each in pair[:2])):
            writer.transport.abort()


async def test_a_wrong_availability_is_corrected_but_not_by_a_storm(tmp_path: Path) -> None:
    async with bridge(tmp_path) as (_, listener, port), aiomqtt.Client("127.0.0.1", port) as client:
        await client.publish(f"{BASE}/availability", "offline", qos=1, retain=True)
        await listener.until(lambda: listener.of("availability")[-2:] == ["offline", "online"], 3.0)
        listener.seen.clear()
        for _ in range(500):
            await client.publish(f"{BASE}/availability", "offline", qos=0)
        await asyncio.sleep(2.0)
        assert listener.of("availability")[-1] == "online"
        assert listener.of("availability").count("online") <= 8


async def test_a_second_bridge_of_the_name_is_refused_and_the_first_continues(
    tmp_path: Path,
) -> None:
    async with bridge(tmp_path) as (_, listener, port):
        begin_s = loop_time_s()
        async with serving(port, bridge_to(tmp_path)) as second:
            with pytest.raises(ExceptionGroup) as refused:
                await second
            assert loop_time_s() - begin_s < 8.0
        (error,) = mqtt._list_exceptions(refused.value)
        assert isinstance(error, DeviceError)
        assert f"the name 'mirror' is in use by another bridge (process {os.getpid()} on " in str(
            error
        )
        listener.seen.clear()
        await asyncio.sleep(2.5)
        assert len(listener.of("values")) >= 2
        assert "offline" not in listener.of("availability")


async def test_of_two_bridges_that_start_together_one_continues(tmp_path: Path) -> None:
    for _ in range(2):
        port = free_port()
        async with (
            broker(port),
            listening(port) as listener,
            serving(port, bridge_to(tmp_path)) as one,
            serving(port, bridge_to(tmp_path)) as two,
        ):
            done, pending = await asyncio.wait(
                {one, two}, timeout=PATIENCE_S, return_when=asyncio.FIRST_COMPLETED
            )
            assert len(done) == 1
            refused = done.pop().exception()
            assert isinstance(refused, ExceptionGroup)
            assert [type(error) for error in mqtt._list_exceptions(refused)] == [DeviceError]
            await listener.until(lambda: "online" in listener.of("availability"))
            owners = {
                json.loads(each)["instance"]
                for each in listener.of("owner")
                if '"since_s": null' not in each
            }
            assert len(owners) == 1
            assert not pending.pop().done()


async def test_the_claim_of_a_crashed_bridge_expires(tmp_path: Path) -> None:
    port = free_port()
    claim = OwnerClaim(NOT_OURS, "elsewhere", 1, 5.0)
    async with broker(port), listening(port) as listener:
        await send(port, "owner", claim.encode(), retain=True)
        begin_s = loop_time_s()
        async with serving(port, bridge_to(tmp_path)):
            await listener.until(lambda: "online" in listener.of("availability"))
            assert mqtt_owner.SILENT_S < loop_time_s() - begin_s < mqtt_owner.SILENT_S + 5.0


async def test_a_bridge_that_ends_frees_the_name_at_once(tmp_path: Path) -> None:
    port = free_port()
    async with broker(port), listening(port) as listener:
        for _ in range(2):
            listener.seen.clear()
            begin_s = loop_time_s()
            async with serving(port, bridge_to(tmp_path)):
                await listener.until(lambda: "online" in listener.of("availability"))
                assert loop_time_s() - begin_s < mqtt_owner.SILENT_S
            await listener.until(
                lambda: (
                    listener.of("availability")[-1] == "offline" and listener.of("owner")[-1] == ""
                )
            )


async def test_an_owner_that_comes_back_ends_the_bridge_that_took_its_name(tmp_path: Path) -> None:
    port = free_port()
    async with (
        broker(port),
        serving(port, bridge_to(tmp_path)) as task,
        listening(port) as listener,
    ):
        await listener.until(lambda: "online" in listener.of("availability"))
        older = OwnerClaim(NOT_OURS, "elsewhere", 1, 5.0)
        await send(port, "owner", older.encode())
        with pytest.raises(ExceptionGroup) as refused:
            await asyncio.wait_for(task, PATIENCE_S)
        assert [type(error) for error in mqtt._list_exceptions(refused.value)] == [DeviceError]


async def test_younger_claims_do_not_disturb_an_owner(tmp_path: Path) -> None:
    async with bridge(tmp_path) as (_, listener, port), aiomqtt.Client("127.0.0.1", port) as client:
        listener.seen.clear()
        for number in range(500):
            claim = OwnerClaim(f"{number:016x}", "elsewhere", 1, time.time() + 100.0)
            await client.publish(f"{BASE}/owner", claim.encode(), qos=0)
        await asyncio.sleep(2.0)
        own = [each for each in listener.of("owner") if '"elsewhere"' not in each]
        assert 1 <= len(own) <= 15, "a flood of claims is not answered by a flood"
        assert len(listener.of("values")) >= 1


@pytest.mark.parametrize("trouble", [signal.SIGSTOP, signal.SIGKILL])
async def test_a_bridge_ends_though_its_broker_hangs_or_dies_at_that_moment(
    tmp_path: Path, trouble: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mqtt, "_ANSWER_S", 1.0)
    port = free_port()
    async with program(program_path("mosquitto"), "-p", str(port)) as process:
        bridge = bridge_to(tmp_path)
        task = asyncio.create_task(mqtt.serve(MqttConfig(port=port, discovery_prefix=""), bridge))
        async with contextlib.AsyncExitStack() as stack:
            await asyncio.sleep(1.0)
            listener = await stack.enter_async_context(listening(port))
            await listener.until(lambda: "online" in listener.of("availability"))
        process.send_signal(trouble)
        task.cancel()
        done, _ = await asyncio.wait({task}, timeout=10.0)
        assert done == {task}
        assert task.cancelled()


@pytest.mark.parametrize("behaviour", ["silent", "closes", "garbage"])
async def test_a_broker_that_does_not_answer_costs_neither_memory_nor_commands(
    tmp_path: Path, behaviour: str, capsys: pytest.CaptureFixture[str]
) -> None:
    connections = 0

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal connections
        connections += 1
        with contextlib.suppress(OSError):
            if behaviour == "garbage":
                writer.write(random.Random(connections).randbytes(10_000))
            if behaviour != "closes":
                await reader.read(-1)
        writer.close()

    port = free_port()
    server = await asyncio.start_server(serve, "127.0.0.1", port)
    before_mb = reset_peak()
    bridge = bridge_to(tmp_path)
    async with port_run(tmp_path) as run, serving(port, bridge) as task:
        begin_s = loop_time_s()
        while loop_time_s() - begin_s < WATCHED_S:
            asked_s = loop_time_s()
            assert (await bridge.ask("opcua", "stop")).endswith("stop: done")
            assert loop_time_s() - asked_s < ANSWER_S
            await asyncio.sleep(0.2)
        assert "stop" in kinds(run)
        assert not task.done()
    server.close()
    assert connections <= WATCHED_S / mqtt._AGAIN_S + 2
    assert peak_mb() - before_mb < 20
    assert len(capsys.readouterr().err.splitlines()) <= 3, "one line, not one for each attempt"


async def test_a_cancellation_in_the_moment_of_a_confirmation_ends_the_task(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """`asyncio.wait_for` of Python 3.11 returns the result, and the cancellation is lost."""
    confirmed = asyncio.Event()

    async def publish(self: object, *args: object, **kwargs: object) -> None:
        await asyncio.wait_for(confirmed.wait(), 5.0)

    monkeypatch.setattr(aiomqtt.Client, "publish", publish)
    client = CancellableClient("127.0.0.1")
    reports = Reports(client.publish, 0.0)
    reports.add("done")
    task = asyncio.create_task(reports.run())
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    confirmed.set()
    await asyncio.sleep(0)
    task.cancel()
    done, _ = await asyncio.wait({task}, timeout=1.0)
    assert done
