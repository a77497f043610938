"""Clients of other makers at the bridges read, are refused or obeyed, and survive a restart of
either side.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from membrane_ctrl.bridges.bridge import TABLE
from tests.studies.bridge_clients import lines
from tests.support.machine_needs import needs, program_path
from tests.worlds.free_port import free_port
from tests.worlds.port_run import PortRun, keep_ticking, port_run

PATIENCE_S = 180.0
NO_NUMBER = "is not a plain decimal number such as -1.5 or 2e-3"
pytestmark = [pytest.mark.real_time, needs("mosquitto", "mosquitto_pub", "mosquitto_sub")]


@asynccontextmanager
async def program(*words: str, **env: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """A program of the test; killed at the end if it still runs."""
    process = await asyncio.create_subprocess_exec(
        *words,
        env=os.environ | env,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    try:
        yield process
    finally:
        if process.returncode is None:
            process.kill()
        await process.communicate()


@asynccontextmanager
async def bridges(folder: Path, text: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """`membrane-ctrl bridges` with the settings, once all bridges are open."""
    (folder / "lab.toml").write_text(text)
    words = ["--config", str(folder / "lab.toml"), "--logs", str(folder)]
    async with program(
        sys.executable, "-c", "from membrane_ctrl.bridges.cli import app; app()", *words
    ) as process:
        wanted = {name for name in ("mqtt", "opcua", "epics") if f"[bridges.{name}]" in text}
        assert process.stdout is not None
        async with asyncio.timeout(PATIENCE_S):
            while wanted:
                line = (await process.stdout.readline()).decode()
                assert line, "the bridges ended"
                wanted.discard(line.partition(":")[0])
        yield process


@asynccontextmanager
async def broker(port: int) -> AsyncIterator[None]:
    async with program(program_path("mosquitto"), "-p", str(port)):
        async with asyncio.timeout(PATIENCE_S):
            while True:
                try:
                    (await asyncio.open_connection("127.0.0.1", port))[1].close()
                    break
                except OSError:
                    await asyncio.sleep(0.05)
        yield


@asynccontextmanager
async def held(folder: Path) -> AsyncIterator[PortRun]:
    async with port_run(folder) as run:
        task = asyncio.create_task(keep_ticking(run))
        try:
            yield run
        finally:
            task.cancel()


async def receive_text(port: int, topic: str, until: str = "") -> str:
    """The first message with that text, by mosquitto's own client."""
    async with (
        program("stdbuf", "-oL", "mosquitto_sub", "-p", str(port), "-t", topic) as client,
        asyncio.timeout(PATIENCE_S),
    ):
        assert client.stdout is not None
        while True:
            line = (await client.stdout.readline()).decode()
            assert line, "the broker ended"
            if until in line:
                return line.strip()


async def publish_text(port: int, topic: str, text: str, *more: str) -> None:
    async with program("mosquitto_pub", "-p", str(port), "-t", topic, "-m", text, *more) as client:
        assert await client.wait() == 0


@asynccontextmanager
async def hearing(port: int, topic: str) -> AsyncIterator[Callable[[], Awaitable[str]]]:
    """A subscriber; what it yields waits for its next message."""
    async with program(
        "stdbuf", "-oL", "mosquitto_sub", "-p", str(port), "-t", topic, "-d"
    ) as client:
        assert client.stdout is not None
        stdout = client.stdout

        async def answer() -> str:
            async with asyncio.timeout(PATIENCE_S):
                while (line := (await stdout.readline()).decode()).startswith(
                    ("Client", "Subscribed")
                ):
                    pass
            return line.strip()

        async with asyncio.timeout(PATIENCE_S):
            while b"Subscribed" not in await stdout.readline():
                pass
        yield answer


async def said_by(script: str, ports: dict[str, int], wanted: object = None) -> dict[str, Any]:
    """What a client's program prints, as JSON."""
    code = script.format(**ports, wanted=wanted)
    env = {
        "EPICS_CA_ADDR_LIST": "127.0.0.1",
        "EPICS_CA_AUTO_ADDR_LIST": "NO",
        "EPICS_CA_SERVER_PORT": str(ports["ca"]),
    }
    env |= {"EPICS_PVA_NAME_SERVERS": f"127.0.0.1:{ports['pva']}", "EPICS_PVA_AUTO_ADDR_LIST": "NO"}
    async with program(sys.executable, "-c", code, **env) as client, asyncio.timeout(PATIENCE_S):
        out = (await client.communicate())[0].decode()
    assert client.returncode == 0, out
    return dict(json.loads(out.splitlines()[-1]))


SERVERS = """[bridges]
role = "operate"
period_s = 0.5
[bridges.opcua]
port = {opcua}
[bridges.epics]
ca_port = {ca}
pva_port = {pva}
"""
OPCUA_CLIENT = """
import asyncio, json
from asyncua import Client, ua
url = "opc.tcp://127.0.0.1:{opcua}/membrane_ctrl"
async def name_of(awaited):
    try:
        return await awaited
    except ua.UaError as error:
        return type(error).__name__
async def main():
    found = dict()
    async with Client(url) as client:
        space = await client.get_namespace_index("urn:membrane-ctrl:mirror")
        node = lambda name: client.get_node(f"ns={{space}};s=mirror{{name}}")
        found["error_um"] = await node(".error_um").read_value()
        found["unit"] = (await node(".error_um.unit").read_value()).DisplayName.Text
        found["state"] = await node(".state").read_value()
        found["write"] = await name_of(node(".error_um").write_value(3.0))
        found["setpoint"] = (await node("").call_method(f"{{space}}:setpoint", 1.5)).partition(", ")[2]
        found["keep"] = await name_of(node(".do.keep").read_browse_name())
    admin = Client(url)
    admin.set_user("admin")
    found["admin"] = await name_of(admin.connect())
    print(json.dumps(found))
asyncio.run(main())
"""  # noqa: E501
CA_CLIENT = """
import json
from caproto.sync.client import read, write
value = read("mirror:error_um", data_type="control", repeater=False)
refused = write("mirror:error_um", 5.0, notify=True, repeater=False).status.name
write("mirror:do:setpoint", -2.0, notify=True, timeout=20, repeater=False)
answer = bytes(read("mirror:answer", repeater=False).data).decode().rstrip(chr(0)).partition(", ")[2]
print(json.dumps(dict(error_um=value.data[0], unit=value.metadata.units.decode(), write=refused, answer=answer)))
"""  # noqa: E501
PVA_CLIENT = """
import json
from p4p.client.thread import Context, RemoteError
with Context("pva") as client:
    found = dict(error_um=client.get("mirror:error_um"), state=client.get("mirror:state"), write="done")
    try:
        client.put("mirror:error_um", 5.0)
    except RemoteError:
        found["write"] = "refused"
    client.put("mirror:do:mark", "pva", timeout=20, request="record[process=true,block=true]")
    found["answer"] = client.get("mirror:answer").partition(", ")[2]
print(json.dumps(found))
"""  # noqa: E501
HOSTILE_OPCUA = """
import asyncio, json
from asyncua import Client, ua
async def name_of(awaited):
    try:
        said = await awaited
    except ua.UaError as error:
        return type(error).__name__
    return said if isinstance(said, str) else "done"
async def main():
    found = dict()
    async with Client("opc.tcp://127.0.0.1:{opcua}/membrane_ctrl") as client:
        space = await client.get_namespace_index("urn:membrane-ctrl:mirror")
        node = lambda name: client.get_node(f"ns={{space}};s=mirror{{name}}")
        given = dict(nan=[float("nan")], text=["abc"], none=[], two=[1.0, 2.0], array=[[1.0]], bytes=[b"1"])
        for name, values in dict(given, huge=["1" * 1000000]).items():
            said = await name_of(node("").call_method(f"{{space}}:setpoint", *values))
            found[name] = said.rpartition("opcua: ")[2]
        found["add"] = await name_of(client.nodes.objects.add_object(space, "x"))
        found["delete"] = await name_of(client.delete_nodes([node(".error_um")]))
        off = ua.DataValue(ua.Variant(False))
        found["shut"] = await name_of(node(".do.stop").write_attribute(ua.AttributeIds.Executable, off))
        found["unit"] = await name_of(node(".error_um.unit").write_value("mm"))
    print(json.dumps(found))
asyncio.run(main())
"""  # noqa: E501
# a field that is not the value would chain commands, repeat them, or shut them
HOSTILE_CA = """
import json
from caproto.sync.client import read, write
found = dict()
for name, value in (
    ("setpoint.FLNK", "mirror:do:stop"), ("setpoint.OUT", "mirror:error_um"), ("setpoint.SCAN", [6]),
    ("setpoint.PROC", [1]), ("stop.ASG", "DEFAULT"), ("stop.DISP", [1]), ("setpoint", float("nan")),
    ("setpoint", 1e9), ("mark", "x" * 5000), ("mark", bytes([27, 91, 255])),
):
    status = write("mirror:do:" + name, value, notify=True, timeout=20, repeater=False).status.name
    answer = bytes(read("mirror:answer", repeater=False).data).decode().rstrip(chr(0)).partition("epics: ")[2]
    found[name + " " + str(value)[:3]] = answer if status == "ECA_NORMAL" else status
print(json.dumps(found))
"""  # noqa: E501
WATCHER = """
import asyncio, json
from asyncua import Client
from p4p.client.thread import Context
async def main():
    async with Client("opc.tcp://127.0.0.1:{opcua}/membrane_ctrl") as client:
        space = await client.get_namespace_index("urn:membrane-ctrl:mirror")
        node = client.get_node(f"ns={{space}};s=mirror.error_um")
        with Context("pva") as pva:
            for _ in range(300):
                value = await node.read_data_value(raise_on_bad_status=False)
                found = dict(opcua=value.StatusCode.name, epics=pva.get("mirror:error_um").severity)
                if found == {wanted}:
                    break
                await asyncio.sleep(0.1)
    print(json.dumps(found))
asyncio.run(main())
"""
MQTT = """[bridges]
name = "bench"
role = "operate"
period_s = 0.5
[bridges.mqtt]
port = {port}
"""


async def test_mqtt_publishes_obeys_and_survives_restarts(tmp_path: Path) -> None:
    port, base = free_port(), "membrane/bench"
    settings = MQTT.format(port=port)
    async with (
        AsyncExitStack() as first_broker,
        AsyncExitStack() as first_hold,
        AsyncExitStack() as bridge_stack,
    ):
        run = await first_hold.enter_async_context(held(tmp_path))
        await first_broker.enter_async_context(broker(port))
        await publish_text(port, f"{base}/do/vent", "PRESS", "-r")  # stays at the broker
        async with hearing(port, f"{base}/answer") as answer:
            bridge = await bridge_stack.enter_async_context(bridges(tmp_path, settings))
            assert await answer() == "vent refused: a retained message is no command"
            values = json.loads(await receive_text(port, f"{base}/values", '"hold"'))
            assert (values["error_um"], values["run"]) == (0.25, "the-run")
            await publish_text(port, f"{base}/do/setpoint", "1.5")
            assert (await answer()).endswith("mqtt: setpoint: done")
            for command, text, message in (
                ("setpoint", "nan", f"mqtt: Setpoint: enter a number in µm: 'nan' {NO_NUMBER}"),
                ("open_the_roof", "", "mqtt: no such command"),
                ("mark", "x" * 100_000, "mqtt: mark refused: longer than 500 bytes"),
            ):
                await publish_text(port, f"{base}/do/{command}", text)
                assert (await answer()).endswith(message)
        assert [(each.kind, each.value) for each in run.asked] == [("setpoint", 1.5)]
        found = json.loads(await receive_text(port, "homeassistant/device/membrane_bench/config"))
        assert found["availability_topic"] == f"{base}/availability"
        await first_broker.aclose()
        async with broker(port):  # which knows nothing of the first one
            await receive_text(port, f"{base}/availability", "online")
            await receive_text(port, "homeassistant/device/membrane_bench/config")
            await first_hold.aclose()
            await receive_text(port, f"{base}/availability", "offline")
            assert json.loads(await receive_text(port, f"{base}/values"))["error_um"] is None
            async with held(tmp_path):
                await receive_text(port, f"{base}/availability", "online")
                bridge.kill()
                await receive_text(port, f"{base}/availability", "offline")


@pytest.mark.campaign
async def test_opc_ua_and_epics_publish_refuse_and_obey(tmp_path: Path) -> None:
    ports = {"opcua": free_port(), "ca": free_port(), "pva": free_port()}
    settings = SERVERS.format(**ports)
    async with held(tmp_path) as run, bridges(tmp_path, settings):
        found = await said_by(OPCUA_CLIENT, ports)
        assert found == {
            "error_um": 0.25,
            "unit": "µm",
            "state": "hold",
            "write": "BadUserAccessDenied",
            "admin": "BadIdentityTokenRejected",
            "setpoint": "opcua: setpoint: done",
            "keep": "BadNodeIdUnknown",
        }
        found = await said_by(CA_CLIENT, ports)
        assert found == {
            "error_um": 0.25,
            "unit": "µm",
            "write": "ECA_NOWTACCESS",
            "answer": "epics: setpoint: done",
        }
        found = await said_by(PVA_CLIENT, ports)
        assert found == {
            "error_um": 0.25,
            "state": "hold",
            "write": "refused",
            "answer": "epics: mark: done",
        }
        assert [(each.kind, each.text) for each in run.asked] == [
            ("setpoint", ""),
            ("setpoint", ""),
            ("mark", "pva"),
        ]


@pytest.mark.campaign
async def test_opc_ua_and_epics_survive_the_hold(tmp_path: Path) -> None:
    ports = {"opcua": free_port(), "ca": free_port(), "pva": free_port()}
    good, bad = {"opcua": "Good", "epics": 0}, {"opcua": "BadNoCommunication", "epics": 3}
    async with bridges(tmp_path, SERVERS.format(**ports)):
        for _ in range(2):
            async with held(tmp_path):
                assert await said_by(WATCHER, ports, good) == good
            assert await said_by(WATCHER, ports, bad) == bad


@pytest.mark.campaign
async def test_hostile_clients_change_nothing(tmp_path: Path) -> None:
    ports = {"opcua": free_port(), "ca": free_port(), "pva": free_port()}
    async with held(tmp_path) as run, bridges(tmp_path, SERVERS.format(**ports)):
        finite = "Setpoint: enter a finite number in µm"
        assert await said_by(HOSTILE_OPCUA, ports) == {
            "nan": finite,
            "text": f"Setpoint: enter a number in µm: 'abc' {NO_NUMBER}",
            "none": f"Setpoint: enter a number in µm: '' {NO_NUMBER}",
            **dict.fromkeys(("two", "array", "bytes"), "BadInvalidArgument"),
            "huge": "setpoint refused: longer than 500 bytes",
            **dict.fromkeys(("add", "delete", "shut", "unit"), "BadUserAccessDenied"),
        }
        fields = ("FLNK mir", "OUT mir", "SCAN [6]", "PROC [1]")
        assert await said_by(HOSTILE_CA, ports) == {
            **{f"setpoint.{each}": "ECA_NOWTACCESS" for each in fields},
            "stop.ASG DEF": "ECA_NOWTACCESS",
            "stop.DISP [1]": "ECA_NOWTACCESS",
            "setpoint nan": finite,
            (
                "setpoint 100"
            ): "setpoint refused: setpoint 1e+09 µm is outside the limits (-2000 .. 500 µm)",
            "mark xxx": "mark refused: longer than 500 bytes",
            "mark b'\\": "mark refused: text: only printable characters, in one line",
        }
        assert [(each.kind, each.value) for each in run.asked] == [("setpoint", 1e9)], (
            "which the tick refused"
        )


async def fresh(file: Path, after_s: float) -> None:
    """Wait until the client has all names, made after a moment (UTC seconds)."""

    def there() -> bool:
        sweeps = (line for line in lines(file) if line.get("names") == len(TABLE))
        return any(line["utc_s"] - line["oldest_s"] > after_s for line in sweeps)

    async with asyncio.timeout(PATIENCE_S):
        while True:
            if there():
                return
            await asyncio.sleep(0.1)


@pytest.mark.campaign
@pytest.mark.parametrize("kind", ["opcua", "ca", "pva"])
async def test_a_client_and_its_bridge_may_be_killed(tmp_path: Path, kind: str) -> None:
    ports = {"opcua": free_port(), "ca": free_port(), "pva": free_port()}
    part = (
        sys.executable,
        "-m",
        "tests.studies.bridge_clients",
        str(tmp_path),
        kind,
        json.dumps(ports),
    )
    seen, settings = tmp_path / f"{kind}.jsonl", SERVERS.format(**ports)
    env = {
        "EPICS_PVA_NAME_SERVERS": f"127.0.0.1:{ports['pva']}",
        "EPICS_PVA_ADDR_LIST": "",
    }  # this bridge, no other
    async with held(tmp_path), AsyncExitStack() as stack:
        async with bridges(tmp_path, settings) as bridge:
            async with program(*part, **env):  # killed at the end
                await fresh(seen, time.time())
            client = await stack.enter_async_context(program(*part, **env))
            await fresh(seen, time.time())
            bridge.kill()
            await bridge.wait()
        async with bridges(tmp_path, settings):
            await fresh(seen, time.time())
            assert client.returncode is None, "the same client"
