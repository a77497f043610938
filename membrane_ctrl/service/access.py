"""Who may see the page, and what a viewer may ask of a hold (`login` asks each request for its
session).
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
import time
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Literal, cast, get_args

from membrane_ctrl.controller.commands import ANY, TABLE, Kind, Role
from membrane_ctrl.model import errors
from membrane_ctrl.model.columns import unit_of
from membrane_ctrl.model.numbers import parse_number
from membrane_ctrl.service.login_throttle import Admission, Guess, LoginThrottle

COOKIE = "membrane_ctrl"
SESSION_S = 12 * 3600.0  # a shift; then log in again
DEVICE_COOKIE = "membrane_ctrl_device"
_DEVICE_S = 180 * 86400.0
# scrypt with these parameters takes 16 MB and some 50 ms: a guesser gets few tries, a person does
# not notice
_SCRYPT = {"n": 2**14, "r": 8, "p": 1}
_SESSIONS_MAX, _SESSIONS_OF_USER_MAX = 1000, 100


@dataclass(frozen=True, slots=True)
class WebUser:
    """A viewer: name and role."""

    name: str
    role: Role
    has_login: bool = field(default=False, compare=False)  # with a password; a link proves no name


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
    """Users by name, from the text of a users file. Raises InputError
    with the line that is wrong.
    """
    found = {}
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            name, role, salt, digest = line.strip().split(":")
            if role not in get_args(Role):
                raise ValueError
            found[name] = KnownUser(
                name, cast(Role, role), bytes.fromhex(salt), bytes.fromhex(digest)
            )
        except ValueError:
            raise errors.InputError(
                f"{source}, line {number}: expected NAME:ROLE:SALT:HASH"
            ) from None
    return found


def _digest(password: str, salt: bytes) -> bytes:
    return hashlib.scrypt(password.encode(), salt=salt, **_SCRYPT)


@dataclass(slots=True)
class Accounts:
    """Sessions, the link's secret, and the users who may log in."""

    users: dict[str, KnownUser]
    link_role: Role = "tune"  # of whoever has the link; what the port grants limits it further
    # of the cookies (`PublicAddress.cookie_attributes`)
    attributes: str = "HttpOnly; SameSite=Strict; Path=/"
    secret: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    throttle: LoginThrottle = field(default_factory=LoginThrottle)
    _sessions: dict[str, tuple[WebUser, float]] = field(default_factory=dict)

    def session(self, user: WebUser) -> str:
        """Begin a session; returns its cookie's value."""
        now_s = time.monotonic()
        self._sessions = {
            key: (who, end_s) for key, (who, end_s) in self._sessions.items() if end_s > now_s
        }
        own = [key for key, (who, _) in self._sessions.items() if who.name == user.name]
        if (
            len(own) >= _SESSIONS_OF_USER_MAX
        ):  # who logs in again and again ends no sessions of others
            del self._sessions[own[0]]
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

    def by_password(
        self, name: str, password: str, source: str = "", device: str = ""
    ) -> WebUser | None:
        """Who logs in with this password from a network address; None if nobody, or after too many
        wrong ones.

        `device` is the value of a device's cookie.
        """
        guess = self.guess_of(name, source, device)
        admission = self.throttle.admit(guess)
        return self.evaluate(guess, password, admission) if admission.granted else None

    def guess_of(self, name: str, source: str, device: str) -> Guess:
        """Return who guesses; a device counts only if its cookie is of this account."""
        known = self.users.get(name)
        if known is not None and _is_device_of(known, device):
            return Guess(name, source, device)
        return Guess(name, source)

    def evaluate(self, guess: Guess, password: str, admission: Admission) -> WebUser | None:
        """Compare the password of an admitted guess; slow. Returns None if it is wrong or the
        account is unknown.
        """
        known = self.users.get(guess.account)
        if known is None:
            _digest(password, b"\0" * 16)  # as slow as for a name that exists
            return None
        if not hmac.compare_digest(_digest(password, known.salt), known.digest):
            return None
        self.throttle.note_success(guess, admission)
        return WebUser(known.name, known.role, has_login=True)

    def cookies(self, user: WebUser, device: str) -> list[str]:
        """The headers that give a user a session and, with a login by name, remember the device if
        it is new.
        """
        session = f"{COOKIE}={self.session(user)}; {self.attributes}; Max-Age={SESSION_S:.0f}"
        known = self.users.get(user.name)
        if known is None or _is_device_of(known, device):
            return [session]
        return [
            session,
            f"{DEVICE_COOKIE}={_new_device(known)}; {self.attributes}; Max-Age={_DEVICE_S:.0f}",
        ]


# A device that has logged in before has its own budget of password guesses (`login_throttle`). Its
# cookie is a random number with a signature. The key of the signature is made of the account's salt
# and hash: it needs no storage, survives a restart, and ends with the password.


def _new_device(known: KnownUser) -> str:
    """The cookie of a new device of an account."""
    number = secrets.token_hex(16)
    return f"{number}.{_device_signature(known, number)}"


def _is_device_of(known: KnownUser, cookie: str) -> bool:
    """Whether a device has logged in as this account since its password was set."""
    number, _, signature = cookie.partition(".")
    return hmac.compare_digest(signature.encode(), _device_signature(known, number).encode())


def _device_signature(known: KnownUser, number: str) -> str:
    signed = f"device\0{known.name}\0{number}".encode()
    return hmac.new(known.salt + known.digest, signed, hashlib.sha256).hexdigest()


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
        return (
            "Acknowledge the alarms: no reminders." if self.do == "quiet" else TABLE[self.do].does
        )

    @property
    def states(self) -> frozenset[str]:
        """States in which the hold obeys, in lower case; all for `quiet`."""
        return _states(self.do)


@cache  # asked for each button of each viewer
def _states(do: str) -> frozenset[str]:
    return frozenset(
        state.name.lower() for state in (ANY if do == "quiet" else TABLE[cast(Kind, do)].states)
    )


STOP = Action("stop", "STOP", "stop_circle")
UNLOCK = Action(
    "unlock", "Unlock", "lock_open", "text"
)  # none of `ACTIONS`, which the bridges offer as well
ACTIONS = (
    Action("hold", "Hold", "play_arrow"),
    Action("pause", "Pause", "pause"),
    Action("resume", "Resume", "play_circle"),
    Action("setpoint", "Setpoint", "straighten", "number", unit_of("setpoint_um")),
    Action("manual", "Manual flow", "tune", "number", unit_of("flow_um_per_s")),
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


def on_behalf(user: WebUser, session: str) -> dict[str, str]:
    """What the page states of a viewer in each request (`protocol.OnBehalf`).

    Parameters
    ----------
    user : WebUser
    session : str
        Of the viewer.

    Returns
    -------
    dict
    """
    account = user.name if user.has_login else ""
    return {
        "via": "page",
        "account": account,
        "name": user.name,
        "session": session,
        "role": user.role,
    }


def request(action: Action, why: str, given: str, take_over: bool = False) -> dict[str, Any]:
    """The request to send, for the reason `why`. Raises ValueError with what is wrong with the
    input.
    """
    asked: dict[str, Any] = {"do": action.do, "why": why, "take_over": take_over}
    if action.asks == "number":
        try:
            asked["value"] = parse_number(given)
        except ValueError as error:
            raise ValueError(f"{action.label}: enter a number in {action.unit}: {error}") from None
    elif action.asks == "text":
        if not given.strip() and action.do == "mark":
            raise ValueError("Mark: enter a text")
        if given.strip():
            asked["text"] = given.strip()
    return asked
