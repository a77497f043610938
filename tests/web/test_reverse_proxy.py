"""The page behind a real nginx: under a path or not, whatever the proxy does to the path and the
headers.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.support.browser import browser_tab
from tests.support.machine_needs import needs
from tests.support.reverse_proxy import reverse_proxy
from tests.support.service_attacks import ROUTES, Viewer, attack, request_bytes, status_of
from tests.web.test_page import STOP, served
from tests.web.test_page_under_attack import PASSWORD, serving
from tests.worlds.free_port import free_port
from tests.worlds.port_run import PortRun, keep_ticking, port_run

pytestmark = [pytest.mark.real_time, needs("nginx")]
OWN_HOST = "proxy_set_header Host $http_host;"
PREFIX = "proxy_set_header X-Forwarded-Prefix /mirror;"
CLIENT = "proxy_set_header X-Forwarded-For $proxy_add_x_forwarded_for;"


@dataclass(frozen=True, slots=True)
class Setup:
    """What a proxy does: the path it serves, the path it asks for, and its headers."""

    location: str
    target_path: str
    headers: str = ""


SETUPS = {
    "path removed": Setup("/mirror/", "/"),
    "path removed, host kept, prefix named": Setup("/mirror/", "/", f"{OWN_HOST} {PREFIX}"),
    "path removed, prefix named": Setup("/mirror/", "/", PREFIX),
    "path kept": Setup("/mirror/", ""),
    "long path": Setup("/lab/one/mirror/", "/", OWN_HOST),
    "no path": Setup("/", "/"),
}


@asynccontextmanager
async def proxied(folder: Path, setup: Setup, *options: str) -> AsyncIterator[tuple[PortRun, str]]:
    """A hold and its page behind nginx; yields the hold and the public address."""
    outside, inside = free_port(), free_port()
    public = f"http://127.0.0.1:{outside}{setup.location}"
    words = ("--port", str(inside), "--public-url", public, *options)
    target = f"http://127.0.0.1:{inside}{setup.target_path}"
    async with (
        serving(folder, *words) as (run, url),
        reverse_proxy(folder / "nginx", outside, setup.location, target, setup.headers),
    ):
        assert url == public, "the printed link is the public address"
        yield run, public


def socket_request(url: str, session: str, origin: str) -> bytes:
    """What a browser sends to open the page's web socket."""
    upgrade = (
        "Upgrade: websocket",
        "Connection: Upgrade",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==",
        f"Origin: {origin}",
        f"Cookie: {session}",
    )
    return request_bytes(url, ROUTES.socket, "GET", b"", *upgrade)


@pytest.mark.parametrize("name", SETUPS)
async def test_everything_works_under_the_public_address(name: str, tmp_path: Path) -> None:
    setup = SETUPS[name]
    async with proxied(tmp_path, setup) as (run, url), Viewer(url) as anna:
        form = await anna.client.get("")
        assert form.status_code == 401
        assert f'action="{setup.location}login"' in form.text
        answer = await anna.client.post(ROUTES.login, data={"name": "anna", "password": PASSWORD})
        assert (answer.status_code, answer.headers["location"]) == (303, setup.location)
        path = setup.location.rstrip("/") or "/"
        cookies = answer.headers.get_list("set-cookie")
        assert all(f"path={path};" in cookie.lower() for cookie in cookies)
        page = await anna.client.get("")
        assert page.status_code == 200
        origin = "/".join(url.split("/")[:3])
        # every file that the page names is under the public path and there
        files = set(re.findall(r'(?:src|href)="(/[^"]+)"', page.text))
        assert len(files) > 3
        for file in files:
            assert file.startswith(setup.location), file
            assert (await anna.client.get(f"{origin}{file}")).status_code == 200, file
        assert (await anna.client.get(ROUTES.live)).status_code == 200
        session = f"membrane_ctrl={anna.client.cookies['membrane_ctrl']}"
        assert await status_of(url, socket_request(url, session, origin)) == 101
        for foreign in ("http://evil.example", origin.replace("127.0.0.1", "localhost"), "null"):
            assert await status_of(url, socket_request(url, session, foreign)) == 403
        assert (await anna.client.post(ROUTES.stop)).status_code == 200
        assert [command.kind for command in run.asked] == ["stop"]


async def test_the_page_finds_no_other_way_than_its_settings(tmp_path: Path) -> None:
    """A proxy with a path needs the setting: a header that strangers could send as well changes
    nothing.
    """
    async with (
        serving(tmp_path) as (_, url),
        reverse_proxy(tmp_path / "nginx", outside := free_port(), "/mirror/", url, PREFIX),
        Viewer(f"http://127.0.0.1:{outside}/mirror/") as anna,
    ):
        answer = await anna.client.post(ROUTES.login, data={"name": "anna", "password": PASSWORD})
        assert (answer.status_code, answer.headers["location"]) == (303, "/")


@pytest.mark.parametrize("trusted", [True, False])
async def test_a_trusted_proxy_names_the_client_whose_logins_are_limited(
    trusted: bool, tmp_path: Path
) -> None:
    options = ("--trusted-proxy", "127.0.0.1") if trusted else ()
    setup = Setup("/mirror/", "/", CLIENT)
    async with proxied(tmp_path, setup, *options) as (_, url), Viewer(url, "127.0.0.2") as client:
        for number in range(12):
            forged = {"X-Forwarded-For": f"198.51.100.{number}"}
            form = {"name": "anna", "password": "wrong wrong"}
            answer = await client.client.post(ROUTES.login, data=form, headers=forged)
            assert answer.status_code == (401 if number < 5 else 429), (
                "nginx appends the real address"
            )
        # another machine in front of the same proxy, which the test imitates by asking the page
        # itself
        inside = next(
            line.split()[1].rstrip(";")
            for line in (tmp_path / "nginx" / "nginx.conf").read_text().splitlines()
            if "proxy_pass" in line
        )
        form = {"name": "anna", "password": PASSWORD}
        owner = {"X-Forwarded-For": "203.0.113.5"}
        async with Viewer(inside) as proxy:
            answer = await proxy.client.post("login", data=form, headers=owner)
        assert answer.status_code == (303 if trusted else 429)


async def test_a_flood_through_the_proxy_delays_no_viewer(tmp_path: Path) -> None:
    setup = Setup("/mirror/", "/", CLIENT)
    async with (
        proxied(tmp_path, setup, "--trusted-proxy", "127.0.0.1") as (run, url),
        Viewer(url) as anna,
    ):
        assert await anna.log_in("anna", PASSWORD) == 303
        async with attack("logins", url, 100):
            stops_s = await anna.latencies_s(ROUTES.stop, 8, method="POST")
        assert max(stops_s) < 1.0
        assert len(run.asked) == 8


@needs("chromium")
async def test_a_browser_operates_the_hold_under_a_path(tmp_path: Path) -> None:
    outside, inside = free_port(), free_port()
    public = f"http://127.0.0.1:{outside}/mirror/"
    async with (
        port_run(tmp_path) as run,
        served(tmp_path, "--port", str(inside), "--public-url", public) as link,
        reverse_proxy(tmp_path / "nginx", outside, "/mirror/", f"http://127.0.0.1:{inside}/"),
    ):
        assert link.startswith(f"{public}?key=")
        ticks = asyncio.create_task(keep_ticking(run))
        try:
            await asyncio.sleep(1.0)
            async with browser_tab(link, tmp_path / "profile") as tab:
                await tab.until(
                    "document.querySelector('[data-field=error_um]').innerText === '0.25'"
                )
                fetched = (
                    "performance.getEntriesByType('resource').filter(r => "
                    "r.name.includes('/mirror/chart?'))"
                )
                await tab.until(
                    f"{fetched}.some(r => r.responseStatus === 200 && r.decodedBodySize > 500)"
                )
                await tab.value(f"{STOP}.click()")
                await tab.until(
                    "[...document.querySelectorAll('button')].some(b => b.innerText.trim() "
                    "=== 'DO IT')"
                )
                await tab.click("Do it")
                await tab.until("document.body.innerText.includes('stop: done')")
            assert [command.kind for command in run.asked] == ["stop"]
        finally:
            ticks.cancel()
