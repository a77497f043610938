"""The page of a fleet over TLS in a real Chromium: names and roles, and what is refused with which
words.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import json
import socket
import subprocess
from contextlib import AsyncExitStack
from pathlib import Path

import pytest
from typer.testing import CliRunner

from membrane_ctrl.config.port import PortConfig, TlsConfig
from membrane_ctrl.config.service import ServiceConfig
from membrane_ctrl.model.errors import DeviceError, InputError
from membrane_ctrl.web import cli, server
from tests.control_port.port_certificates import Authority, tls_fleet
from tests.support.browser import Tab, browser_tab
from tests.support.machine_needs import needs
from tests.web.test_page import served
from tests.worlds.free_port import free_port
from tests.worlds.port_run import keep_ticking, port_run

PASSWORD = "membrane!"
ROWS = "[...document.querySelectorAll('tbody tr')].map(r => r.innerText)"
BUTTON = "[...document.querySelectorAll('button')].find(b => b.innerText.includes('{}'))"
# the row of each mirror, by the certificate that the page shows or the authority that it trusts
SAYS = {
    "north": "as it should be",
    "reader": "as it should be",
    "foreign": "check the certificate",
    "impostor": "the hold's certificate is not trusted",
    "away": "connection refused",
}


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Certificates of hold, page, operator and reader, and of strangers; two users."""
    folder = tmp_path_factory.mktemp("lab")
    own, stranger = Authority.new(folder / "lab"), Authority.new(folder / "stranger")
    for name, role in (("bench", ""), ("page", ""), ("ann", "operate"), ("rita", "read")):
        own.certificate(name, role)
    for name in ("foreign", "page"):
        stranger.certificate(name, "tune")
    for name, role in (("anna", "operate"), ("bob", "read")):
        words = ["add-user", str(folder / "users"), name, role]
        assert CliRunner().invoke(cli.app, words, input=f"{PASSWORD}\n").exit_code == 0
    return folder


def fleet_file(lab: Path, here: str, other: str) -> Path:
    holds = {
        "north": (here, "lab/ann", "lab/ca.pem"),
        "reader": (here, "lab/rita", "lab/ca.pem"),
        "foreign": (here, "stranger/foreign", "lab/ca.pem"),
        "impostor": (other, "lab/ann", "stranger/ca.pem"),
        "away": (f"127.0.0.1:{free_port()}", "lab/ann", "lab/ca.pem"),
    }
    return tls_fleet(lab / "fleet.toml", holds)


def trusting(certificate: Path) -> str:
    """The flag of a Chromium that trusts this certificate's key, and no other of the lab."""
    words = ["openssl", "x509", "-in", certificate, "-pubkey", "-noout"]
    public = subprocess.run(words, check=True, capture_output=True).stdout
    der = base64.b64decode(b"".join(public.splitlines()[1:-1]))
    return f"--ignore-certificate-errors-spki-list={base64.b64encode(hashlib.sha256(der).digest()).decode()}"  # noqa: E501


async def log_in(tab: Tab, name: str, password: str) -> None:
    for field, text in (("name", name), ("password", password)):
        await tab.until(
            f"(document.querySelector('input[name={field}]').value = {json.dumps(text)}, true)"
        )
    await tab.click("Log in")


def pair(folder: Path) -> tuple[str, ...]:
    return ("--certificate", str(folder / "page.pem"), "--key", str(folder / "page.key"))


@needs("chromium")
@needs("openssl")
@pytest.mark.campaign
@pytest.mark.real_time
async def test_names_and_certificates_decide(tmp_path: Path, lab: Path) -> None:
    bench = lab / "lab" / "bench.pem"
    files = {"certificate_file": str(bench), "key_file": str(bench.with_suffix(".key"))}
    config = PortConfig(tls=TlsConfig(port=0, client_ca_file=str(lab / "lab" / "ca.pem"), **files))
    async with AsyncExitStack() as stack:
        runs = []
        for name in ("one", "two"):  # a hold admits few unknown connections of one address at once
            (tmp_path / name).mkdir()
            runs.append(await stack.enter_async_context(port_run(tmp_path / name, config)))
        tasks = [asyncio.create_task(keep_ticking(run)) for run in runs]
        stack.callback(lambda: [task.cancel() for task in tasks])
        file = fleet_file(lab, *(run.listeners.addresses["tls"] for run in runs))
        options = ("--fleet", str(file), "--users", str(lab / "users"))
        link = await stack.enter_async_context(served(tmp_path, *options, *pair(lab / "lab")))
        false = await stack.enter_async_context(served(tmp_path, *options, *pair(lab / "stranger")))
        assert link.startswith("https://127.0.0.1:")
        trusted = trusting(lab / "lab" / "page.pem")
        tab = await stack.enter_async_context(
            browser_tab(false, tmp_path / "profile", 1500, 1000, trusted)
        )
        await tab.until("document.body.innerText.includes('NET::ERR_CERT_AUTHORITY_INVALID')")
        assert not await tab.value("!!document.querySelector('input[name=password]')"), (
            "no password to a false page"
        )
        await tab.call("Page.navigate", url=link)
        for name, password in (("anna", "of another"), ("eve", PASSWORD), ("", "")):
            await log_in(tab, name, password)
            await tab.until("document.body.innerText.includes('Name or password is wrong')")
            await tab.call("Page.navigate", url=link)
            await tab.until("document.body.innerText.includes('Log in.')")
        await tab.call("Network.setCookie", name="membrane_ctrl", value="forged", url=link)
        assert await tab.value("fetch('/').then(answer => answer.status)") == 401
        await log_in(tab, "anna", PASSWORD)
        for name, says in SAYS.items():
            await tab.until(
                f"{ROWS}.some(r => r.startsWith({name!r}) && r.includes({json.dumps(says)}))"
            )
            there = name in ("north", "reader")
            row = await tab.value(f"{ROWS}.find(r => r.startsWith({name!r}))")
            assert (("0.25" in row), ("no contact" in row)) == (there, not there)
        await tab.until("document.body.innerText.includes('north the-run')")
        await tab.until(f"!{BUTTON.format('Pause')}.disabled")
        await tab.value(f"{BUTTON.format('Pause')}.click()")
        await tab.click("Do it")
        await tab.until("document.body.innerText.includes('pause: done')")
        assert [(each.kind, each.who, each.why) for each in runs[0].asked] == [
            ("pause", "tls:ann", "web: anna")
        ]
        await tab.call(
            "Page.navigate", url=f"{link}?hold=reader"
        )  # anna may, the page's certificate there may not
        await tab.until("document.body.innerText.includes('reader the-run')")
        assert await tab.value(f"{BUTTON.format('STOP')}.disabled")
        await tab.call("Network.clearBrowserCookies")
        await tab.call("Page.navigate", url=link)
        await log_in(tab, "bob", PASSWORD)
        await tab.until("document.body.innerText.includes('bob (read)')")
        await tab.until("document.body.innerText.includes('north the-run')")
        assert await tab.value(f"{BUTTON.format('STOP')}.disabled")
        assert [len(run.asked) for run in runs] == [1, 0]


@needs("openssl")
@pytest.mark.parametrize(
    ("certificate", "key", "says"),
    [
        ("lab/none.pem", "lab/page.key", "none.pem: no such file"),
        ("lab/page.pem", "lab/none.key", "none.key: no such file"),
        ("lab/page.pem", "stranger/page.key", "not a certificate and its unencrypted key"),
        ("users", "lab/page.key", "not a certificate and its unencrypted key"),
    ],
)
def test_a_page_that_cannot_be_served_says_why(
    lab: Path, certificate: str, key: str, says: str
) -> None:
    words = [
        "--users",
        lab / "users",
        "--certificate",
        lab / certificate,
        "--key",
        lab / key,
        "--port",
        free_port(),
    ]
    done = CliRunner().invoke(cli.app, list(map(str, words)))
    assert isinstance(done.exception, InputError)
    assert says in str(done.exception)
    assert "open http" not in done.output, "there is nothing to open"


def test_an_address_that_is_taken_is_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(
            DeviceError,
            match=rf"port: cannot listen on 127.0.0.1:{port} \(address already in use\)",
        ):
            server.require_servable(ServiceConfig(port=port))
    server.require_servable(ServiceConfig(host="::1", port=port))


def test_half_a_pair_is_refused(lab: Path) -> None:
    done = CliRunner().invoke(cli.app, ["--certificate", str(lab / "lab" / "page.pem")])
    assert isinstance(done.exception, InputError)
    assert "certificate and key: give both files" in str(done.exception)
