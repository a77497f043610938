"""The OPC UA bridge with asyncua's client: calls behind a flood, who may log in, and what each user
may do.
"""

from __future__ import annotations

import asyncio
import dataclasses
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from asyncua import Client, ua
from asyncua.common.node import Node
from asyncua.crypto.cert_gen import generate_private_key, generate_self_signed_app_certificate
from cryptography.hazmat.primitives import serialization
from cryptography.x509.oid import ExtendedKeyUsageOID
from pydantic import ValidationError

from membrane_ctrl.bridges import opcua
from membrane_ctrl.config.bridges import BridgesConfig, OpcuaConfig
from membrane_ctrl.control_port.safety_commands import SAFETY
from membrane_ctrl.model.errors import DeviceError, InputError
from membrane_ctrl.service.accounts import known_user
from tests.bridges.test_bridges import bridge_with, seen_hold
from tests.worlds.free_port import free_port
from tests.worlds.port_run import PortRun, port_run

pytestmark = pytest.mark.usefixtures("slow_answers_allowed")

PRECEDING_MAX = 10  # of about 150 commands that were sent before a safety command
PASSWORDS = {"anna": "the right one", "reto": "only to read"}
ROLES = {"anna": "operate", "reto": "read"}


@pytest.fixture
def users_file(tmp_path: Path) -> str:
    file = tmp_path / "users.txt"
    file.write_text(
        "".join(
            known_user(name, ROLES[name], word).line() + "\n" for name, word in PASSWORDS.items()
        )
    )
    return str(file)


def write_certificate(folder: Path, name: str) -> tuple[str, str]:
    key = generate_private_key()
    uses = [ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH]
    uri = "urn:membrane-ctrl:mirror" if name == "server" else "urn:freeopcua:client"
    certificate = generate_self_signed_app_certificate(
        key, uri, {"commonName": name}, [], extended=uses, days=1
    )
    pem = serialization.Encoding.PEM
    (folder / f"{name}.pem").write_bytes(certificate.public_bytes(pem))
    private = key.private_bytes(
        pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    (folder / f"{name}-key.pem").write_bytes(private)
    return str(folder / f"{name}.pem"), str(folder / f"{name}-key.pem")


@asynccontextmanager
async def bridge(
    folder: Path, role: str = "operate", **settings: object
) -> AsyncIterator[tuple[PortRun, str]]:
    """A run with an OPC UA bridge; yields the run and the server's address."""
    port = free_port()
    seen = dataclasses.replace(seen_hold(), name="the-run", seen_s=time.monotonic() + 1e6)
    async with port_run(folder) as run:
        bridge = bridge_with(role, seen, folder / "control.sock")
        config = OpcuaConfig(port=port, **settings)  # type: ignore[arg-type]
        serving = asyncio.create_task(opcua.serve(config, bridge))
        try:
            async with asyncio.timeout(60.0):
                while not serving.done():
                    try:
                        (await asyncio.open_connection("127.0.0.1", port))[1].close()
                        break
                    except OSError:
                        await asyncio.sleep(0.05)
            if serving.done():
                serving.result()
            yield run, f"opc.tcp://127.0.0.1:{port}/membrane_ctrl"
        finally:
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)
            await bridge.close()


def client_of(url: str, name: str = "", password: str = "") -> Client:
    client = Client(url, timeout=30)
    if name:
        client.set_user(name)
        client.set_password(password)
    return client


async def mirror_of(client: Client) -> tuple[Node, int]:
    space = await client.get_namespace_index("urn:membrane-ctrl:mirror")
    return client.get_node(f"ns={space};s=mirror"), space


async def refusal_of(client: Client) -> str:
    """Name of the status with which a session is refused; empty if it is granted."""
    try:
        await client.connect()
    except ua.UaError as error:
        return type(error).__name__
    await client.disconnect()
    return ""


def call_of(space: int, do: str, *given: str) -> ua.CallMethodRequest:
    method = ua.NodeId(f"mirror.do.{do}", space)
    return ua.CallMethodRequest(
        ua.NodeId("mirror", space), method, [ua.Variant(each) for each in given]
    )


async def answer_to(client: Client, call: ua.CallMethodRequest) -> str:
    (result,) = await client.uaclient.call([call])
    return str(result.OutputArguments[0].Value)


def text_for(kind: str) -> list[str]:
    return ["hands inside"] if kind in ("latch", "lock") else []


async def test_a_safety_command_does_not_wait_for_a_flood_of_calls(
    tmp_path: Path,
) -> None:
    async with bridge(tmp_path) as (run, url), client_of(url) as client:
        _, space = await mirror_of(client)
        for kind in sorted(SAFETY):
            run.asked.clear()
            flood = [
                asyncio.create_task(answer_to(client, call_of(space, "shape_on")))
                for _ in range(150)
            ]
            safe = asyncio.create_task(answer_to(client, call_of(space, kind, *text_for(kind))))
            assert (await safe).endswith(f"opcua: {kind}: done")
            answers = await asyncio.gather(*flood)
            assert all(
                ": done" in each or "too many commands" in each or "takes precedence" in each
                for each in answers
            )
            assert [command.kind for command in run.asked].index(kind) < PRECEDING_MAX


async def test_a_latch_in_one_message_with_many_calls_does_not_wait_for_them(
    tmp_path: Path,
) -> None:
    async with bridge(tmp_path) as (run, url), client_of(url) as client:
        _, space = await mirror_of(client)
        calls = [call_of(space, "mark", "x") for _ in range(149)]
        results = await client.uaclient.call([*calls, call_of(space, "latch", "hands inside")])
        assert results[-1].OutputArguments[0].Value.endswith("latch: done")
        # a few marks may be on their way to the hold when the server comes to the latch
        assert [command.kind for command in run.asked].index("latch") < PRECEDING_MAX


async def test_a_text_that_is_no_number_is_refused(tmp_path: Path) -> None:
    async with bridge(tmp_path) as (run, url), client_of(url) as client:
        mirror, space = await mirror_of(client)
        for text in ("1,000", "1_0", "٣", "nan", "inf", "1e400", "0x10", ""):
            answer = await mirror.call_method(f"{space}:setpoint", text)
            assert "Setpoint: enter a number in µm" in answer, text
        assert run.asked == []


async def test_only_known_users_have_a_session_and_each_has_its_role(
    tmp_path: Path, users_file: str
) -> None:
    async with bridge(tmp_path, users_file=users_file) as (run, url):
        assert await refusal_of(client_of(url)) == "BadIdentityTokenRejected"
        assert await refusal_of(client_of(url, "anna", "the wrong one")) == "BadUserAccessDenied"
        assert await refusal_of(client_of(url, "anna", "")) == "BadUserAccessDenied"
        assert await refusal_of(client_of(url, "admin", "admin")) == "BadUserAccessDenied"
        async with client_of(url, "reto", PASSWORDS["reto"]) as reader:
            mirror, space = await mirror_of(reader)
            assert await reader.get_node(f"ns={space};s=mirror.state").read_value() == "hold"
            for do in ("stop", "shape_on"):
                assert f"{do} refused: needs the role operate" in await mirror.call_method(
                    f"{space}:{do}"
                )
        assert run.asked == []
        async with client_of(url, "anna", PASSWORDS["anna"]) as operator:
            mirror, space = await mirror_of(operator)
            assert (await mirror.call_method(f"{space}:shape_on")).endswith("shape on: done")
        assert [(command.kind, command.why) for command in run.asked] == [
            ("shape_on", "bridge: opcua, anna")
        ]


async def test_the_configured_role_limits_a_user(tmp_path: Path, users_file: str) -> None:
    async with bridge(tmp_path, role="read", users_file=users_file) as (run, url):
        async with client_of(url, "anna", PASSWORDS["anna"]) as operator:
            mirror, space = await mirror_of(operator)
            with pytest.raises(ua.UaError):
                await mirror.call_method(f"{space}:stop")
        assert run.asked == []


@pytest.mark.real_time
async def test_guesses_delay_neither_a_stop_nor_the_owner(tmp_path: Path, users_file: str) -> None:
    async with (
        bridge(tmp_path, users_file=users_file) as (_, url),
        client_of(url, "anna", PASSWORDS["anna"]) as operator,
    ):
        mirror, space = await mirror_of(operator)
        guesses = [
            asyncio.create_task(refusal_of(client_of(url, "anna", f"guess {n}"))) for n in range(40)
        ]
        await asyncio.sleep(0.2)
        begin_s = time.monotonic()
        assert (await mirror.call_method(f"{space}:stop")).endswith("stop: done")
        assert time.monotonic() - begin_s < 1.0
        assert await refusal_of(client_of(url, "anna", PASSWORDS["anna"])) == "", (
            "the owner logs in again"
        )
        assert set(await asyncio.gather(*guesses)) == {"BadUserAccessDenied"}


async def test_encrypted_sessions_only_with_a_certificate(tmp_path: Path, users_file: str) -> None:
    certificate, key = write_certificate(tmp_path, "server")
    own_certificate, own_key = write_certificate(tmp_path, "client")
    settings = {"users_file": users_file, "certificate_file": certificate, "key_file": key}
    async with bridge(tmp_path, **settings) as (_, url):
        plain = client_of(url, "anna", PASSWORDS["anna"])
        assert await refusal_of(plain) != ""
        for password, refusal in (
            (PASSWORDS["anna"], ""),
            ("the wrong one", "BadUserAccessDenied"),
        ):
            client = client_of(url, "anna", password)
            await client.set_security_string(
                f"Basic256Sha256,SignAndEncrypt,{own_certificate},{own_key}"
            )
            assert await refusal_of(client) == refusal


async def test_a_bad_file_is_named(tmp_path: Path) -> None:
    bridge = bridge_with("operate")
    with pytest.raises(InputError, match=r"bridges.opcua.users_file: .*none"):
        await opcua.serve(OpcuaConfig(users_file=str(tmp_path / "none")), bridge)
    (tmp_path / "empty").write_text("# nobody\n")
    with pytest.raises(InputError, match="has no users; add one"):
        await opcua.serve(OpcuaConfig(users_file=str(tmp_path / "empty")), bridge)
    (tmp_path / "junk.pem").write_text("junk")
    junk = str(tmp_path / "junk.pem")
    with pytest.raises(InputError, match=r"bridges.opcua.certificate_file: .*junk"):
        await opcua.serve(
            OpcuaConfig(certificate_file=junk, key_file=junk, port=free_port()), bridge
        )


async def test_a_second_server_on_the_port_is_refused(tmp_path: Path) -> None:
    async with bridge(tmp_path) as (_, url):
        port = int(url.split(":")[2].split("/")[0])
        with pytest.raises(DeviceError, match=r"address already in use.*choose another port"):
            await opcua.serve(OpcuaConfig(port=port), bridge_with("operate"))


def test_what_may_be_configured() -> None:
    everywhere = {"host": "0.0.0.0", "users_file": "users"}
    with pytest.raises(ValidationError, match="plain text; give a certificate"):
        OpcuaConfig(**everywhere)  # type: ignore[arg-type]
    with pytest.raises(ValidationError, match="give both files"):
        OpcuaConfig(certificate_file="a.pem")
    safe = OpcuaConfig(certificate_file="a.pem", key_file="a.key", **everywhere)  # type: ignore[arg-type]
    BridgesConfig(role="operate", opcua=safe)
    with pytest.raises(ValidationError, match="give users_file, or keep role = 'read'"):
        BridgesConfig(role="operate", opcua=OpcuaConfig(host="0.0.0.0"))
