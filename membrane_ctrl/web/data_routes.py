"""What the elements of the page ask for after it: charts, maps and reports.

Long work runs in pools of threads. A full pool answers with 503, and the page asks again.
"""

from fastapi import APIRouter, FastAPI, Request
from fastapi.responses import PlainTextResponse, Response

from membrane_ctrl.control_port.sender import role_includes
from membrane_ctrl.model import errors
from membrane_ctrl.service.feed import SPANS_S, HoldFeed
from membrane_ctrl.service.guided_session import GuidedSession
from membrane_ctrl.service.web_user import WebUser
from membrane_ctrl.service.work_pool import PoolFullError
from membrane_ctrl.service.work_pools import REPORT_FILES, SESSIONS
from membrane_ctrl.web.commissioning_panel import COMMISSIONS
from membrane_ctrl.web.gains_views import parse_setting
from membrane_ctrl.web.report_answers import report_page, session_report
from membrane_ctrl.web.shared_views import SharedViews, parse_removed, parse_signals

_FRESH = {"cache-control": "no-store"}


def add_data_routes(
    app: FastAPI, feeds: dict[str, HoldFeed], views: SharedViews, guided: GuidedSession
) -> None:
    """Add the routes of charts, maps and reports to the application.

    Parameters
    ----------
    app : FastAPI
        The application that serves the page.
    feeds : dict of HoldFeed
        The holds, by name.
    views : SharedViews
        Charts and maps, made once for all viewers.
    guided : GuidedSession
        Has the folders of the commissioning sessions.
    """
    app.add_exception_handler(PoolFullError, _answer_full_pool)
    app.include_router(_make_view_routes(feeds, views))
    app.include_router(_make_report_routes(feeds, guided))


def _make_view_routes(feeds: dict[str, HoldFeed], views: SharedViews) -> APIRouter:
    """Return the routes of charts and maps."""
    router = APIRouter()

    @router.get("/chart")
    async def chart(hold: str, signals: str, span: str, utc: bool) -> Response:
        try:
            names = parse_signals(signals)
        except ValueError:
            return Response(status_code=404)
        if hold not in feeds or span not in SPANS_S:
            return Response(status_code=404)
        return _packed_json(await views.chart(hold, names, span, utc))

    @router.get("/map")
    async def figure_map(hold: str, removed: str, reference: str) -> Response:
        figure = feeds[hold].seen.figure if hold in feeds else None
        try:
            terms = parse_removed(removed)
        except ValueError:
            return Response(status_code=404)
        if figure is None or reference not in views.list_references(hold):
            return Response(status_code=404)
        drawn = await views.map(hold, terms, reference, figure.time_s)
        return _packed_json(drawn.data)

    @router.get("/gains")
    async def gains(hold: str, name: str, start: str, setting: str = "") -> Response:
        try:
            found = await views.gains.explore(hold, name, start, parse_setting(setting))
        except (KeyError, ValueError, errors.InputError):
            return Response(status_code=404)
        return _packed_json(found.charts)

    @router.get("/session-chart")
    async def session_chart(hold: str) -> Response:
        if hold not in feeds or feeds[hold].logs is None:
            return Response(status_code=404)
        return _packed_json(await SESSIONS.run(views.session_chart, hold))

    return router


def _make_report_routes(feeds: dict[str, HoldFeed], guided: GuidedSession) -> APIRouter:
    """Return the routes of the reports of runs and commissioning sessions."""
    router = APIRouter()

    @router.get("/report/{name}")
    async def report(name: str, hold: str = "") -> Response:
        logs = feeds[hold].logs if hold in feeds else None
        return await REPORT_FILES.run(report_page, logs, name)

    @router.get("/commissioning/{name}/{file}")
    async def commissioning_report(request: Request, name: str, file: str) -> Response:
        user: WebUser = request.scope["membrane_user"]
        if not role_includes(user.role, COMMISSIONS):
            return PlainTextResponse(f"needs the role {COMMISSIONS}", 403)
        return await REPORT_FILES.run(session_report, guided, name, file)

    return router


def _answer_full_pool(_: Request, error: Exception) -> Response:
    return PlainTextResponse(str(error), 503)


def _packed_json(content: bytes) -> Response:
    """An answer of JSON in gzip."""
    headers = {**_FRESH, "content-encoding": "gzip"}
    return Response(content, media_type="application/json", headers=headers)
