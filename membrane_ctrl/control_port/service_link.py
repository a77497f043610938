"""How a hold finds the service of its runs, and the key of the service's local link.

The service keeps a file beside the runs with its address, and a lock on that file while it lives:
a killed service leaves a file that nobody has locked. The key is one file in the user's state
folder, so the link is the same after every start, and a bookmark stays valid.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import secrets
import socket
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

from membrane_ctrl.model import errors, files, plain_json
from membrane_ctrl.model.state_folder import find_state_folder

ADDRESS_NAME = "service.json"
_FOLDER_NAME = "service"
_KEY_NAME = "link-key"
_KEY_BYTES = 24
_ADDRESS_BYTES_MAX = 4096
_CONNECT_S = 0.5


def service_folder() -> Path:
    """Return the folder of the service's secrets, which only its user may read; make it if it is
    missing. Raises DeviceError.
    """
    state = find_state_folder()
    if state is None:
        raise errors.DeviceError("no home folder for the service's keys; set XDG_STATE_HOME")
    folder = state / _FOLDER_NAME
    with errors.convert_write_errors(folder, errors.DeviceError):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    return folder


def read_or_make_secret(name: str) -> str:
    """Return a random text that stays the same from start to start.

    Parameters
    ----------
    name : str
        Name of its file in `service_folder()`.

    Returns
    -------
    str
        The content of the file, which only this user can read; made at the first call.

    Raises
    ------
    DeviceError
        The file cannot be read or written.
    """
    path = service_folder() / name
    # Two programs may start at the same moment: the first link wins, and both read its file.
    scratch = path.with_name(f".{name}.{secrets.token_hex(8)}")
    with errors.convert_write_errors(path, errors.DeviceError):
        if not path.exists():
            handle = os.open(scratch, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                file.write(secrets.token_urlsafe(_KEY_BYTES))
            with contextlib.suppress(FileExistsError):
                os.link(scratch, path)
            scratch.unlink()
        text = files.read_text(path).strip()
    if not text:
        raise errors.DeviceError(f"{path}: empty; remove it, and a new key is made")
    return text


def link_key() -> str:
    """Return the key of the local link of this user's services. Raises DeviceError."""
    return read_or_make_secret(_KEY_NAME)


def add_key(base_url: str) -> str:
    """Return the link that lets its holder in. Raises DeviceError."""
    return f"{base_url}?key={link_key()}"


@contextlib.contextmanager
def publish_address(logs: Path, base_url: str, has_link: bool) -> Iterator[None]:
    """Name the service's address beside the runs for the duration of a `with` block.

    Parameters
    ----------
    logs : Path
        Folder of the runs; made if it is missing.
    base_url : str
        Address of the page.
    has_link : bool
        Whether a link with the key lets in; else people log in.

    Raises
    ------
    DeviceError
        Another service has this folder, or the folder cannot be written.
    """
    path = logs / ADDRESS_NAME
    with errors.convert_write_errors(path, errors.DeviceError):
        logs.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
    try:
        # The lock, and not the file, is the sign of a service: it ends with the process
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            other = _parse_address(os.pread(handle, _ADDRESS_BYTES_MAX, 0)) or ("unknown", False)
            raise errors.DeviceError(
                f"{logs}: another service has this folder of runs, at {other[0]}; end it, or "
                "choose another folder with --logs"
            ) from None
        with errors.convert_write_errors(path, errors.DeviceError):
            os.ftruncate(handle, 0)
            os.pwrite(handle, json.dumps({"url": base_url, "link": has_link}).encode(), 0)
        yield
        os.ftruncate(handle, 0)
    finally:
        os.close(handle)


def find_service(logs: Path) -> str | None:
    """Return the link of the service that follows a folder of runs; None without a service.

    The link has the key if the service has no users and this user may read the key; it is empty
    while the service starts.
    """
    try:
        handle = os.open(logs / ADDRESS_NAME, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            found = _parse_address(os.pread(handle, _ADDRESS_BYTES_MAX, 0))
        else:
            return None
    finally:
        os.close(handle)
    if found is None:
        return ""
    base_url, has_link = found
    if has_link:
        with contextlib.suppress(errors.DeviceError):
            return add_key(base_url)
    return base_url


def is_answering(link: str) -> bool:
    """Whether something accepts connections at the address of a link."""
    address = urlsplit(link)
    port = address.port or (443 if address.scheme == "https" else 80)
    try:
        socket.create_connection((address.hostname or "", port), _CONNECT_S).close()
    except OSError:
        return False
    return True


def _parse_address(content: bytes) -> tuple[str, bool] | None:
    """Return address and `has_link`; None for anything else, such as a file half written."""
    try:
        table = plain_json.loads(content.decode())
    except ValueError:
        return None
    if not isinstance(table, dict) or not isinstance(table.get("url"), str):
        return None
    url = table["url"]
    if not url.isprintable() or not url.startswith(("http://", "https://")):
        return None
    return url, table.get("link") is True
