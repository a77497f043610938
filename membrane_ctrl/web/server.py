"""Serves the page with NiceGUI, before, during and after holds: on localhost with a link, elsewhere
with TLS and names.
"""

import asyncio
import contextlib
import math
import os
import sys
import time
from functools import partial
from pathlib import Path

from fastapi import Request
from fastapi.responses import HTMLResponse, PlainTextResponse, Response
from nicegui import Client, app, ui
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from membrane_ctrl.commissioning.guide import session_state
from membrane_ctrl.config.service import ServiceConfig
from membrane_ctrl.control_port.ctl import Where
from membrane_ctrl.control_port.link_code import draw_link_code
from membrane_ctrl.control_port.sender import role_includes
from membrane_ctrl.control_port.service_link import link_key, publish_address, read_or_make_secret
from membrane_ctrl.model import errors, files
from membrane_ctrl.service.accounts import Accounts
from membrane_ctrl.service.alarm_child import AlarmChild
from membrane_ctrl.service.api import make_api
from membrane_ctrl.service.configuration_editor import ConfigurationEditor
from membrane_ctrl.service.connections import ConnectionGuard, GuardedHttp, raise_file_limit
from membrane_ctrl.service.ended_run import REPORT_NAME
from membrane_ctrl.service.feed import SPANS_S, HoldFeed
from membrane_ctrl.service.guided_session import GuidedSession
from membrane_ctrl.service.hold_starter import HoldStarter
from membrane_ctrl.service.idle_end import IdleEnd
from membrane_ctrl.service.listening import require_free_address
from membrane_ctrl.service.login import with_login
from membrane_ctrl.service.path_dispatch import PathDispatch
from membrane_ctrl.service.public_address import public_address
from membrane_ctrl.service.service_check import read_users, require_usable_files
from membrane_ctrl.service.service_feed import make_feed
from membrane_ctrl.service.tokens import TokenBook, tokens_file
from membrane_ctrl.service.web_user import WebUser
from membrane_ctrl.service.work_pool import PoolFullError
from membrane_ctrl.service.work_pools import REPORT_FILES, SESSIONS
from membrane_ctrl.web.commissioning_panel import COMMISSIONS
from membrane_ctrl.web.gains_views import parse_setting
from membrane_ctrl.web.page import WebPage
from membrane_ctrl.web.runs_panel import run_folder
from membrane_ctrl.web.shared_views import SharedViews, parse_removed, parse_signals

_NICE = 5  # the hold comes first, also when the page was not started by one
# a viewer may be silent for so long: a phone that changes cells, a machine that builds fifty pages
_AWAY_S = 20.0
_STUCK_S = 20.0  # for a message to leave
_REPORT_BYTES_MAX = 64_000_000
_LOOK_AFTER_S = 10.0
_ALARMS_S = 2.0
_MESSAGE_BYTES_MAX = 1_000_000  # of a browser over its web socket; the page has no uploads
_FRESH = {"cache-control": "no-store"}


def accounts_of(page: ServiceConfig) -> Accounts:
    """Who may log in. Raises InputError for a users file that is wrong."""
    attributes = public_address(page).cookie_attributes
    return Accounts(read_users(page), attributes=attributes, secret=link_key())


def require_servable(page: ServiceConfig) -> None:
    """Raise InputError for files of certificate or heartbeat that cannot be used, DeviceError for
    an address that is taken.
    """
    require_usable_files(page)
    require_free_address(page.host, page.port)


def serve(holds: dict[str, Where], page: ServiceConfig, idle_s: float = math.inf) -> None:
    """Serve the page of holds, by name, until interrupted, or unused for a time.

    Parameters
    ----------
    holds : dict of Where
        The one with its runs in `page.logs` can be started here.
    page : ServiceConfig
    idle_s : float
        Time without viewers and holds after which the service ends.

    Raises
    ------
    InputError, DeviceError
        As `accounts_of` and `require_servable`; another service has the folder of runs.
    """
    accounts = accounts_of(page)
    require_servable(page)
    address = public_address(page)
    logs = Path(page.logs)
    # before the priority is lowered, which holds must not inherit
    starter = HoldStarter(logs, Path(page.configurations), page.units)
    guided = GuidedSession(Path(page.commissioning), page.units)
    os.nice(max(0, _NICE - os.nice(0)))
    published = publish_address(logs, address.base_url, not accounts.users)
    with contextlib.closing(starter), contextlib.closing(guided), published:
        _run_server(
            {name: make_feed(where) for name, where in holds.items()},
            page,
            accounts,
            starter,
            guided,
            idle_s,
        )


def _run_server(
    feeds: dict[str, HoldFeed],
    page: ServiceConfig,
    accounts: Accounts,
    starter: HoldStarter,
    guided: GuidedSession,
    idle_s: float,
) -> None:
    # Where the page is reached, who may connect, and what it may edit.
    address = public_address(page)
    guard = ConnectionGuard(raise_file_limit())
    editor = ConfigurationEditor(Path(page.configurations))
    session_key = read_or_make_secret("session-key")
    # The login goes around the whole application: it sees each request first.
    build_inside = app.build_middleware_stack

    def build_middleware_stack() -> ASGIApp:
        """Put the login outside of everything: NiceGUI adds middlewares later than we could with
        `add_middleware`.
        """
        inside = HangUp(PathDispatch(make_api(feeds, starter, editor), build_inside()))
        tokens = TokenBook(tokens_file())
        return with_login(inside, accounts, address, session_key, tokens, guard)

    app.build_middleware_stack = build_middleware_stack  # type: ignore[method-assign]
    # What runs beside the pages: the end of an unused service, the alarms, a feed for each hold.
    idle_end = IdleEnd(idle_s, time.monotonic())
    folders = {feed.logs for feed in feeds.values() if feed.logs is not None}
    alarms = AlarmChild(sorted(folders), page.heartbeat)

    def look_after() -> None:
        """End a service that nobody uses; keep the log of a hold short."""
        viewers = sum(client.has_socket_connection for client in Client.instances.values())
        holding = any(not feed.seen.problem for feed in feeds.values()) or guided.seen.is_running
        idle_end.note_use(time.monotonic(), viewers, holding)
        starter.is_running()  # takes the exit code of a hold that has ended
        starter.limit_log()
        if idle_end.is_due(time.monotonic()):
            print("membrane-ctrl serve: unused; ends", file=sys.stderr, flush=True)
            app.shutdown()

    app.timer(_LOOK_AFTER_S, look_after)
    app.timer(_ALARMS_S, lambda: alarms.look_after(time.monotonic()))
    app.on_shutdown(alarms.close)
    for feed in feeds.values():
        app.on_startup(feed.open)
        app.on_shutdown(feed.close)

    # The page itself, and the data that its elements ask for afterwards. Long work runs in pools of
    # threads; a full pool answers with 503, and the page asks again.
    views = SharedViews(feeds)

    @ui.page("/", title="membrane_ctrl")
    def view(request: Request, hold: str = "", tab: str = "", gains: str = "") -> None:
        user: WebUser = request.scope["membrane_user"]
        shown = hold if hold in feeds else next(iter(feeds))
        is_ours = feeds[shown].logs == Path(page.logs)
        ours = (starter, editor, guided) if is_ours else (None, None, None)
        WebPage(feeds, shown, user, views, *ours).build(tab, gains)

    @app.get("/chart")
    async def chart(hold: str, signals: str, span: str, utc: bool) -> Response:
        try:
            names = parse_signals(signals)
        except ValueError:
            return Response(status_code=404)
        if hold not in feeds or span not in SPANS_S:
            return Response(status_code=404)
        try:
            packed = await views.chart(hold, names, span, utc)
        except PoolFullError as error:
            return PlainTextResponse(str(error), 503)
        return _packed_json(packed)

    @app.get("/map")
    async def picture(hold: str, removed: str, reference: str) -> Response:
        figure = feeds[hold].seen.figure if hold in feeds else None
        try:
            terms = parse_removed(removed)
        except ValueError:
            return Response(status_code=404)
        if figure is None or reference not in views.list_references(hold):
            return Response(status_code=404)
        try:
            drawn = await views.map(hold, terms, reference, figure.time_s)
        except PoolFullError as error:
            return PlainTextResponse(str(error), 503)
        return _packed_json(drawn.data)

    @app.get("/gains")
    async def gains(hold: str, name: str, start: str, setting: str = "") -> Response:
        try:
            found = await views.gains.explore(hold, name, start, parse_setting(setting))
        except (KeyError, ValueError, errors.InputError):
            return Response(status_code=404)
        except PoolFullError as error:
            return PlainTextResponse(str(error), 503)
        return _packed_json(found.charts)

    @app.get("/session-chart")
    async def session_chart(hold: str) -> Response:
        if hold not in feeds or feeds[hold].logs is None:
            return Response(status_code=404)
        try:
            return _packed_json(await SESSIONS.run(views.session_chart, hold))
        except PoolFullError as error:
            return PlainTextResponse(str(error), 503)

    @app.get("/report/{name}")
    async def report(name: str, hold: str = "") -> Response:
        logs = feeds[hold].logs if hold in feeds else None
        try:
            return await REPORT_FILES.run(report_page, logs, name)
        except PoolFullError as error:
            return PlainTextResponse(str(error), 503)

    @app.get("/commissioning/{name}/{file}")
    async def commissioning_report(request: Request, name: str, file: str) -> Response:
        user: WebUser = request.scope["membrane_user"]
        if not role_includes(user.role, COMMISSIONS):
            return PlainTextResponse(f"needs the role {COMMISSIONS}", 403)
        try:
            return await REPORT_FILES.run(session_report, guided, name, file)
        except PoolFullError as error:
            return PlainTextResponse(str(error), 503)

    # Without accounts the link carries the secret that logs in.
    link = address.base_url + ("" if accounts.users else f"?key={accounts.secret}")
    print(f"membrane-ctrl serve: open {link}", file=sys.stderr, flush=True)
    print(draw_link_code(link), end="", file=sys.stderr, flush=True)
    ui.run(
        host=page.host,
        port=page.port,
        title="membrane_ctrl",
        dark=None,
        show=False,
        reload=False,
        show_welcome_message=False,
        reconnect_timeout=_AWAY_S,
        ssl_certfile=page.certificate_file,
        ssl_keyfile=page.key_file,
        ws_per_message_deflate=False,  # updates are small; fifty compressors are not
        ws_max_size=_MESSAGE_BYTES_MAX,
        http=partial(GuardedHttp, guard),
        loop="membrane_ctrl.service.connections:PageLoop" if page.secure else "auto",
        proxy_headers=False,  # `PublicAddress.source_of` reads them, if the proxy is a trusted one
    )


def _packed_json(content: bytes) -> Response:
    """An answer of JSON in gzip."""
    headers = {**_FRESH, "content-encoding": "gzip"}
    return Response(content, media_type="application/json", headers=headers)


class HangUp:
    """ASGI middleware: hangs up on a viewer who does not read, and says so.

    Engine.io notices a viewer who does not answer its pings, within 24 s; a viewer who answers but
    cannot be written to is noticed here.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        left = scope["type"] != "websocket"
        has_gone = False

        async def hear() -> Message:
            nonlocal left, has_gone
            message = await receive()
            has_gone = has_gone or message["type"] == "http.disconnect"
            left = left or message["type"] == "websocket.disconnect"
            return message

        async def tell(message: Message) -> None:
            async with asyncio.timeout(_STUCK_S):  # TimeoutError is an OSError: the connection ends
                await send(message)

        try:
            await self._app(scope, hear, tell)
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


def session_report(guided: GuidedSession, name: str, file: str) -> Response:
    """The report of a commissioning session, HTML or PDF."""
    try:
        folder = guided.find_folder(name)
        if file == session_state.PDF:
            pdf = files.read_bytes(folder / file, _REPORT_BYTES_MAX)
            return Response(pdf, media_type="application/pdf")
        if file == session_state.HTML:
            text = files.read_bytes(folder / file, _REPORT_BYTES_MAX).decode("utf-8", "replace")
            return _sandboxed_page(text)
    except (errors.InputError, OSError, ValueError):
        return HTMLResponse("no report yet", 404)
    return HTMLResponse("no such file", 404)


def _sandboxed_page(text: str) -> HTMLResponse:
    """A page of a folder that may come from anywhere."""
    sandbox = "sandbox allow-scripts; default-src 'unsafe-inline' data:"
    return HTMLResponse(text, headers={"content-security-policy": sandbox})


def report_page(logs: Path | None, name: str) -> HTMLResponse:
    """A run's report, in a sandbox: a run folder may come from anywhere."""
    folder = None if logs is None else run_folder(logs, name)
    if folder is None:
        return HTMLResponse("no such run", 404)
    try:
        text = files.read_bytes(folder / REPORT_NAME, _REPORT_BYTES_MAX).decode("utf-8", "replace")
    except (OSError, ValueError):  # ValueError: a name that no file can have
        return HTMLResponse("no report yet", 404)
    return _sandboxed_page(text)
