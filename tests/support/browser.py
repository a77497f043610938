"""A real Chromium for tests, driven over its DevTools protocol: open a page, evaluate, wait, take a
picture.
"""

from __future__ import annotations

import asyncio
import base64
import itertools
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

from tornado.httpclient import AsyncHTTPClient
from tornado.websocket import WebSocketClientConnection, websocket_connect

from tests.support.machine_needs import program_path

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
        """Call a method of the protocol and return its result. Raises AssertionError with the
        browser's error.
        """
        number = next(self._numbers)
        await self._socket.write_message(
            json.dumps({"id": number, "method": method, "params": params})
        )
        while True:
            answer = await self._socket.read_message()
            assert answer is not None, "the browser closed the connection"
            found = json.loads(answer)
            if found.get("id") == number:
                assert "error" not in found, found
                return dict(found["result"])

    async def value(self, script: str) -> Any:
        """Value of a JavaScript expression, which must be plain data."""
        found = await self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    async def until(self, script: str) -> Any:
        """Wait until an expression is true, and return it; a page that is still loading raises
        nothing.
        """
        guarded = f"(() => {{ try {{ return {script} }} catch {{ return null }} }})()"
        async with asyncio.timeout(_PATIENCE_S):
            while not (found := await self._value_if_loaded(guarded)):  # noqa: ASYNC110
                await asyncio.sleep(_LOOK_S)
            return found

    async def _value_if_loaded(self, script: str) -> Any:
        """As `value`; None of a page that has no document yet."""
        try:
            return await self.value(script)
        except AssertionError as error:
            if "execution context" not in str(error):
                raise
            return None

    async def click(self, label: str) -> None:
        """Click the button of that label, also inside shadow roots."""
        await self.until(f"!!({_FIND})(document, {json.dumps(label)})")
        await self.value(f"({_FIND})(document, {json.dumps(label)}).click()")

    async def press(self, *keys: str) -> None:
        """Press keys one after the other, such as `s`, `Enter` or `Tab`."""
        codes = {"Enter": 13, "Tab": 9, "Escape": 27, "ArrowRight": 39}
        for key in keys:
            pressed: dict[str, Any] = {
                "key": key,
                "windowsVirtualKeyCode": codes.get(key, ord(key[0].upper())),
            }
            text = (
                {"text": "\r" if key == "Enter" else key} if key == "Enter" or len(key) == 1 else {}
            )
            await self.call("Input.dispatchKeyEvent", type="keyDown", **pressed, **text)
            await self.call("Input.dispatchKeyEvent", type="keyUp", **pressed)

    async def show_as(self, width: int, height: int, dark: bool = False) -> None:
        """Show the page as on a screen of that size, a phone if it is narrow,
        by day or by night.
        """
        await self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 600,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        await self.call("Emulation.setEmulatedMedia", features=[scheme])
        await self.value("window.before = true")
        await self.call("Page.reload")
        await self.until("!window.before && document.readyState === 'complete'")

    async def screenshot(self, path: Path, whole: bool = True) -> None:
        """Write a picture of the whole page, or of what is on the screen."""
        found = await self.call("Page.captureScreenshot", captureBeyondViewport=whole)
        await asyncio.to_thread(path.write_bytes, base64.b64decode(found["data"]))


@asynccontextmanager
async def browser_tab(
    url: str, folder: Path, width: int = 1500, height: int = 1000, *flags: str
) -> AsyncIterator[Tab]:
    """A tab of a new Chromium on a page; `folder` takes its profile."""
    process = await asyncio.create_subprocess_exec(
        program_path("chromium"),
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--remote-debugging-port=0",
        f"--window-size={width},{height}",
        f"--user-data-dir={folder}",
        *flags,
        "about:blank",
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.DEVNULL,
    )
    try:
        port_file = folder / "DevToolsActivePort"
        async with asyncio.timeout(_PATIENCE_S):
            while not port_file.exists() or not port_file.read_text().strip():  # noqa: ASYNC110
                await asyncio.sleep(_LOOK_S)
        port = int(port_file.read_text().splitlines()[0])
        new = f"http://127.0.0.1:{port}/json/new?{quote(url, safe=':/')}"
        answer = await AsyncHTTPClient().fetch(
            new, method="PUT", body="", request_timeout=_PATIENCE_S
        )
        socket = await websocket_connect(
            json.loads(answer.body)["webSocketDebuggerUrl"], max_message_size=1 << 27
        )
        yield Tab(socket)
        socket.close()
    finally:
        process.terminate()
        await process.wait()
