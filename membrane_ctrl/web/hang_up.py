"""Closes the connections of viewers who do not read what they are sent."""

import asyncio
import sys

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from membrane_ctrl.service.web_user import WebUser

_STUCK_S = 20.0  # for a message to leave


class HangUp:
    """ASGI middleware: closes the connection of a viewer who does not read, and prints that.

    Engine.io notices a viewer who does not answer its pings, within 24 s; a viewer who answers but
    cannot be written to is noticed here.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        # Only a web socket shows whether the viewer has left or was cut off here; of HTTP requests
        # nothing is printed
        left = scope["type"] != "websocket"
        has_gone = False

        async def receive_message() -> Message:
            nonlocal left, has_gone
            message = await receive()
            has_gone = has_gone or message["type"] == "http.disconnect"
            left = left or message["type"] == "websocket.disconnect"
            return message

        async def send_message(message: Message) -> None:
            async with asyncio.timeout(_STUCK_S):  # TimeoutError is an OSError: the connection ends
                await send(message)

        try:
            await self._app(scope, receive_message, send_message)
        except RuntimeError:
            # Starlette's middleware raises it if the browser has gone before its answer
            if not has_gone:
                raise
        if not left:
            user: WebUser = scope["membrane_user"]
            print(
                f"membrane-ctrl serve: viewer {user.name} does not read: hung up",
                file=sys.stderr,
                flush=True,
            )
