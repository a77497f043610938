"""A real Chromium for tests, driven over its DevTools protocol: open a page, evaluate, wait, take a picture."""

from __future__ import annotations

import asyncio
import base64
import itertools
import json
import shutil
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

from tornado.httpclient import AsyncHTTPClient
from tornado.websocket import WebSocketClientConnection, websocket_connect

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
_PATIENCE_S = 180.0  # a page that hangs; with a thirtieth of a core, steps have taken more than 60
_LOOK_S = 0.1
_FIND = """function find(root, label) {
  for (const element of root.querySelectorAll("*")) {
    if (element.tagName === "BUTTON" && element.textContent.trim() === label) return element;
    const found = element.shadowRoot && find(element.shadowRoot, label);
    if (found) return found;
  }
}"""


class Tab:
    """One page of the browser."""

    def __init__(self, socket: WebSocketClientConnection) -> None:
        self._socket, self._numbers = socket, itertools.count(1)

    async def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Call a method of the protocol and return its result. Raises AssertionError with the browser's error."""
        number = next(self._numbers)
        await self._socket.write_message(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            answer = await self._socket.read_message()
            assert answer is not None, "the browser closed the connection"
            found = json.loads(answer)
            if found.get("id") == number:
                assert "error" not in found, found
                return dict(found["result"])

    async def value(self, script: str) -> Any:
        """Value of a JavaScript expression, which must be plain data."""
        found = await self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    async def until(self, script: str) -> Any:
        """Wait until an expression is true, and return it; a page that is still loading raises nothing."""
        guarded = f"(() => {{ try {{ return {script} }} catch {{ return null }} }})()"
        async with asyncio.timeout(_PATIENCE_S):
            while not (found := await self.value(guarded)):  # noqa: ASYNC110
                await asyncio.sleep(_LOOK_S)
            return found

    async def click(self, label: str) -> None:
        """Click the button of that label, also inside shadow roots."""
        await self.until(f"!!({_FIND})(document, {json.dumps(label)})")
        await self.value(f"({_FIND})(document, {json.dumps(label)}).click()")

    async def screenshot(self, path: Path) -> None:
        """Write a picture of the whole page."""
        found = await self.call("Page.captureScreenshot", captureBeyondViewport=True)
        await asyncio.to_thread(path.write_bytes, base64.b64decode(found["data"]))


@asynccontextmanager
async def browser_tab(
    url: str, folder: Path, width: int = 1500, height: int = 1000, *flags: str
) -> AsyncIterator[Tab]:
    """A tab of a new Chromium on a page; `folder` takes its profile."""
    assert CHROMIUM is not None
    process = await asyncio.create_subprocess_exec(
        CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0",
        f"--window-size={width},{height}", f"--user-data-dir={folder}", *flags, "about:blank",
        stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.DEVNULL,
    )  # fmt: skip
    try:
        port_file = folder / "DevToolsActivePort"
        async with asyncio.timeout(_PATIENCE_S):
            while not port_file.exists() or not port_file.read_text().strip():  # noqa: ASYNC110
                await asyncio.sleep(_LOOK_S)
        port = int(port_file.read_text().splitlines()[0])
        new = f"http://127.0.0.1:{port}/json/new?{quote(url, safe=':/')}"
        answer = await AsyncHTTPClient().fetch(new, method="PUT", body="", request_timeout=_PATIENCE_S)
        socket = await websocket_connect(json.loads(answer.body)["webSocketDebuggerUrl"], max_message_size=1 << 27)
        yield Tab(socket)
        socket.close()
    finally:
        process.terminate()
        await process.wait()
