"""A request that is malformed, broken or hostile gets a status of the 400s,
and the page serves on.
"""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path

import pytest
from tornado.httpclient import HTTPRequest
from tornado.websocket import WebSocketClosedError, WebSocketError, websocket_connect

from tests.support.service_attacks import ROUTES, Viewer, request_bytes, status_of
from tests.web.test_page_under_attack import PASSWORD, serving

TARGETS = (
    "/report/a%00b",
    "/report/%00",
    "/report/..%2f..%2fetc",
    "/report/%2e%2e",
    "/report/" + "a" * 300,
    "/report/" + "a" * 5000,
    "/a%00",
    "/%ff%fe",
    "/%zz",
    "/%",
    "/report/a%0d%0aX:y",
    "/a%1b%5b2J",
    "/..",
    "/../../etc/passwd",
    "//evil",
    "/\x7f",
    "/\u00e4",
    "*",
    "/chart",
    "/chart?hold=&signals=x%00&span=1+min&utc=1",
    "/chart?hold=&signals=error_um&span=1+min&utc=maybe",
    "/chart?hold=&signals=error_um&span=1_0&utc=1",
    "/chart?hold=%00&signals=error_um&span=1+min&utc=1",
    "/chart?" + "a=b&" * 1500,
    "/map?hold=&removed=%ff&reference=x",
    "/map?hold=x&removed=&reference=x",
    "/api/safety/stop?hold=%00",
    "/api/state?hold=%00",
    "/api/history?signal=%ff&span_s=1e999",
    "/api/stream?hold=x",
    "/_nicegui_ws/socket.io/?EIO=x&transport=polling",
    "/_nicegui_ws/socket.io/?EIO=4&transport=polling&sid=bad",
    "/_nicegui/static/%00",
    "/_nicegui/static/..%2f..%2f",
    "/_nicegui/components/%2e%2e",
)
HOSTS = (
    "",
    "[",
    "[::1",
    "[::1]]:1",
    "a b",
    "127.0.0.1:abc",
    "127.0.0.1:99999",
    "127.0.0.1:-1",
    "127.0.0.1:\u0663",
    "[v1.x]",
    "\x00",
    "\u00e4",
    "%",
    "a" * 5000,
    "@",
    "127.0.0.1@evil.example",
    "127.0.0.1,evil.example",
    "evil.example",
    "127.0.0.1.evil.example",
)
MESSAGES = (
    "",
    "4",
    "40",
    "42",
    "42[",
    '42["event"',
    '42["event",{"id":"x","client_id":null}]',
    '42["handshake",{}]',
    '42["javascript_response",[]]',
    '42["\\u0000"]',
    "43",
    "45",
    "451-[",
    '452-["event",{"_placeholder":true,"num":9}]',
    "42" + "[" * 100_000,
    '42["event",' + "1" * 100_000 + "]",
    "9",
    "\u0663",
    "42[NaN,1e999]",
    b"\x00",
    b"\xff" * 100,
)


def head(target: str, host: str, *headers: str, method: str = "GET") -> bytes:
    """A request as it is sent, whatever its target and host contain."""
    lines = [f"{method} {target} HTTP/1.1", f"Host: {host}", *headers]
    if method == "POST":
        lines.append("Content-Length: 0")
    return "\r\n".join([*lines, "", ""]).encode()


@pytest.mark.real_time
async def test_a_malformed_request_gets_a_status_of_the_400s(tmp_path: Path) -> None:
    async with serving(tmp_path) as (run, url), Viewer(url) as anna:
        assert await anna.log_in("anna", PASSWORD) == 303
        host = url.split("/")[2]
        session = f"Cookie: membrane_ctrl={anna.client.cookies['membrane_ctrl']}"
        for target in TARGETS:
            for method in ("GET", "POST", "HEAD", "BREW"):
                for cookie in (session, "Cookie: membrane_ctrl=none"):
                    status = await status_of(url, head(target, host, cookie, method=method))
                    assert 400 <= status < 500, (method, target[:60], cookie[:20], status)
        # the description of the interface is for users only
        for target in ("/docs", "/openapi.json"):
            stranger = await status_of(url, head(target, host, "Cookie: membrane_ctrl=none"))
            assert (stranger, await status_of(url, head(target, host, session))) == (401, 200)
        for name in HOSTS:
            for cookie in (session, "Cookie: membrane_ctrl=none"):
                status = await status_of(url, head("/", name, cookie))
                assert 400 <= status < 500, (name[:60], status)
        for header in (
            f"Host: {host}",
            "Origin: http://[::1",
            "Origin: null",
            "Content-Length: -5",
            "Transfer-Encoding: zz",
            "X-Padding: " + "x" * 40_000,
        ):
            status = await status_of(url, head("/", host, session, header))
            assert 400 <= status < 500, (header, status)
        for body in (
            b"name=%00%ff&password=%ed%a0%80",
            b"\xff\x00&&==;",
            b"&" * 4000,
            b"x" * 5000,
            b"",
        ):
            status = await status_of(url, request_bytes(url, ROUTES.login, "POST", body))
            assert 400 <= status < 500, (body, status)
        for raw in (
            b"\x16\x03\x01\x02\x00\n\n",
            b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
            b"GET / HTTP/9.9\r\n\r\n",
        ):
            assert await status_of(url, raw) in (0, 400)
        # what is only unusual is served, and a header of a stranger is not repeated in the page
        unusual = (
            "Range: bytes=0-,5-,-",
            "If-Modified-Since: never",
            'X-Forwarded-Prefix: "><script>',
        )
        assert await status_of(url, head("/?hold=%00", host, session, *unusual)) == 200
        page = await anna.client.get("", headers={"X-Forwarded-Prefix": "/evil"})
        assert (page.status_code, "/evil" in page.text) == (200, False)
        assert run.asked == []


@pytest.mark.real_time
async def test_a_broken_message_of_a_web_socket_ends_at_most_that_socket(tmp_path: Path) -> None:
    async with serving(tmp_path) as (run, url), Viewer(url) as anna:
        assert await anna.log_in("anna", PASSWORD) == 303
        cookie = f"membrane_ctrl={anna.client.cookies['membrane_ctrl']}"
        address = url.replace("http", "ws", 1) + ROUTES.socket
        for message in MESSAGES:
            socket = await websocket_connect(HTTPRequest(address, headers={"Cookie": cookie}))
            with contextlib.suppress(WebSocketClosedError, WebSocketError):
                await socket.write_message("40")
                await socket.write_message(message, binary=isinstance(message, bytes))
                await asyncio.sleep(0.05)
            socket.close()
            while await socket.read_message() is not None:
                pass
        latencies_s = await anna.latencies_s(ROUTES.live, 3)
        assert max(latencies_s) < 1.0
        assert run.asked == []
