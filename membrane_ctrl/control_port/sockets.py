"""The socket file of the port; bound before anything else of the run exists.

File permissions decide who may use it; its owner may tune.
"""

import contextlib
import grp
import os
import pwd
import socket
import stat
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from membrane_ctrl.config.port import PortConfig
from membrane_ctrl.control_port import endpoint, sender
from membrane_ctrl.controller.command import Role
from membrane_ctrl.model.errors import DeviceError, InputError, os_reason

_MODE = 0o660
_PATH_BYTES = 107  # of `sun_path`, without its final zero
_CREDENTIALS = struct.Struct("3i")  # pid, uid, gid of SO_PEERCRED, unix(7)
_SOMEBODY_THERE_S = 1.0


class UnixListener:
    """A listening socket file, until `close`; all but its owner and root get `group_role`.

    Raises InputError or DeviceError if the path is in use, the group does not exist, or permission
    is missing.
    """

    def __init__(self, path: Path, group: str | None, group_role: Role) -> None:
        self._path = path
        self._group_role = group_role
        # looked up now: a name service may be too slow for a tick
        self._names = {entry.pw_uid: entry.pw_name for entry in pwd.getpwall()}
        try:
            self._made_folder = not path.parent.exists()
            path.parent.mkdir(parents=True, exist_ok=True)
            _remove_stale(path)
            self.socket = _bind_socket(path, group)
        except OSError as error:
            raise DeviceError(
                f"{path.parent}: cannot be written, and there is no control port in it "
                f"({os_reason(error)}); choose "
                "another folder for the runs with --logs or recording.logs_dir, or for the "
                "socket with port.socket"
            ) from None
        self._inode = path.stat().st_ino

    def peer(self, connection: socket.socket) -> sender.Peer:
        """Identity of the client, from the kernel."""
        raw = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
        pid, uid, _ = _CREDENTIALS.unpack(raw)
        role: Role = "tune" if uid in (0, os.getuid()) else self._group_role
        who = f"unix:{self._names.get(uid, uid)}"
        return sender.Peer(
            who, role, pid or None, is_own_user=uid == os.getuid()
        )  # pid 0: in another container

    def close(self) -> None:
        """Close it and remove the file, unless replaced by another; remove an empty folder made for
        it.
        """
        self.socket.close()
        with contextlib.suppress(OSError):
            if self._path.stat().st_ino == self._inode:
                self._path.unlink()
                if self._made_folder:
                    self._path.parent.rmdir()


def _remove_stale(path: Path) -> None:
    """Remove a socket file without a listener, left by a killed process."""
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(mode):
        raise InputError(
            f"{path}: exists and is not a socket; remove it, or choose another path with "
            "port.socket"
        )
    if not is_listening(path):
        path.unlink(missing_ok=True)
        return
    raise DeviceError(
        f"{path}: another hold is listening there; stop it, or choose another path with port.socket"
    )


def is_listening(path: Path) -> bool:
    """Whether a program listens on a socket file; one that hangs counts as well."""
    with socket.socket(socket.AF_UNIX) as probe, short(path) as address:
        probe.settimeout(_SOMEBODY_THERE_S)  # a hung listener's queue may be full
        try:
            probe.connect(address)
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except (TimeoutError, BlockingIOError):
            return True
    return True


def group_id(name: str) -> int:
    """The number of a group. Raises InputError."""
    try:
        return grp.getgrnam(name).gr_gid
    except KeyError:
        raise InputError(
            f"port.group: no group {name!r} on this machine; create it (sudo groupadd "
            f"{name}), or omit the key"
        ) from None


def _bind_socket(path: Path, group: str | None) -> socket.socket:
    """Make the socket file, for the user and, if given, a group. Raises OSError, InputError."""
    owner = -1 if group is None else group_id(group)
    listener = socket.socket(socket.AF_UNIX)
    umask = os.umask(0o777 & ~_MODE)  # the file must never have wider permissions
    try:
        with short(path) as address:
            listener.bind(address)
        os.chown(path, -1, owner)
        listener.listen(endpoint.BACKLOG)
    except OSError:
        listener.close()
        raise
    finally:
        os.umask(umask)
    listener.setblocking(False)
    return listener


@contextlib.contextmanager
def short(path: Path) -> Iterator[str]:
    """A path that fits a socket address: itself, or one through its folder's open descriptor."""
    if len(os.fsencode(path)) <= _PATH_BYTES:
        yield str(path)
        return
    folder = os.open(path.parent, os.O_PATH | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{folder}/{path.name}"
    finally:
        os.close(folder)


@dataclass(frozen=True, slots=True)
class Listeners:
    """The socket of the port, bound before anything else of the run exists; None if the port is
    off.
    """

    unix: UnixListener | None = None
    path: Path | None = None


def listeners_for(config: PortConfig, logs_dir: Path, stack: contextlib.ExitStack) -> Listeners:
    """Bind the configured socket.

    Parameters
    ----------
    config : PortConfig
        Of the port.
    logs_dir : Path
        Folder of the runs, in which the socket is by default.
    stack : ExitStack
        Closes it.

    Returns
    -------
    Listeners
        Without a socket if the port is not enabled.

    Raises
    ------
    InputError, DeviceError
        It cannot be bound.
    """
    if not config.enabled:
        return Listeners()
    path = config.socket_in(logs_dir)
    unix = UnixListener(path, config.group, config.group_role)
    stack.callback(unix.close)
    return Listeners(unix, path)
