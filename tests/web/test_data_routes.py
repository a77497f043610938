"""Charts and reports that the page asks for."""

from types import SimpleNamespace
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from starlette.types import ASGIApp, Receive, Scope, Send

from membrane_ctrl.service.web_user import WebUser
from membrane_ctrl.service.work_pool import PoolFullError
from membrane_ctrl.web.data_routes import add_data_routes

CHART = {"hold": "", "signals": "displacement_um", "span": "1 h", "utc": "false"}


class FullViews:
    """Views whose pool of threads is full."""

    async def chart(self, *_: object) -> bytes:
        raise PoolFullError("charts: too many requests are waiting; try again")


class LoggedIn:
    """Middleware that states the user of every request."""

    def __init__(self, app: ASGIApp, user: WebUser) -> None:
        self._app = app
        self._user = user

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        scope["membrane_user"] = self._user
        await self._app(scope, receive, send)


@pytest.fixture
def client() -> httpx.AsyncClient:
    app = FastAPI()
    feeds: Any = {"": SimpleNamespace(logs=None)}
    views: Any = FullViews()
    guided: Any = SimpleNamespace()
    add_data_routes(app, feeds, views, guided)
    app.add_middleware(LoggedIn, user=WebUser("anna", "read"))
    transport = httpx.ASGITransport(app)
    return httpx.AsyncClient(transport=transport, base_url="http://service")


async def test_a_full_pool_answers_with_503_and_the_reason(client: httpx.AsyncClient) -> None:
    answer = await client.get("/chart", params=CHART)
    assert answer.status_code == 503
    assert "too many requests" in answer.text


@pytest.mark.parametrize("wrong", [{"hold": "other"}, {"span": "a while"}, {"signals": "none"}])
async def test_an_unknown_chart_is_not_found(
    client: httpx.AsyncClient, wrong: dict[str, str]
) -> None:
    answer = await client.get("/chart", params=CHART | wrong)
    assert answer.status_code == 404


async def test_a_reader_does_not_see_the_report_of_a_commissioning_session(
    client: httpx.AsyncClient,
) -> None:
    answer = await client.get("/commissioning/bench/report.html")
    assert answer.status_code == 403
