"""Tokens of programs: random texts that stand for a name and a role, and can be revoked one by one.

Only hashes are stored. The file is read again when it has changed, so a revoked token is refused by
the next request.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import cast, get_args

from membrane_ctrl.control_port.service_link import service_folder
from membrane_ctrl.controller.command import Role
from membrane_ctrl.model import errors, files
from membrane_ctrl.service.accounts import require_name
from membrane_ctrl.service.web_user import WebUser

_FILE_NAME = "tokens"
_TOKEN_BYTES = 32  # too many to guess, so a fast hash is enough


@dataclass(frozen=True, slots=True)
class ProgramToken:
    """A line of the tokens file: `name:role:hash`."""

    name: str
    role: Role
    digest: str


def tokens_file() -> Path:
    """Return the file of this user's tokens. Raises DeviceError."""
    return service_folder() / _FILE_NAME


def read_tokens(path: Path) -> list[ProgramToken]:
    """Return the tokens of a file, none if it is missing. Raises InputError with the line that is
    wrong, DeviceError if the file cannot be read.
    """
    try:
        text = files.read_text(path)
    except FileNotFoundError:
        return []
    except (OSError, ValueError) as error:
        raise errors.DeviceError(f"{path}: cannot be read ({error})") from None
    found = []
    for number, line in enumerate(text.splitlines(), 1):
        parts = line.split(":")
        if len(parts) != 3 or parts[1] not in get_args(Role):
            raise errors.InputError(f"{path}, line {number}: expected NAME:ROLE:HASH")
        found.append(ProgramToken(parts[0], cast(Role, parts[1]), parts[2]))
    return found


def add_token(path: Path, name: str, role: str) -> str:
    """Add a token to a file and return it; it is shown only once.

    Parameters
    ----------
    path : Path
        File of the tokens (`tokens_file`), which has their hashes; made if it is missing.
    name : str
        Name of the program, for the records of the runs.
    role : str
        `read`, `operate` or `tune`: the most that the program may do.

    Raises
    ------
    InputError
        The name or role cannot be, or another token has the name.
    DeviceError
        The file cannot be read or written.
    """
    require_name(name, role)
    tokens = read_tokens(path)
    if any(each.name == name for each in tokens):
        raise errors.InputError(f"{name}: there is a token of this name; revoke it before")
    token = secrets.token_urlsafe(_TOKEN_BYTES)
    _write_tokens(path, [*tokens, ProgramToken(name, cast(Role, role), _digest(token))])
    return token


def revoke_token(path: Path, name: str) -> None:
    """Remove the token of a name: the next request with it is refused.

    Parameters
    ----------
    path : Path
        File of the tokens (`tokens_file`).
    name : str
        As it was added.

    Raises
    ------
    InputError
        There is no token of the name.
    DeviceError
        The file cannot be read or written.
    """
    tokens = read_tokens(path)
    kept = [each for each in tokens if each.name != name]
    if len(kept) == len(tokens):
        known = ", ".join(each.name for each in tokens) or "none"
        raise errors.InputError(f"{name}: no such token; known: {known}")
    _write_tokens(path, kept)


def _write_tokens(path: Path, tokens: list[ProgramToken]) -> None:
    text = "".join(f"{each.name}:{each.role}:{each.digest}\n" for each in tokens)
    with errors.convert_write_errors(path, errors.DeviceError):
        files.write_text_atomic(path, text)
        path.chmod(0o600)


class TokenBook:
    """The tokens that count now.

    Parameters
    ----------
    path : Path
        Their file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stamp: tuple[int, int] | None = None
        self._tokens: list[ProgramToken] = []

    def find_user(self, token: str) -> WebUser | None:
        """Return whose token this is; None if nobody's, or if the file cannot be read."""
        self._read_changes()
        digest = _digest(token)
        for each in self._tokens:
            if hmac.compare_digest(each.digest, digest):
                return WebUser(each.name, each.role, has_login=True, via="token")
        return None

    def _read_changes(self) -> None:
        try:
            state = self._path.stat()
            stamp = state.st_mtime_ns, state.st_ino
            if stamp != self._stamp:
                self._tokens = read_tokens(self._path)
                self._stamp = stamp
        except (OSError, errors.CommandError):
            self._tokens = []
            self._stamp = None


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()
