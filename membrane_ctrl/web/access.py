"""Who may see the page, and what a viewer may ask of a hold.

The address bar is not enough: any program on this machine, and any page in a browser on it, can reach a port of
localhost. So every request needs a session cookie, which a link with a secret or a password gives; requests with a
foreign `Host` (DNS rebinding) or `Origin` (another page, also over web sockets) are refused, and the cookie is never
sent by other sites (`SameSite=Strict`).
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import html
import math
import secrets
import time
from dataclasses import dataclass, field
from functools import cache
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import TYPE_CHECKING, Any, Literal, cast, get_args
from urllib.parse import parse_qs, urlsplit

from membrane_ctrl.controller.commands import ANY, TABLE, Kind, Role
from membrane_ctrl.model import errors

if TYPE_CHECKING:  # the doors know these actions, too, and have no web server
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

COOKIE = "membrane_ctrl"
SESSION_S = 12 * 3600.0  # a shift; then log in again
_FORM_BYTES_MAX = 4096
# scrypt with these parameters takes 16 MB and some 50 ms: a guesser gets few tries, a person does not notice
_SCRYPT = {"n": 2**14, "r": 8, "p": 1}
_TRIES, _LOCKED_S = 5, 60.0  # wrong passwords in a row for a name, then this pause
_SESSIONS_MAX = 1000

_LOGIN = """<!doctype html><html lang="en"><meta charset="utf-8"><title>membrane_ctrl</title>
<meta name="viewport" content="width=device-width,initial-scale=1">
<style>:root{{color-scheme:light dark}}body{{font:16px sans-serif;max-width:22em;margin:15vh auto;padding:0 1em}}
input,button{{font:inherit;width:100%;padding:.5em;margin:.3em 0;box-sizing:border-box}}</style>
<h1>membrane_ctrl</h1><p>{said}</p>{form}</html>"""
_FORM = """<form method="post" action="/login">
<label>Name<input name="name" autocomplete="username" autofocus></label>
<label>Password<input name="password" type="password" autocomplete="current-password"></label>
<button>Log in</button></form>"""


@dataclass(frozen=True, slots=True)
class WebUser:
    """A viewer: name and role."""

    name: str
    role: Role


@dataclass(frozen=True, slots=True)
class KnownUser:
    """A line of the users file: `name:role:salt:hash`, the last two hexadecimal (scrypt)."""

    name: str
    role: Role
    salt: bytes
    digest: bytes

    def line(self) -> str:
        """The line."""
        return f"{self.name}:{self.role}:{self.salt.hex()}:{self.digest.hex()}"

    def has_password(self, password: str) -> bool:
        """Whether this is the user's password; takes some 50 ms."""
        return hmac.compare_digest(_digest(password, self.salt), self.digest)


def known_user(name: str, role: str, password: str) -> KnownUser:
    """A new user. Raises InputError for a name, role or password that cannot be."""
    if not name.isprintable() or not name or ":" in name or len(name) > 32:
        raise errors.InputError(f"user {name!r}: 1 to 32 printable characters without a colon")
    if role not in get_args(Role):
        raise errors.InputError(f"role {role!r}: one of {', '.join(get_args(Role))}")
    if len(password) < 8:
        raise errors.InputError("password: at least 8 characters")
    salt = secrets.token_bytes(16)
    return KnownUser(name, cast(Role, role), salt, _digest(password, salt))


def known_users(text: str, source: str) -> dict[str, KnownUser]:
    """Users by name, from the text of a users file. Raises InputError with the line that is wrong."""
    found = {}
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            name, role, salt, digest = line.strip().split(":")
            if role not in get_args(Role):
                raise ValueError
            found[name] = KnownUser(name, cast(Role, role), bytes.fromhex(salt), bytes.fromhex(digest))
        except ValueError:
            raise errors.InputError(f"{source}, line {number}: expected NAME:ROLE:SALT:HASH") from None
    return found


def _digest(password: str, salt: bytes) -> bytes:
    return hashlib.scrypt(password.encode(), salt=salt, **_SCRYPT)


@dataclass(slots=True)
class Accounts:
    """Sessions, the link's secret, and the users who may log in."""

    users: dict[str, KnownUser]
    link_role: Role = "tune"  # of whoever has the link; what the port grants limits it further
    secure: bool = False  # the page is served over TLS
    secret: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    _sessions: dict[str, tuple[WebUser, float]] = field(default_factory=dict)
    _wrong: dict[str, tuple[int, float]] = field(default_factory=dict)

    def session(self, user: WebUser) -> str:
        """Begin a session; returns its cookie's value."""
        now_s = time.monotonic()
        self._sessions = {key: (who, end_s) for key, (who, end_s) in self._sessions.items() if end_s > now_s}
        while len(self._sessions) >= _SESSIONS_MAX:
            del self._sessions[next(iter(self._sessions))]
        key = secrets.token_urlsafe(32)
        self._sessions[key] = user, now_s + SESSION_S
        return key

    def user(self, key: str) -> WebUser | None:
        """Who has this session; None if nobody."""
        user, end_s = self._sessions.get(key, (None, 0.0))
        return user if end_s > time.monotonic() else None

    def by_link(self, secret: str) -> WebUser | None:
        """Who opens the link with this secret; nobody if users log in by name."""
        fits = not self.users and hmac.compare_digest(secret.encode(), self.secret.encode())
        return WebUser("link", self.link_role) if fits else None

    def by_password(self, name: str, password: str) -> WebUser | None:
        """Who logs in with this password; None if nobody, or after too many wrong ones."""
        tries, since_s = self._wrong.get(name, (0, 0.0))
        if tries >= _TRIES and time.monotonic() - since_s < _LOCKED_S:
            return None
        known = self.users.get(name)
        salt, digest = (known.salt, known.digest) if known else (b"\0" * 16, b"")
        if known is not None and hmac.compare_digest(_digest(password, salt), digest):
            self._wrong.pop(name, None)
            return WebUser(known.name, known.role)
        if known is None:
            _digest(password, salt)  # as slow as for a name that exists
        else:
            self._wrong[name] = tries + 1, time.monotonic()
        return None

    def cookie(self, user: WebUser) -> str:
        """The header that gives a user a session."""
        secure = "; Secure" if self.secure else ""
        return f"{COOKIE}={self.session(user)}; HttpOnly; SameSite=Strict; Path=/; Max-Age={SESSION_S:.0f}{secure}"


class LoginMiddleware:
    """ASGI middleware: lets in whoever has a session, and asks the others for the link or a password.

    `scope["membrane_user"]` holds the `WebUser` of a request that was let in.
    """

    def __init__(self, app: ASGIApp, accounts: Accounts, hosts: frozenset[str]) -> None:
        self._app, self._accounts, self._hosts = app, accounts, hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        if refusal := self._foreign(headers):
            await _answer(scope, send, HTTPStatus.FORBIDDEN, refusal)
            return
        user = self._accounts.user(_cookie(headers))
        if user is not None:
            await self._app({**scope, "membrane_user": user}, receive, _guarded(send))
        elif scope["type"] == "http":
            await self._ask(scope, receive, send)
        else:
            await _answer(scope, send, HTTPStatus.UNAUTHORIZED, "log in first")

    def _foreign(self, headers: dict[str, str]) -> str:
        """Why the request comes from elsewhere; empty if it does not."""
        host = headers.get("host", "")
        if urlsplit(f"//{host}").hostname not in self._hosts:
            return "unknown host name: open the page by the address that `membrane-ctrl web` printed"
        origin = headers.get("origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return "a request of another page"
        return ""

    async def _ask(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["method"] == "POST" and scope["path"] == "/login":
            given = parse_qs((await _body(receive)).decode("utf-8", "replace"))
            name, password = (given.get(key, [""])[0] for key in ("name", "password"))
            user = await asyncio.to_thread(self._accounts.by_password, name, password)
            said = "Name or password is wrong, or there were too many wrong ones: wait a minute."
        else:
            secret = parse_qs(scope["query_string"].decode("latin-1")).get("key", [""])[0]
            user = self._accounts.by_link(secret)
            said = "Log in." if self._accounts.users else "Open the link that `membrane-ctrl web` printed."
            if secret and not self._accounts.users:
                said = f"This link is wrong, or of an earlier start. {said}"
        if user is not None:
            headers = [(b"location", b"/"), (b"set-cookie", self._accounts.cookie(user).encode())]
            await _answer(scope, send, HTTPStatus.SEE_OTHER, "", headers)
        else:
            form = _FORM if self._accounts.users else ""
            page = _LOGIN.format(said=html.escape(said), form=form)
            await _answer(scope, send, HTTPStatus.UNAUTHORIZED, page, [(b"content-type", b"text/html")])


Header = tuple[bytes, bytes]
_HEADERS: tuple[Header, ...] = (
    (b"x-frame-options", b"DENY"),  # no other page may lay itself over the stop button
    (b"x-content-type-options", b"nosniff"),
    # the link's secret stays here; with `no-referrer` a browser would send the login form with the origin `null`
    (b"referrer-policy", b"same-origin"),
)


def _guarded(send: Send) -> Send:
    async def wrapped(message: Message) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message.get("headers", ()), *_HEADERS]
        await send(message)

    return wrapped


def _cookie(headers: dict[str, str]) -> str:
    try:
        found = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
    except CookieError:
        return ""
    return "" if found is None else found.value


async def _body(receive: Receive) -> bytes:
    body = b""
    while True:
        message = await receive()
        body += bytes(message.get("body", b""))
        if len(body) > _FORM_BYTES_MAX:
            return b""
        if not message.get("more_body"):
            return body


async def _answer(
    scope: Scope, send: Send, status: HTTPStatus, text: str, headers: list[Header] | None = None
) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 4403, "reason": text[:100]})
        return
    start: Literal["http.response.start"] = "http.response.start"
    await send({"type": start, "status": int(status), "headers": [*(headers or []), *_HEADERS]})
    await send({"type": "http.response.body", "body": text.encode()})


# What a viewer may ask: the commands of `ctl` that take one number or one text at most.

_RANK: dict[str, int] = {"read": 0, "operate": 1, "tune": 2}


@dataclass(frozen=True, slots=True)
class Action:
    """A button.

    `asks` is what the viewer types: a number in the given unit, a text, or nothing but yes.
    """

    do: Kind | Literal["quiet"]
    label: str
    icon: str  # a Material icon's name
    asks: Literal["", "number", "text"] = ""
    unit: str = ""

    @property
    def role(self) -> Role:
        """The role that it needs."""
        return "operate" if self.do == "quiet" else TABLE[self.do].role

    @property
    def does(self) -> str:
        """What it does, in a sentence."""
        return "Acknowledge the alarms: no reminders." if self.do == "quiet" else TABLE[self.do].does

    @property
    def states(self) -> frozenset[str]:
        """States in which the hold obeys, in lower case; all for `quiet`."""
        return _states(self.do)


@cache  # asked for each button of each viewer
def _states(do: str) -> frozenset[str]:
    return frozenset(state.name.lower() for state in (ANY if do == "quiet" else TABLE[cast(Kind, do)].states))


STOP = Action("stop", "STOP", "stop_circle")
ACTIONS = (
    Action("hold", "Hold", "play_arrow"),
    Action("pause", "Pause", "pause"),
    Action("resume", "Resume", "play_circle"),
    Action("setpoint", "Setpoint", "straighten", "number", "um"),
    Action("manual", "Manual flow", "tune", "number", "um/s"),
    Action("shape_on", "Shape loop on", "toggle_on"),
    Action("shape_off", "Shape loop off", "toggle_off"),
    Action("mark", "Mark", "bookmark", "text"),
    Action("capture", "Capture set", "photo_camera"),
    Action("keep", "Keep gains", "done_all"),
    Action("ack", "Clear fault", "check_circle"),
    Action("quiet", "Quiet alarms", "notifications_off"),
    Action("lower", "Lower", "south"),
    Action("vent", "Vent", "air"),
    Action("latch", "Lock", "lock", "text"),
)


def outranks(role: str, needed: Role) -> bool:
    """Whether a role includes the needed one; an unknown role is `read`."""
    return _RANK.get(role, 0) >= _RANK[needed]


def may(user: WebUser, port_role: str, action: Action) -> bool:
    """Whether the viewer's role and that of this process at the port both allow it."""
    return outranks(user.role, action.role) and outranks(port_role, action.role)


def request(action: Action, why: str, given: str, take_over: bool = False) -> dict[str, Any]:
    """The request to send, for the reason `why`. Raises ValueError with what is wrong with the input."""
    asked: dict[str, Any] = {"do": action.do, "why": why, "take_over": take_over}
    if action.asks == "number":
        try:
            value = float(given.replace(",", "."))
        except ValueError:
            raise ValueError(f"{action.label}: enter a number in {action.unit}") from None
        if not math.isfinite(value):
            raise ValueError(f"{action.label}: enter a finite number in {action.unit}")
        asked["value"] = value
    elif action.asks == "text":
        if not given.strip() and action.do == "mark":
            raise ValueError("Mark: enter a text")
        if given.strip():
            asked["text"] = given.strip()
    return asked
