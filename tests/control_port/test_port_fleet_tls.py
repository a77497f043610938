"""A fleet over mutual TLS: each mirror that cannot be asked is one clear line, and the others go
on.
"""

from __future__ import annotations

import asyncio
import shutil
import socket
from collections.abc import AsyncIterator, Iterator
from contextlib import AsyncExitStack, ExitStack, asynccontextmanager
from pathlib import Path

import pytest
from port_certificates import Authority, tls_fleet

from membrane_ctrl.cli import run as command
from membrane_ctrl.config.port import PortConfig, TlsConfig
from membrane_ctrl.control_port import ctl
from membrane_ctrl.control_port.ctl import fleet
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.service.feed import HoldFeed
from tests.support.machine_needs import needs
from tests.worlds.port_run import PATIENCE_S, PortRun, port_run

pytestmark = needs("openssl")

SAID = {  # what the line of each says, besides its address
    "north": "as it should be",
    "reader": "as it should be",
    "foreign": "check the certificate",
    "impostor": "the hold's certificate is not trusted: self-signed certificate in certificate chain",  # noqa: E501
    "other-name": "the hold's certificate is not trusted: Hostname mismatch",
    "away": "connection refused",
    "unknown": "",  # the resolver's words
    "silent": "no TLS answer",
    "lost-key": "lost.key: no such file",
}


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Certificates of a hold, an operator and a reader, and those of strangers."""
    folder = tmp_path_factory.mktemp("fleet")
    own, stranger = Authority.new(folder / "lab"), Authority.new(folder / "stranger")
    for name, role in (("bench", ""), ("ann", "operate"), ("rita", "read")):
        own.certificate(name, role)
    stranger.certificate("foreign", "tune")
    return folder


@pytest.fixture
def ports(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, int]]:
    """A port where nobody listens, and one that never answers."""
    monkeypatch.setattr(ctl, "_FLEET_S", 6.0)
    monkeypatch.setattr("membrane_ctrl.service.feed.ANSWER_S", 3.0)
    with ExitStack() as stack:
        away = socket.create_server(("127.0.0.1", 0))
        silent = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        found = {"away": away.getsockname()[1], "silent": silent.getsockname()[1]}
        away.close()
        yield found


def hold_of(lab: Path) -> PortConfig:
    bench = lab / "lab" / "bench.pem"
    files = {"certificate_file": str(bench), "key_file": str(bench.with_suffix(".key"))}
    return PortConfig(tls=TlsConfig(port=0, client_ca_file=str(lab / "lab" / "ca.pem"), **files))


@asynccontextmanager
async def two_holds(lab: Path, folder: Path) -> AsyncIterator[list[PortRun]]:
    """Two, because a hold admits few unknown connections of one address at once."""
    async with AsyncExitStack() as stack:
        for name in ("one", "two"):
            (folder / name).mkdir()
        yield [
            await stack.enter_async_context(port_run(folder / name, hold_of(lab)))
            for name in ("one", "two")
        ]


def fleet_file(lab: Path, ports: dict[str, int], runs: list[PortRun]) -> Path:
    """A fleet file; its mirrors are one of the two holds, or none."""
    there, other = (run.listeners.addresses["tls"] for run in runs)
    known, nobody = (there, "lab/ann", "lab/ca.pem"), "lab/lost"
    holds = {
        "north": known,
        "reader": (there, "lab/rita", "lab/ca.pem"),
        "foreign": (there, "stranger/foreign", "lab/ca.pem"),
        "impostor": (other, "lab/ann", "stranger/ca.pem"),
        "other-name": (other.replace("127.0.0.1", "localhost"), *known[1:]),
        "away": (f"127.0.0.1:{ports['away']}", *known[1:]),
        "unknown": ("no-such-host.invalid:7470", *known[1:]),
        "silent": (f"127.0.0.1:{ports['silent']}", *known[1:]),
        "lost-key": (there, nobody, "lab/ca.pem"),
    }
    shutil.copy(lab / "lab" / "ann.pem", lab / "lab" / "lost.pem")
    return tls_fleet(lab / "fleet.toml", holds)


async def test_the_terminal_has_a_line_of_each(
    tmp_path: Path, lab: Path, ports: dict[str, int], capsys: pytest.CaptureFixture[str]
) -> None:
    async with two_holds(lab, tmp_path) as runs:
        file = fleet_file(lab, ports, runs)
        assert await asyncio.to_thread(command, ["ctl", "fleet", str(file)]) == Exit.DEVICE_FAILED
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(SAID)
    for line, (name, says) in zip(lines, SAID.items(), strict=True):
        assert says.lower() in line.lower()
        assert ("no contact" in line) is (name not in ("north", "reader")), line
        assert ("0.25 µm" in line) is (name in ("north", "reader")), line
        assert "_ssl.c" not in line, "for people, not for programmers"


async def test_the_page_follows_each_and_asks_by_the_certificates_role(
    tmp_path: Path, lab: Path, ports: dict[str, int]
) -> None:
    async with two_holds(lab, tmp_path) as runs:
        feeds = {
            name: HoldFeed(where) for name, where in fleet(fleet_file(lab, ports, runs)).items()
        }
        try:
            for feed in feeds.values():
                feed.open()
            async with asyncio.timeout(PATIENCE_S):
                for feed in feeds.values():
                    while feed.seen.problem == ("not connected yet"):  # noqa: ASYNC110, it is a thread that changes it
                        await asyncio.sleep(0.05)
            problems = {name: feed.seen.silent for name, feed in feeds.items()}
            assert [name for name, problem in problems.items() if not problem] == [
                "north",
                "reader",
            ]
            assert all(
                SAID[name].lower() in problem.lower()
                for name, problem in problems.items()
                if problem
            )
            assert [feeds[name].seen.role for name in ("north", "reader")] == ["operate", "read"]
            request = {"do": "pause", "why": "web: anna"}
            said = {
                name: await asyncio.to_thread(feeds[name].ask, request)
                for name in ("reader", "north", "away")
            }
            assert said["north"].text == "pause: done"
            assert "refused" in said["reader"].text
            assert "connection refused" in said["away"].text
            assert [(each.kind, each.who) for each in runs[0].asked] == [("pause", "tls:ann")]
        finally:
            for feed in feeds.values():
                await asyncio.to_thread(feed.close)
