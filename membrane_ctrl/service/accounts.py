"""The people who may log in, their sessions, and the link without a login.

Passwords are stored as argon2id hashes. The framework keeps sessions in signed cookies
(`SessionMiddleware`); a session also holds a proof that is made of the account's hash, or of the
link's key, so that it ends when the password or the key changes.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, cast, get_args

from argon2 import PasswordHasher
from argon2.exceptions import InvalidHashError, VerificationError

from membrane_ctrl.controller.command import Role
from membrane_ctrl.model import errors
from membrane_ctrl.service.login_throttle import Admission, Guess, LoginThrottle
from membrane_ctrl.service.web_user import WebUser

SESSION_COOKIE = "membrane_ctrl"
SESSION_S = 12 * 3600  # a shift; then log in again
DEVICE_COOKIE = "membrane_ctrl_device"
_DEVICE_S = 180 * 86_400
_LINK_NAME = "link"
# 19 MB and some 30 ms (OWASP's parameters for argon2id): a guesser gets few tries, a person does
# not notice
_HASHER = PasswordHasher(time_cost=2, memory_cost=19_456, parallelism=1)
_HASH_PREFIX = "$argon2"


@dataclass(frozen=True, slots=True)
class KnownUser:
    """A line of the users file: `name:role:hash`."""

    name: str
    role: Role
    hash: str

    def line(self) -> str:
        """The line."""
        return f"{self.name}:{self.role}:{self.hash}"

    def has_password(self, password: str) -> bool:
        """Whether this is the user's password; slow on purpose."""
        return _verify_password(self.hash, password)


def known_user(name: str, role: str, password: str) -> KnownUser:
    """A new user, with the hash of a password; takes 50 ms of a core.

    Parameters
    ----------
    name : str
        1 to 32 printable characters without a colon, which separates the fields of the file.
    role : str
        `read`, `operate` or `tune`.
    password : str
        At least 8 characters; not kept.

    Raises
    ------
    InputError
        For a name, role or password that cannot be.
    """
    require_name(name, role)
    if len(password) < 8:
        raise errors.InputError("password: at least 8 characters")
    return KnownUser(name, cast(Role, role), _HASHER.hash(password))


def require_name(name: str, role: str) -> None:
    """Raise InputError for a name or role that no account or token can have.

    Parameters
    ----------
    name : str
        Must have 1 to 32 printable characters without a colon, which separates the fields of the
        files of users and tokens.
    role : str
        Must be `read`, `operate` or `tune`.
    """
    if not name.isprintable() or not name or ":" in name or len(name) > 32:
        raise errors.InputError(f"user {name!r}: 1 to 32 printable characters without a colon")
    if role not in get_args(Role):
        raise errors.InputError(f"role {role!r}: one of {', '.join(get_args(Role))}")


def known_users(text: str, source: str) -> dict[str, KnownUser]:
    """Users by name, from the text of a users file.

    Parameters
    ----------
    text : str
        Lines `NAME:ROLE:HASH`; empty lines and comments (`#`) do not count. Of two lines with one
        name the last counts.
    source : str
        The file, for the message.

    Raises
    ------
    InputError
        With the number of the wrong line.
    """
    found = {}
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        name, _, rest = line.strip().partition(":")
        role, _, digest = rest.partition(":")
        if not name or role not in get_args(Role) or not digest.startswith(_HASH_PREFIX):
            raise errors.InputError(
                f"{source}, line {number}: expected NAME:ROLE:HASH, as `serve add-user` writes"
            )
        found[name] = KnownUser(name, cast(Role, role), digest)
    return found


def _verify_password(digest: str, password: str) -> bool:
    try:
        return _HASHER.verify(digest, password)
    except (VerificationError, InvalidHashError):
        return False


@cache
def _hash_of_nobody() -> str:
    """The hash against which the password of an unknown name is compared."""
    return _HASHER.hash(secrets.token_hex(8))


@dataclass(slots=True)
class Accounts:
    """The link's key, and the users who may log in."""

    users: dict[str, KnownUser]
    link_role: Role = "tune"  # of a person with the link; what the port grants limits it further
    # of the cookies (`PublicAddress.cookie_attributes`)
    attributes: str = "HttpOnly; SameSite=Strict; Path=/"
    secret: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    throttle: LoginThrottle = field(default_factory=LoginThrottle)

    def make_session(self, user: WebUser) -> dict[str, Any]:
        """What the session of a user holds."""
        return {"name": user.name, "proof": self._prove(user.name)}

    def user_of_session(self, session: Mapping[str, Any]) -> WebUser | None:
        """Who has this session; None if nobody, or if the password or key has changed since."""
        name, proof = session.get("name"), session.get("proof")
        if not isinstance(name, str) or not isinstance(proof, str):
            return None
        if not hmac.compare_digest(proof.encode(), self._prove(name).encode()):
            return None
        known = self.users.get(name)
        if known is not None:
            return WebUser(known.name, known.role, has_login=True)
        return None if self.users else WebUser(_LINK_NAME, self.link_role)

    def _prove(self, name: str) -> str:
        """Return the proof of a session: it ends with the password, or with the link's key."""
        known = self.users.get(name)
        key = self.secret if known is None else known.hash
        return _sign(key, "session", name)

    def by_link(self, secret: str) -> WebUser | None:
        """Who opens the link with this secret; nobody if users log in by name."""
        fits = not self.users and hmac.compare_digest(secret.encode(), self.secret.encode())
        return WebUser(_LINK_NAME, self.link_role) if fits else None

    def guess_of(self, name: str, source: str, device: str) -> Guess:
        """Return who guesses a password; a device counts only if its cookie is of this account.

        Parameters
        ----------
        name : str
            The account, as typed.
        source : str
            Network address of the client, behind the trusted proxies.
        device : str
            Value of the device cookie; empty if there is none. May be forged: it is a signed
            number.
        """
        known = self.users.get(name)
        if known is not None and _is_device_of(known, device):
            return Guess(name, source, device)
        return Guess(name, source)

    def evaluate(self, guess: Guess, password: str, admission: Admission) -> WebUser | None:
        """Compare the password of an admitted guess; takes 50 ms of a core, so it runs on a pool.

        Parameters
        ----------
        guess : Guess
            Of `guess_of`.
        password : str
            As typed.
        admission : Admission
            Of the throttle: the guess has been counted already. A right password returns what it
            took.

        Returns
        -------
        WebUser or None
            None for a wrong password and for an unknown account, after the same time.
        """
        known = self.users.get(guess.account)
        if known is None:
            _verify_password(_hash_of_nobody(), password)  # as slow as for a name that exists
            return None
        if not _verify_password(known.hash, password):
            return None
        self.throttle.note_success(guess, admission)
        return WebUser(known.name, known.role, has_login=True)

    def device_cookie(self, user: WebUser, device: str) -> str | None:
        """The header that remembers a device after a login by name.

        Parameters
        ----------
        user : WebUser
            Who has logged in.
        device : str
            The device's cookie until now; empty if it has none.

        Returns
        -------
        str or None
            Value of `Set-Cookie`; None if the device is known already, or for the link, which has
            no account.
        """
        known = self.users.get(user.name)
        if known is None or _is_device_of(known, device):
            return None
        return f"{DEVICE_COOKIE}={_new_device(known)}; {self.attributes}; Max-Age={_DEVICE_S}"


def _new_device(known: KnownUser) -> str:
    """The cookie of a new device of an account.

    A device that has logged in before has its own budget of password guesses (`login_throttle`).
    Its cookie is a random number with a signature. The key of the signature is the account's hash:
    it needs no storage, survives a restart, and ends with the password.
    """
    number = secrets.token_hex(16)
    return f"{number}.{_sign(known.hash, f'device {known.name}', number)}"


def _is_device_of(known: KnownUser, cookie: str) -> bool:
    """Whether a device has logged in as this account since its password was set."""
    number, _, signature = cookie.partition(".")
    expected = _sign(known.hash, f"device {known.name}", number)
    return hmac.compare_digest(signature.encode(), expected.encode())


def _sign(key: str, purpose: str, text: str) -> str:
    signed = f"{purpose}\0{text}".encode()
    return hmac.new(key.encode(), signed, hashlib.sha256).hexdigest()
