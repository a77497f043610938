"""Asks each request for its session, and refuses what is malformed or comes from elsewhere.

The address bar is not enough: any program on this machine, and any page in a browser on it, can
reach a port of localhost. So every request needs a session cookie, which a link with a secret or a
password gives; requests with a foreign `Host` (DNS rebinding) or `Origin` (another page, also over
web sockets) are refused, and the cookie is never sent by other sites (`SameSite=Strict`).

Strangers share the event loop with viewers, so what they may cause is bounded: a request of a
stranger costs a few comparisons, the body of a login is short and in time, and passwords are
evaluated in pools of their own after the throttle has admitted them (429), or not at all while too
many wait (503).
"""

from __future__ import annotations

import asyncio
import html
import math
from dataclasses import dataclass
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import Literal
from urllib.parse import parse_qs, urlencode

from starlette.middleware.sessions import SessionMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from membrane_ctrl.service.accounts import DEVICE_COOKIE, SESSION_COOKIE, SESSION_S, Accounts
from membrane_ctrl.service.connections import ConnectionGuard
from membrane_ctrl.service.public_address import PublicAddress, host_name
from membrane_ctrl.service.tokens import TokenBook
from membrane_ctrl.service.web_user import WebUser
from membrane_ctrl.service.work_pool import PoolFullError
from membrane_ctrl.service.work_pools import KNOWN_PASSWORDS, STRANGERS_PASSWORDS

LOGIN_PATH = "/login"
_FORM_BYTES_MAX = 4096
_FORM_S = 5.0
_TARGET_LENGTH_MAX = 4096
_HEAD_BYTES_MAX = 32_768
# Strangers who are refused wait so long for the answer, each on its connection. The event loop
# serves in turn what is ready, and a STOP takes several turns: a hundred clients that try again at
# once would make each turn long.
_REFUSED_S = 1.0
_BUSY_S = 1.0  # until passwords that wait have been evaluated

Header = tuple[bytes, bytes]

_LOGIN = """<!doctype html><html lang="en"><meta charset="utf-8"><title>membrane_ctrl</title>
<meta name="viewport" content="width=device-width,initial-scale=1">
<style>:root{{color-scheme:light dark}}body{{font:16px sans-serif;max-width:22em;margin:15vh auto;padding:0 1em}}
input,button{{font:inherit;width:100%;padding:.5em;margin:.3em 0;box-sizing:border-box}}</style>
<h1>membrane_ctrl</h1><p>{said}</p>{form}</html>"""  # noqa: E501
_FORM = """<form method="post" action="{action}">
<label>Name<input name="name" autocomplete="username" autofocus></label>
<label>Password<input name="password" type="password" autocomplete="current-password"></label>
<button>Log in</button></form>"""


_HEADERS: tuple[Header, ...] = (
    (b"x-frame-options", b"DENY"),  # no other page may lay itself over the stop button
    (b"x-content-type-options", b"nosniff"),
    # the link's secret stays here; with `no-referrer` a browser would send the login form with the
    # origin `null`
    (b"referrer-policy", b"same-origin"),
)
_BEARER = "bearer "
_PLACE = ("hold", "tab", "gains")  # names of a query that show a part of the page
_CLOSE: Header = (b"connection", b"close")


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a request is not answered."""

    status: HTTPStatus
    text: str


class LoginMiddleware:
    """ASGI middleware: admits requests with a session or a token, and asks the others for the link
    or a password. `with_login` puts the framework's sessions around it.

    `scope["membrane_user"]` holds the `WebUser` of a request that was let in.

    Parameters
    ----------
    app
        The page and the interface for programs.
    accounts
        Who may log in.
    address
        Where browsers find the page.
    tokens
        The tokens of programs.
    guard
        The connections of strangers.
    """

    def __init__(
        self,
        app: ASGIApp,
        accounts: Accounts,
        address: PublicAddress,
        tokens: TokenBook | None = None,
        guard: ConnectionGuard | None = None,
    ) -> None:
        self._app = app
        self._accounts = accounts
        self._address = address
        self._tokens = tokens
        self._guard = guard or ConnectionGuard()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        # Requests that no browser of ours sends end here.
        headers = _texts(scope)
        refusal = malformation(scope) or self._foreign(headers)
        if refusal is not None:
            await self._refuse(scope, send, refusal)
            return
        # Who is it? A person by the session's cookie, or a program by its token.
        cookies = _cookies(headers)
        user = self._accounts.user_of_session(scope["session"])
        authorization = headers.get("authorization", "")
        if user is None and authorization.lower().startswith(_BEARER):
            user = self._find_program(authorization[len(_BEARER) :].strip())
            if user is None:
                refusal = Refusal(HTTPStatus.UNAUTHORIZED, "unknown or revoked token")
                await self._refuse(scope, send, refusal)
                return
        if user is not None:
            self._guard.mark_known(scope.get("client"))
        # A login, a known user, or somebody who has neither.
        if scope.get("method") == "POST" and self._address.path_inside(scope["path"]) == LOGIN_PATH:
            await self._log_in(scope, receive, send, cookies.get(DEVICE_COOKIE, ""))
        elif user is not None:
            await self._serve(self._inside(scope, user), receive, send)
        elif scope["type"] == "websocket":
            await asyncio.sleep(_REFUSED_S)
            await self._refuse(scope, send, Refusal(HTTPStatus.UNAUTHORIZED, "log in first"))
        else:
            await self._open_link(scope, send)

    async def _refuse(self, scope: Scope, send: Send, refusal: Refusal) -> None:
        """Answer with an error and end the connection."""
        await _answer(scope, send, refusal.status, refusal.text, [_CLOSE])
        if scope["type"] == "websocket" and scope.get("client") is not None:
            self._guard.remove(scope["client"])

    def _foreign(self, headers: dict[str, str]) -> Refusal | None:
        """Return why the request comes from elsewhere; None if it does not."""
        host = headers.get("host", "")
        name = host_name(host)
        if host and name is None:
            return Refusal(HTTPStatus.BAD_REQUEST, "malformed Host header")
        if name not in self._address.hosts:
            hint = (
                "unknown host name: open the page by the address that `membrane-ctrl serve` printed"
            )
            return Refusal(HTTPStatus.FORBIDDEN, hint)
        origin = headers.get("origin")
        if origin is not None and not self._address.admits_origin(origin, host):
            return Refusal(HTTPStatus.FORBIDDEN, "a request of another page")
        return None

    def _find_program(self, token: str) -> WebUser | None:
        """Return whose token this is; None if nobody's."""
        return None if self._tokens is None else self._tokens.find_user(token)

    def _inside(self, scope: Scope, user: WebUser) -> Scope:
        """Return the request as the page sees it: its path without the prefix, and the prefix from
        the settings.
        """
        path = self._address.path_inside(scope["path"])
        raw_path = self._address.path_inside(scope.get("raw_path", b"").decode("latin-1"))
        headers = [each for each in scope["headers"] if each[0] != b"x-forwarded-prefix"]
        if self._address.prefix:  # NiceGUI puts the prefix of this header into its links
            headers.append((b"x-forwarded-prefix", self._address.prefix.encode()))
        changed = {
            "path": path,
            "raw_path": raw_path.encode("latin-1"),
            "headers": headers,
            "membrane_user": user,
        }
        return {**scope, **changed}

    async def _serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a viewer."""
        if (
            scope["path"] == ""
        ):  # the address without its last slash: links of the page are relative to it
            await _answer(scope, send, HTTPStatus.PERMANENT_REDIRECT, "", [self._location()])
        else:
            await self._app(scope, receive, _guarded(send))

    async def _log_in(self, scope: Scope, receive: Receive, send: Send, device: str) -> None:
        """Evaluate a name and a password."""
        # Name and password of the form.
        body = await _form_body(receive)
        if isinstance(body, Refusal):
            await self._refuse(scope, send, body)
            return
        given = parse_qs(body.decode("utf-8", "replace"))
        name, password = (given.get(key, [""])[0] for key in ("name", "password"))
        # Beyond its budget a guess is refused before the slow comparison. The answer comes late, so
        # that a client that tries again at once does not occupy the event loop.
        guess = self._accounts.guess_of(name, self._source(scope), device)
        admission = self._accounts.throttle.admit(guess)
        if not admission.granted:
            await asyncio.sleep(_REFUSED_S)
            text = f"Too many tries. Wait {math.ceil(admission.wait_s)} s."
            await self._show_form(scope, send, HTTPStatus.TOO_MANY_REQUESTS, text, admission.wait_s)
            return
        # Passwords take a tenth of a second of a processor: a pool bounds how many are checked at
        # once.
        pool = KNOWN_PASSWORDS if guess.device else STRANGERS_PASSWORDS
        try:
            user = await pool.run(self._accounts.evaluate, guess, password, admission)
        except PoolFullError:
            self._accounts.throttle.withdraw(admission)
            await asyncio.sleep(_REFUSED_S)
            text = "Too many people are logging in. Try again."
            await self._show_form(scope, send, HTTPStatus.SERVICE_UNAVAILABLE, text, _BUSY_S)
            return
        if user is None:
            await self._show_form(
                scope, send, HTTPStatus.UNAUTHORIZED, "Name or password is wrong."
            )
            return
        await self._admit(scope, send, user, device)

    async def _open_link(self, scope: Scope, send: Send) -> None:
        """Admit a person with the link's secret; show the others how to log in."""
        secret = parse_qs(scope["query_string"].decode("latin-1")).get("key", [""])[0]
        user = self._accounts.by_link(secret)
        if user is not None:
            await self._admit(scope, send, user, "", _find_place(scope))
            return
        text = (
            "Log in."
            if self._accounts.users
            else "Open the link that `membrane-ctrl serve` printed."
        )
        if secret and not self._accounts.users:
            text = f"This link is wrong, or of another user. {text}"
        await self._show_form(scope, send, HTTPStatus.UNAUTHORIZED, text)

    async def _admit(
        self, scope: Scope, send: Send, user: WebUser, device: str, place: str = ""
    ) -> None:
        """Give a user a session and show the page; `place` is a query that names its tab."""
        scope["session"].update(self._accounts.make_session(user))
        headers = [self._location(place)]
        cookie = self._accounts.device_cookie(user, device)
        if cookie is not None:
            headers.append((b"set-cookie", cookie.encode()))
        await _answer(scope, send, HTTPStatus.SEE_OTHER, "", headers)

    async def _show_form(
        self, scope: Scope, send: Send, status: HTTPStatus, text: str, retry_s: float | None = None
    ) -> None:
        """Answer with the form, or with what to do without one."""
        form = _FORM.format(action=f"{self._address.prefix}/login") if self._accounts.users else ""
        page = _LOGIN.format(said=html.escape(text), form=form)
        headers = [_text_type("html")]
        if retry_s is not None:
            headers.append((b"retry-after", str(math.ceil(retry_s)).encode()))
        read = scope["method"] == "POST" and self._address.path_inside(scope["path"]) == LOGIN_PATH
        if _has_body(scope) and not read:
            headers.append(_CLOSE)  # the body of a request that is not read would still be received
        await _answer(scope, send, status, page, headers)

    def _location(self, place: str = "") -> Header:
        return (b"location", f"{self._address.home}{place}".encode())

    def _source(self, scope: Scope) -> str:
        """Return the network address of the client."""
        peer = (scope.get("client") or ("", 0))[0]
        forwarded = [
            value.decode("latin-1")
            for name, value in scope["headers"]
            if name == b"x-forwarded-for"
        ]
        return self._address.source_of(peer, forwarded)


def with_login(
    app: ASGIApp,
    accounts: Accounts,
    address: PublicAddress,
    session_key: str,
    tokens: TokenBook | None = None,
    guard: ConnectionGuard | None = None,
) -> ASGIApp:
    """Return an application that only those who are let in can reach.

    Parameters
    ----------
    app : ASGIApp
        The page and the API.
    accounts, address, tokens, guard
        As for `LoginMiddleware`.
    session_key : str
        Key with which the cookies of sessions are signed; a new one ends all sessions.
    """
    return SessionMiddleware(
        LoginMiddleware(app, accounts, address, tokens, guard),
        session_key,
        session_cookie=SESSION_COOKIE,
        max_age=SESSION_S,
        path=address.prefix or "/",
        same_site="strict",
        https_only=address.secure,
    )


def malformation(scope: Scope) -> Refusal | None:
    """Return what is wrong with the form of a request; None if nothing is."""
    # Of two such headers a proxy may check one, and we the other
    names = [name for name, _ in scope["headers"]]
    if names.count(b"host") > 1 or names.count(b"origin") > 1:
        return Refusal(HTTPStatus.BAD_REQUEST, "a header that must be unique is repeated")
    if sum(len(name) + len(value) for name, value in scope["headers"]) > _HEAD_BYTES_MAX:
        return Refusal(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, "too many headers")
    if max(len(scope["path"]), len(scope["query_string"])) > _TARGET_LENGTH_MAX:
        return Refusal(HTTPStatus.REQUEST_URI_TOO_LONG, "the address is too long")
    if not scope["path"].isprintable() or "\ufffd" in scope["path"]:
        return Refusal(HTTPStatus.BAD_REQUEST, "control characters or broken text in the address")
    return None


def _text_type(kind: Literal["plain", "html"]) -> Header:
    return (b"content-type", f"text/{kind}; charset=utf-8".encode())


def _texts(scope: Scope) -> dict[str, str]:
    """Return the headers as text; of repeated ones, the last."""
    return {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}


def _has_body(scope: Scope) -> bool:
    return any(name in (b"content-length", b"transfer-encoding") for name, _ in scope["headers"])


def _guarded(send: Send) -> Send:
    """Add the headers that protect the page to an answer."""

    async def wrapped(message: Message) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message.get("headers", ()), *_HEADERS]
        await send(message)

    return wrapped


def _find_place(scope: Scope) -> str:
    """Return the query of a link without its key: what of the page it shows."""
    given = parse_qs(scope["query_string"].decode("latin-1"))
    place = {name: given[name][0] for name in _PLACE if name in given}
    return f"?{urlencode(place)}" if place else ""


def _cookies(headers: dict[str, str]) -> dict[str, str]:
    try:
        cookies = SimpleCookie(headers.get("cookie", ""))
    except CookieError:
        return {}
    return {name: morsel.value for name, morsel in cookies.items()}


async def _form_body(receive: Receive) -> bytes | Refusal:
    """Receive the body of the login form."""
    body = b""
    try:
        async with asyncio.timeout(_FORM_S):
            while True:
                message = await receive()
                if message["type"] == "http.disconnect":
                    return Refusal(HTTPStatus.BAD_REQUEST, "the client left")
                body += bytes(message.get("body", b""))
                if len(body) > _FORM_BYTES_MAX:
                    return Refusal(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "the form is too long")
                if not message.get("more_body"):
                    return body
    except TimeoutError:
        return Refusal(HTTPStatus.REQUEST_TIMEOUT, f"the form did not arrive within {_FORM_S:g} s")


async def _answer(
    scope: Scope, send: Send, status: HTTPStatus, text: str, headers: list[Header] | None = None
) -> None:
    """Send a text with a status, or close a web socket with it as the reason."""
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 4403, "reason": text[:100]})
        return
    content = text.encode()
    start: Literal["http.response.start"] = "http.response.start"
    length = (b"content-length", str(len(content)).encode())
    await send(
        {"type": start, "status": int(status), "headers": [*(headers or []), length, *_HEADERS]}
    )
    await send(
        {"type": "http.response.body", "body": b"" if scope["method"] == "HEAD" else content}
    )
