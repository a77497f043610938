"""Mutual TLS with real certificates: clients with none, an old one or a stranger's stay out."""

from __future__ import annotations

import asyncio
import socket
import ssl
import time
from pathlib import Path

import pytest
from port_certificates import Authority

from membrane_ctrl.config.port import PortConfig, TlsConfig
from membrane_ctrl.control_port.client import PortClient
from membrane_ctrl.control_port.protocol import Peer
from membrane_ctrl.control_port.sockets import TlsListener, client_context
from membrane_ctrl.model.errors import DeviceError, InputError
from tests.support.machine_needs import needs
from tests.worlds.port_run import PortRun, port_run

pytestmark = needs("openssl")


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority.new(tmp_path_factory.mktemp("tls") / "lab")


@pytest.fixture(scope="module")
def config(lab: Authority) -> PortConfig:
    certificate, key = lab.certificate("bench")
    tls = TlsConfig(
        port=0, certificate_file=str(certificate), key_file=str(key), client_ca_file=str(lab.own)
    )
    return PortConfig(tls=tls)


def address_of(run: PortRun) -> tuple[str, int]:
    host, port = run.listeners.addresses["tls"].split(":")
    return host, int(port)


def greet(run: PortRun, pair: tuple[Path, Path], authority: Path) -> dict[str, object]:
    context = client_context(*pair, authority)
    with PortClient.tls(*address_of(run), context, print) as client:
        return client.greeting


@pytest.mark.parametrize(
    ("unit", "role"), [("read", "read"), ("operate", "operate"), ("tune", "tune"), ("king", "read")]
)
async def test_name_and_role_are_the_certificates(
    tmp_path: Path, lab: Authority, config: PortConfig, unit: str, role: str
) -> None:
    pair = lab.certificate(f"person-{unit}", unit)
    async with port_run(tmp_path, config) as run:
        greeting = await asyncio.to_thread(greet, run, pair, lab.own)
    assert (greeting["you"], greeting["role"]) == (f"tls:person-{unit}", role)


async def test_a_command_by_tls(tmp_path: Path, lab: Authority, config: PortConfig) -> None:
    context = client_context(*lab.certificate("ann", "operate"), lab.own)

    def stop() -> dict[str, object]:
        with PortClient.tls(*address_of(run), context, print) as client:
            return client.ask(do="stop", why="by tls")

    async with port_run(tmp_path, config) as run:
        assert (await asyncio.to_thread(stop))["ok"]
    assert (run.asked[0].who, run.asked[0].why) == ("tls:ann", "by tls")


async def test_an_expired_certificate_stays_out_and_is_recorded(
    tmp_path: Path, lab: Authority, config: PortConfig
) -> None:
    dates = ("-startdate", "20200101000000Z", "-enddate", "20200102000000Z")
    pair = lab.certificate("late", "tune", dates)
    async with port_run(tmp_path, config) as run:
        with pytest.raises(DeviceError, match=r"expired|no greeting"):
            await asyncio.to_thread(greet, run, pair, lab.own)
        (refused,) = run.of_kind("refused")
        assert "certificate has expired" in refused["reason"]


async def test_a_connection_does_not_outlive_its_certificate(
    tmp_path: Path, lab: Authority, config: PortConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    context = client_context(*lab.certificate("brief", "operate"), lab.own)
    monkeypatch.setattr(TlsListener, "lasts_s", lambda *_: 0.3)
    notices: list[str] = []

    def talk() -> None:
        with PortClient.tls(*address_of(run), context, notices.append) as client:
            while True:
                client.ask(do="status")

    async with port_run(tmp_path, config) as run:
        with pytest.raises(DeviceError):
            await asyncio.to_thread(talk)
        (refused,) = run.of_kind("refused")
    assert (refused["who"], refused["reason"]) == ("tls:brief", "the certificate has expired")
    assert notices == ["the certificate has expired"]


def test_how_long_a_certificate_lasts(config: PortConfig) -> None:
    assert config.tls is not None
    listener = TlsListener(config.tls)
    in_an_hour = time.strftime("%b %d %H:%M:%S %Y GMT", time.gmtime(time.time() + 3600))
    assert listener.lasts_s({"notAfter": in_an_hour}) == pytest.approx(3600, abs=60)
    listener.close()


def test_who_has_no_name_only_reads(config: PortConfig) -> None:
    assert config.tls is not None
    listener = TlsListener(config.tls)
    unit = (("organizationalUnitName", "tune"),)
    assert listener.peer({"subject": (unit,)}) == Peer("tls:nameless", "read")
    assert listener.peer({"subject": (unit, (("commonName", " "),))}) == Peer(
        "tls:nameless", "read"
    )
    assert listener.peer({"subject": (unit, (("commonName", "bea"),))}) == Peer("tls:bea", "tune")
    listener.close()


async def test_a_strangers_certificate_stays_out(
    tmp_path: Path, lab: Authority, config: PortConfig
) -> None:
    stranger = Authority.new(tmp_path / "stranger")
    pair = stranger.certificate("eve", "tune")
    async with port_run(tmp_path, config) as run:
        with pytest.raises(DeviceError):
            await asyncio.to_thread(greet, run, pair, lab.own)
        assert len(run.of_kind("refused")) == 1


async def test_a_bench_of_another_authority_is_not_trusted(
    tmp_path: Path, lab: Authority, config: PortConfig
) -> None:
    stranger = Authority.new(tmp_path / "stranger")
    pair = lab.certificate("bea", "operate")
    async with port_run(tmp_path, config) as run:
        with pytest.raises(DeviceError, match="the hold's certificate is not trusted"):
            await asyncio.to_thread(greet, run, pair, stranger.own)


async def test_without_a_certificate_or_without_tls(
    tmp_path: Path, lab: Authority, config: PortConfig
) -> None:
    naked = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    naked.load_verify_locations(lab.own)

    def plain() -> bytes:
        with socket.create_connection(address_of(run), timeout=60) as connection:
            connection.sendall(b'{"do": "stop"}\n')
            try:
                return connection.recv(1000)
            except ConnectionResetError:
                return b""

    async with port_run(tmp_path, config) as run:
        with pytest.raises(DeviceError):
            await asyncio.to_thread(PortClient.tls, *address_of(run), naked, print)
        assert b"membrane_ctrl" not in await asyncio.to_thread(plain)
        assert len(run.of_kind("refused")) == 2
        assert run.asked == []


async def test_who_never_shakes_hands_is_dropped(
    tmp_path: Path, config: PortConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("membrane_ctrl.control_port.protocol._HANDSHAKE_S", 0.1)
    async with port_run(tmp_path, config) as run:
        reader, writer = await asyncio.open_connection(*address_of(run))
        assert await asyncio.wait_for(reader.read(), 10) == b""
        writer.close()
        await writer.wait_closed()


def test_files_that_are_none_are_one_line(tmp_path: Path, lab: Authority) -> None:
    certificate, key = lab.certificate("good")
    good = {
        "certificate_file": str(certificate),
        "key_file": str(key),
        "client_ca_file": str(lab.own),
    }
    empty = tmp_path / "empty.pem"
    empty.write_text("")
    for field, path, says in [
        ("certificate_file", tmp_path / "none.pem", "no such file"),
        ("certificate_file", empty, "not a certificate and its unencrypted key"),
        ("key_file", lab.folder / "ca.key", "not a certificate and its unencrypted key"),
        ("client_ca_file", empty, "not an authority's certificate"),
    ]:
        with pytest.raises(InputError, match=says):
            TlsListener(TlsConfig(port=0, **{**good, field: str(path)}))


def test_an_address_in_use_is_one_line(lab: Authority) -> None:
    certificate, key = lab.certificate("second")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        config = TlsConfig(
            port=taken.getsockname()[1],
            certificate_file=str(certificate),
            key_file=str(key),
            client_ca_file=str(lab.own),
        )
        with pytest.raises(DeviceError, match=r"port\.tls: cannot listen"):
            TlsListener(config)
