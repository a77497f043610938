"""Nobody sees the page or reaches the hold through it without a link or a password, from this page
and no other.
"""

from __future__ import annotations

import stat
import time
from pathlib import Path
from typing import Any

import pytest

from membrane_ctrl.model.errors import InputError
from membrane_ctrl.service.access import on_behalf
from membrane_ctrl.service.accounts import SESSION_S, Accounts, known_user, known_users
from membrane_ctrl.service.login import with_login
from membrane_ctrl.service.public_address import PublicAddress
from membrane_ctrl.service.tokens import TokenBook, add_token, revoke_token
from membrane_ctrl.service.web_user import WebUser
from tests.worlds.password_guesses import guess_password

ADDRESS = PublicAddress(frozenset({"127.0.0.1", "localhost"}))
HOST = "127.0.0.1:7480"


class Site:
    """An application behind the login that notes who came in."""

    def __init__(
        self,
        accounts: Accounts,
        address: PublicAddress = ADDRESS,
        tokens: TokenBook | None = None,
    ) -> None:
        self.seen: list[WebUser] = []
        self.answer = ""  # to the last request
        self._gate = with_login(self._app, accounts, address, "key", tokens)

    async def _app(self, scope: Any, receive: Any, send: Any) -> None:
        self.seen.append(scope["membrane_user"])
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b"in"})

    async def ask(
        self,
        path: str = "/",
        query: str = "",
        body: bytes | None = None,
        kind: str = "http",
        **headers: str,
    ) -> tuple[int, dict[str, str]]:
        """Status (for a web socket, its close code) and headers of the answer."""
        given = {"host": HOST, **{name.replace("_", "-"): value for name, value in headers.items()}}
        scope = {
            "type": kind,
            "method": "GET" if body is None else "POST",
            "path": path,
            "query_string": query.encode(),
            "headers": [(name.encode(), value.encode()) for name, value in given.items()],
        }
        sent: list[dict[str, Any]] = []

        async def receive() -> dict[str, Any]:
            return {"type": "http.request", "body": body or b""}

        async def send(message: Any) -> None:
            sent.append(message)

        await self._gate(scope, receive, send)
        first = sent[0]
        self.answer = b"".join(message.get("body", b"") for message in sent).decode()
        answered: dict[str, str] = {}
        for name, value in first.get("headers", ()):
            if value.startswith(b"membrane_ctrl=") or name.decode() not in answered:
                answered[name.decode()] = value.decode()
        return int(first.get("status") or first["code"]), answered


async def log_in(site: Site, accounts: Accounts) -> str:
    """Open the link; returns the session's cookie."""
    _, headers = await site.ask(query=f"key={accounts.secret}")
    return cookie_of(headers)


def cookie_of(headers: dict[str, str]) -> str:
    return headers["set-cookie"].partition(";")[0]


async def test_the_link_lets_in_and_its_session_stays() -> None:
    accounts = Accounts({})
    site = Site(accounts)
    assert (await site.ask())[0] == 401
    assert "this link is wrong" not in site.answer.lower()
    status, headers = await site.ask(query="key=wrong")
    assert (status, "This link is wrong, or of another user." in site.answer) == (401, True)
    assert headers["referrer-policy"] == "same-origin", (
        "with none, browsers send the login form's origin as null"
    )
    status, headers = await site.ask(query=f"key={accounts.secret}")
    assert status == 303
    assert headers["location"] == "/"
    assert {"httponly", "samesite=strict"} <= {
        part.strip().lower() for part in headers["set-cookie"].split(";")
    }
    assert site.seen == []
    assert (await site.ask(cookie=cookie_of(headers)))[0] == 200
    assert [user.role for user in site.seen] == ["tune"]


async def test_a_session_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    accounts = Accounts({})
    site = Site(accounts)
    cookie = await log_in(site, accounts)
    now = time.time()
    assert (await site.ask(cookie=cookie))[0] == 200
    monkeypatch.setattr("time.time", lambda: now + SESSION_S + 10.0)
    assert (await site.ask(cookie=cookie))[0] == 401


async def test_a_session_survives_a_restart_and_ends_with_its_key_or_password() -> None:
    accounts = Accounts({})
    cookie = await log_in(Site(accounts), accounts)
    assert (await Site(Accounts({}, secret=accounts.secret)).ask(cookie=cookie))[0] == 200
    assert (await Site(Accounts({})).ask(cookie=cookie))[0] == 401, "another key"
    users = {"anna": known_user("anna", "operate", "membrane!")}
    assert (await Site(Accounts(users, secret=accounts.secret)).ask(cookie=cookie))[0] == 401
    site = Site(Accounts(users))
    _, headers = await site.ask("/login", body=b"name=anna&password=membrane%21")
    assert (await site.ask(cookie=cookie_of(headers)))[0] == 200
    for changed in ({"anna": known_user("anna", "operate", "membrane!")}, {}):
        assert (await Site(Accounts(changed)).ask(cookie=cookie_of(headers)))[0] == 401


@pytest.mark.parametrize("forged", ["", "x", "e30=.x.y", "\xff", '"'])
async def test_a_cookie_that_the_service_did_not_sign_opens_nothing(forged: str) -> None:
    site = Site(Accounts({}))
    assert (await site.ask(cookie=f"membrane_ctrl={forged}"))[0] == 401
    assert site.seen == []


async def test_a_token_lets_a_program_in_until_it_is_revoked(tmp_path: Path) -> None:
    file = tmp_path / "tokens"
    token = add_token(file, "logger", "read")
    other = add_token(file, "operator", "operate")
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert token not in file.read_text()
    with pytest.raises(InputError, match="revoke it before"):
        add_token(file, "logger", "tune")
    site = Site(Accounts({}), tokens=TokenBook(file))
    assert (await site.ask(authorization=f"Bearer {token}"))[0] == 200
    assert site.seen == [WebUser("logger", "read", via="token")]
    assert on_behalf(site.seen[0], "token")["account"] == "logger"
    for wrong in ("x", "", token[:-1], file.read_text().split(":")[-1].strip()):
        assert (await site.ask(authorization=f"Bearer {wrong}"))[0] == 401
    headers = {"authorization": f"Bearer {token}", "origin": "http://evil.example"}
    assert (await site.ask(**headers))[0] == 403
    revoke_token(file, "logger")
    assert (await site.ask(authorization=f"Bearer {token}"))[0] == 401
    assert (await site.ask(authorization=f"bearer {other}"))[0] == 200
    file.write_text("damaged")
    assert (await site.ask(authorization=f"Bearer {other}"))[0] == 401
    with pytest.raises(InputError, match="line 1: expected NAME:ROLE:HASH"):
        revoke_token(file, "logger")


@pytest.mark.parametrize(
    "headers",
    [
        {
            "host": "evil.example:7480"
        },  # DNS rebinding: the browser was told that this name is 127.0.0.1
        {"origin": "http://evil.example"},
        {"origin": "http://127.0.0.1:9999"},  # another server on this machine
        {"origin": "null"},
        {"host": ""},
        {"host": "[::1"},
        {"host": "127.0.0.1:7480/"},
        {"host": "127.0.0.1:99999"},
        {"host": "127.0.0.1@evil.example"},
    ],
    ids=str,
)
@pytest.mark.parametrize("kind", ["http", "websocket"])
async def test_other_pages_are_refused_even_with_the_cookie(
    kind: str, headers: dict[str, str]
) -> None:
    accounts = Accounts({})
    site = Site(accounts)
    cookie = await log_in(site, accounts)
    status, _ = await site.ask("/", "", None, kind, cookie=cookie, **headers)
    assert status in (400, 403, 4403)
    assert site.seen == []
    status, _ = await site.ask(kind=kind, cookie=cookie, origin=f"http://{HOST}")
    assert len(site.seen) == 1


async def test_a_web_socket_without_a_session_is_closed() -> None:
    site = Site(Accounts({}))
    assert (await site.ask(kind="websocket", origin=f"http://{HOST}"))[0] == 4403
    assert site.seen == []


async def test_names_and_passwords() -> None:
    users = {
        "anna": known_user("anna", "operate", "membrane!"),
        "bob": known_user("bob", "read", "password"),
    }
    accounts = Accounts(users)
    site = Site(accounts, PublicAddress(ADDRESS.hosts, secure=True))
    assert (await site.ask(query=f"key={accounts.secret}"))[0] == 401, (
        "with users, the link lets nobody in"
    )
    for body in (b"name=anna&password=wrong", b"name=nobody&password=membrane!", b"", b"name=anna"):
        assert (await site.ask("/login", body=body))[0] == 401
    assert (await site.ask("/login", body=b"x" * 5000))[0] == 413
    status, headers = await site.ask("/login", body=b"name=anna&password=membrane%21")
    assert status == 303
    assert "secure" in headers["set-cookie"].lower()
    assert (await site.ask(cookie=cookie_of(headers)))[0] == 200
    assert site.seen == [WebUser("anna", "operate")]


def test_a_password_proves_an_account_and_a_link_does_not() -> None:
    anna = guess_password(
        Accounts({"anna": known_user("anna", "operate", "membrane!")}), "anna", "membrane!"
    )
    assert anna is not None
    assert on_behalf(anna, "page 1f")["account"] == "anna"
    accounts = Accounts({})
    visitor = accounts.by_link(accounts.secret)
    assert visitor is not None
    assert on_behalf(visitor, "page 1f")["account"] == ""


def test_a_users_file_is_read_back_and_holds_no_password() -> None:
    user = known_user("anna", "operate", "membrane!")
    assert "membrane!" not in user.line()
    assert known_users(f"# the lab\n\n{user.line()}\n", "users") == {"anna": user}
    assert known_user("anna", "operate", "membrane!").hash != user.hash, "salted"


@pytest.mark.parametrize(
    "line",
    ["anna", "anna:operate:zz", "anna:king:$argon2id$x", "anna:operate", ":" * 9, ":read:$argon2"],
)
def test_a_damaged_users_file_is_named_with_its_line(line: str) -> None:
    with pytest.raises(InputError, match=r"users, line 2: expected NAME:ROLE:HASH"):
        known_users(f"# first\n{line}\n", "users")


@pytest.mark.parametrize(
    ("name", "role", "password", "message"),
    [
        ("", "read", "long enough", "1 to 32 printable"),
        ("a:b", "read", "long enough", "colon"),
        ("a\nb", "read", "long enough", "printable"),
        ("a", "root", "long enough", "one of read, operate, tune"),
        ("a", "read", "short", "at least 8"),
    ],
)
def test_a_user_that_cannot_be(name: str, role: str, password: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        known_user(name, role, password)


def test_add_user_writes_a_file_of_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from typer.testing import CliRunner

    from membrane_ctrl.web.cli import app

    file = tmp_path / "users"
    for name, password in (("anna", "membrane!"), ("bob", "password"), ("anna", "changed it")):
        done = CliRunner().invoke(
            app, ["add-user", str(file), name, "operate"], input=f"{password}\n"
        )
        assert done.exit_code == 0, done.output
    found = Accounts(known_users(file.read_text(), str(file)))
    assert guess_password(found, "anna", "changed it") == WebUser("anna", "operate")
    assert guess_password(found, "anna", "membrane!") is None
    assert guess_password(found, "bob", "password") is not None
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
