"""`POST /stop?hold=NAME`: the stop command on a path that shares nothing slow with the rest of the
page.

The login answers it before the page's routes, a thread of the pool of safety commands sends it, and
the connection to the hold serves this command only.
"""

from __future__ import annotations

from collections.abc import Mapping
from http import HTTPStatus

from membrane_ctrl.service.access import STOP, WebUser, may, on_behalf, request
from membrane_ctrl.service.feed import HoldFeed
from membrane_ctrl.service.login import StopHandler
from membrane_ctrl.service.work_pools import SAFETY_COMMANDS, PoolFullError


def stop_handler(feeds: Mapping[str, HoldFeed]) -> StopHandler:
    """Return what stops the hold of a name, or answers why not."""

    async def stop(user: WebUser, hold: str) -> tuple[HTTPStatus, str]:
        feed = feeds.get(hold)
        if feed is None:
            return HTTPStatus.NOT_FOUND, f"stop: no hold {hold!r}; known: {', '.join(feeds)}"
        if not may(user, feed.seen.role, STOP):
            return (
                HTTPStatus.FORBIDDEN,
                f"stop: needs the role {STOP.role}, of the viewer and of the page",
            )
        asked = request(STOP, f"web: {user.name}", "", take_over=True)
        asked["on_behalf"] = on_behalf(user, "stop")
        try:
            outcome = await SAFETY_COMMANDS.run(feed.ask, asked)
        except PoolFullError as error:
            return HTTPStatus.SERVICE_UNAVAILABLE, f"stop: not sent: {error}"
        return (HTTPStatus.OK if outcome.done else HTTPStatus.CONFLICT), outcome.text

    return stop
