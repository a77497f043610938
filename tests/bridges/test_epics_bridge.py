"""Two servers of one EPICS record are refused, on one machine and across machines."""

from __future__ import annotations

import asyncio
import dataclasses
import socket
import sys
import threading
from pathlib import Path

import pytest

from membrane_ctrl.bridges import epics
from membrane_ctrl.bridges.epics_search import find_server, require_unserved
from membrane_ctrl.config.bridges import EpicsConfig
from membrane_ctrl.instruments import device_claim
from membrane_ctrl.model.errors import DeviceError
from tests.bridges.test_bridge_clients import SERVERS, bridges, held, program
from tests.bridges.test_bridges import bridge_with, seen_hold
from tests.worlds.free_port import free_port
from tests.worlds.port_run import port_run


async def test_a_second_bridge_of_the_same_records_on_this_machine_is_refused() -> None:
    # A name of its own: claims are of the whole machine, where other tests run meanwhile
    config = EpicsConfig(ca_port=free_port(), pva_port=free_port())
    bridge = bridge_with(name="claimed")
    with (
        device_claim.claim_devices(["EPICS records claimed:*"]),
        pytest.raises(DeviceError, match=r"EPICS records claimed:\*: in use by"),
    ):
        await epics.serve(config, bridge)


@pytest.mark.campaign
@pytest.mark.real_time
async def test_two_bridges_of_one_prefix_with_different_ports(tmp_path: Path) -> None:
    ports = {"opcua": free_port(), "ca": free_port(), "pva": free_port()}
    others = {"opcua": free_port(), "ca": free_port(), "pva": free_port()}
    only_epics = "[bridges.epics]" + SERVERS.partition("[bridges.epics]")[2]
    async with held(tmp_path), bridges(tmp_path, only_epics.format(**ports)) as first:
        assert (
            await asyncio.to_thread(find_server, "mirror:state", [("127.0.0.1", ports["ca"])])
            == "127.0.0.1"
        )
        assert (
            await asyncio.to_thread(find_server, "other:state", [("127.0.0.1", ports["ca"])]) == ""
        )
        second = tmp_path / "second"
        second.mkdir()
        (second / "lab.toml").write_text(only_epics.format(**others))
        words = (
            "-m",
            "membrane_ctrl",
            "bridges",
            "--config",
            str(second / "lab.toml"),
            "--logs",
            str(tmp_path),
        )
        async with program(sys.executable, *words) as process, asyncio.timeout(120.0):
            out = (await process.communicate())[0].decode()
        assert process.returncode == 4
        assert "EPICS records mirror:*: in use by" in out
        assert first.returncode is None


def test_a_server_elsewhere_that_has_the_record_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))
        port = server.getsockname()[1]

        def answer_once() -> None:
            request, peer = server.recvfrom(1024)
            assert b"mirror:state\0" in request
            version, reply = (
                request[:16],
                bytes([0, 6, 0, 8, 0x13, 0xC8, 0, 0]) + b"\xff" * 4 + b"\0\0\0\1" + b"\0" * 8,
            )
            server.sendto(version + reply, peer)

        thread = threading.Thread(target=answer_once)
        thread.start()
        monkeypatch.setenv("EPICS_CA_ADDR_LIST", f"127.0.0.1:{port}")
        with pytest.raises(
            DeviceError, match=r"another server \(127.0.0.1\) has the record mirror:state"
        ):
            require_unserved("mirror:state", free_port())
        thread.join()


@pytest.mark.parametrize(
    "reply", [b"", b"\0" * 15, b"\0" * 16, b"\xff" * 200, b"\0\0\xff\xff" + b"\0" * 12]
)
def test_garbage_is_no_reply(reply: bytes) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))

        def answer_once() -> None:
            _, peer = server.recvfrom(1024)
            server.sendto(reply, peer)

        thread = threading.Thread(target=answer_once)
        thread.start()
        assert find_server("mirror:state", [("127.0.0.1", server.getsockname()[1])]) == ""
        thread.join()


async def test_a_put_flood_of_one_record_does_not_delay_a_latch(tmp_path: Path) -> None:
    """Each record hands its value to the bridge on its own; what waits there is bounded."""
    async with port_run(tmp_path) as run:
        seen = dataclasses.replace(seen_hold(), name="the-run")
        bridge = bridge_with("operate", seen, tmp_path / "control.sock")
        flood = [asyncio.create_task(bridge.ask("epics", "shape_on", 1)) for _ in range(150)]
        async with asyncio.timeout(1.0):
            assert (await bridge.ask("epics", "latch", "hands inside")).endswith("latch: done")
        await asyncio.gather(*flood)
        assert "latch" in [command.kind for command in run.asked][:2]
