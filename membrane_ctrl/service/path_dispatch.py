"""Sends requests of programs to the interface for programs, all others to the page.

The two are separate applications: nothing that the page does for its viewers, such as its sessions
and middlewares, is in the way of a command.
"""

from __future__ import annotations

from starlette.types import ASGIApp, Receive, Scope, Send

from membrane_ctrl.service.api import PATHS


class PathDispatch:
    """ASGI application.

    Parameters
    ----------
    api : ASGIApp
        Gets `/api`, `/docs`, `/openapi.json` and `/metrics`.
    page : ASGIApp
        Gets the rest, and the events of start and end.
    """

    def __init__(self, api: ASGIApp, page: ASGIApp) -> None:
        self._api = api
        self._page = page

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        path = scope.get("path", "")
        is_api = any(path == each or path.startswith(f"{each}/") for each in PATHS)
        await (self._api if is_api else self._page)(scope, receive, send)
