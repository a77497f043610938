"""Serves the page with NiceGUI, before, during and after holds: on localhost with a link, elsewhere
with TLS and names.
"""

import contextlib
import math
import os
import sys
import time
from functools import partial
from pathlib import Path

from fastapi import Request
from nicegui import Client, app, ui
from starlette.types import ASGIApp

from membrane_ctrl.config.service import ServiceConfig
from membrane_ctrl.control_port.ctl import Where
from membrane_ctrl.control_port.link_code import draw_link_code
from membrane_ctrl.control_port.service_link import link_key, publish_address, read_or_make_secret
from membrane_ctrl.service.accounts import Accounts
from membrane_ctrl.service.alarm_child import AlarmChild
from membrane_ctrl.service.api import make_api
from membrane_ctrl.service.configuration_editor import ConfigurationEditor
from membrane_ctrl.service.connections import ConnectionGuard, GuardedHttp, raise_file_limit
from membrane_ctrl.service.feed import HoldFeed
from membrane_ctrl.service.guided_session import GuidedSession
from membrane_ctrl.service.hold_starter import HoldStarter
from membrane_ctrl.service.idle_end import IdleEnd
from membrane_ctrl.service.listening import require_free_address
from membrane_ctrl.service.login import with_login
from membrane_ctrl.service.path_dispatch import PathDispatch
from membrane_ctrl.service.public_address import PublicAddress, public_address
from membrane_ctrl.service.service_check import read_users, require_usable_files
from membrane_ctrl.service.service_feed import make_feed
from membrane_ctrl.service.tokens import TokenBook, tokens_file
from membrane_ctrl.service.web_user import WebUser
from membrane_ctrl.web.data_routes import add_data_routes
from membrane_ctrl.web.hang_up import HangUp
from membrane_ctrl.web.page import WebPage
from membrane_ctrl.web.shared_views import SharedViews

_NICE = 5  # the hold comes first, also when the page was not started by one
# a viewer may be silent for so long: a phone that changes cells, a machine that builds fifty pages
_AWAY_S = 20.0
_LOOK_AFTER_S = 10.0
_ALARMS_S = 2.0
_MESSAGE_BYTES_MAX = 1_000_000  # of a browser over its web socket; the page has no uploads


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
        Address, certificate, folders and users, from the service's file.
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
        feeds = {name: make_feed(where) for name, where in holds.items()}
        guard = ConnectionGuard(raise_file_limit())
        editor = ConfigurationEditor(Path(page.configurations))
        interface = make_api(feeds, starter, editor)
        _require_login(interface, accounts, address, guard)
        _run_beside_page(feeds, page, starter, guided, idle_s)
        _add_page(feeds, page, starter, editor, guided)
        # Without accounts the link carries the secret that logs in.
        _print_link(address.base_url + ("" if accounts.users else f"?key={accounts.secret}"))
        _serve_page(page, guard)


def _require_login(
    interface: ASGIApp, accounts: Accounts, address: PublicAddress, guard: ConnectionGuard
) -> None:
    """Put the login around page and interface for programs: it sees each request first.

    NiceGUI adds middlewares later than `add_middleware` could: its whole stack is wrapped.
    """
    session_key = read_or_make_secret("session-key")
    build_inside = app.build_middleware_stack

    def build_middleware_stack() -> ASGIApp:
        inside = HangUp(PathDispatch(interface, build_inside()))
        tokens = TokenBook(tokens_file())
        return with_login(inside, accounts, address, session_key, tokens, guard)

    app.build_middleware_stack = build_middleware_stack  # type: ignore[method-assign]


def _run_beside_page(
    feeds: dict[str, HoldFeed],
    page: ServiceConfig,
    starter: HoldStarter,
    guided: GuidedSession,
    idle_s: float,
) -> None:
    """Let run beside the page: a feed for each hold, the alarms, the end of an unused service."""
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


def _add_page(
    feeds: dict[str, HoldFeed],
    page: ServiceConfig,
    starter: HoldStarter,
    editor: ConfigurationEditor,
    guided: GuidedSession,
) -> None:
    """Add the page, and the data that its elements ask for afterwards."""
    views = SharedViews(feeds)

    @ui.page("/", title="membrane_ctrl")
    def view(request: Request, hold: str = "", tab: str = "", gains: str = "") -> None:
        user: WebUser = request.scope["membrane_user"]
        shown = hold if hold in feeds else next(iter(feeds))
        is_ours = feeds[shown].logs == Path(page.logs)
        ours = (starter, editor, guided) if is_ours else (None, None, None)
        WebPage(feeds, shown, user, views, *ours).build(tab, gains)

    add_data_routes(app, feeds, views, guided)


def _print_link(link: str) -> None:
    """Print the link of the page, also as a code for a phone's camera."""
    print(f"membrane-ctrl serve: open {link}", file=sys.stderr, flush=True)
    print(draw_link_code(link), end="", file=sys.stderr, flush=True)


def _serve_page(page: ServiceConfig, guard: ConnectionGuard) -> None:
    """Serve until interrupted, or until the application shuts down."""
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
