"""Serves the page with NiceGUI: on localhost with a link, elsewhere with TLS and names."""

import sys
from dataclasses import dataclass
from pathlib import Path

from fastapi import Request
from fastapi.responses import HTMLResponse
from nicegui import app, ui

from membrane_ctrl.config.port import LOCAL_HOSTS
from membrane_ctrl.control_port.ctl import Where
from membrane_ctrl.model import errors, files
from membrane_ctrl.web.access import Accounts, LoginMiddleware, WebUser, known_users
from membrane_ctrl.web.feed import HoldFeed
from membrane_ctrl.web.page import WebPage
from membrane_ctrl.web.panels import REPORT, run_folder

_REPORT_BYTES_MAX = 64_000_000


@dataclass(frozen=True, slots=True)
class WebOptions:
    """Options of the command line."""

    logs: Path
    socket: Path | None
    run: Path | None
    host: str
    port: int
    names: tuple[str, ...]
    users: Path | None
    certificate: Path | None
    key: Path | None


def accounts_of(options: WebOptions) -> Accounts:
    """Who may log in. Raises InputError if the page would be open to others without TLS and users."""
    users = {}
    if options.users is not None:
        try:
            users = known_users(files.read_text(options.users), str(options.users))
        except (OSError, ValueError) as error:
            raise errors.InputError(f"{options.users}: {error}") from None
        if not users:
            raise errors.InputError(f"{options.users}: no users; add one with `membrane-ctrl web add-user`")
    secure = options.certificate is not None and options.key is not None
    if options.host not in LOCAL_HOSTS and not (secure and users):
        raise errors.InputError(
            f"--host {options.host}: other machines need TLS and a login; give --certificate, --key and --users"
        )
    return Accounts(users, secure=secure)


def serve(options: WebOptions) -> None:
    """Serve until interrupted. Raises InputError for options that would open the page to others."""
    accounts = accounts_of(options)
    hosts = frozenset({*LOCAL_HOSTS, options.host, *options.names})
    feed = HoldFeed(Where(options.socket, options.run, logs=options.logs))
    app.add_middleware(LoginMiddleware, accounts=accounts, hosts=hosts)
    app.on_startup(feed.open)
    app.on_shutdown(feed.close)

    @ui.page("/", title="membrane_ctrl")
    def page(request: Request) -> None:
        user: WebUser = request.scope["membrane_user"]
        WebPage([feed], options.logs, user).build()

    @app.get("/report/{name}")
    def report(name: str) -> HTMLResponse:
        return report_page(options.logs, name)

    scheme = "https" if accounts.secure else "http"
    link = f"{scheme}://{options.host}:{options.port}/" + ("" if accounts.users else f"?key={accounts.secret}")
    print(f"membrane-ctrl web: open {link}", file=sys.stderr, flush=True)
    ui.run(
        host=options.host,
        port=options.port,
        title="membrane_ctrl",
        dark=None,
        show=False,
        reload=False,
        show_welcome_message=False,
        ssl_certfile=options.certificate and str(options.certificate),
        ssl_keyfile=options.key and str(options.key),
    )


def report_page(logs: Path, name: str) -> HTMLResponse:
    """A run's report, in a sandbox: a run folder may come from anywhere."""
    folder = run_folder(logs, name)
    if folder is None:
        return HTMLResponse("no such run", 404)
    try:
        text = files.read_bytes(folder / REPORT, _REPORT_BYTES_MAX).decode("utf-8", "replace")
    except OSError:
        return HTMLResponse("no report yet", 404)
    sandbox = "sandbox allow-scripts; default-src 'unsafe-inline' data:"
    return HTMLResponse(text, headers={"content-security-policy": sandbox})
