"""The socket file: who the file system lets in, and what its owner may do."""

import contextlib
import grp
import os
import pwd
import socket
import stat
import struct
from collections.abc import Iterator
from pathlib import Path

from membrane_ctrl.control_port import endpoint, session
from membrane_ctrl.controller.commands import Role
from membrane_ctrl.model.errors import DeviceError, InputError, os_reason

SOCKET_NAME = "control.sock"
_MODE = 0o660
_PATH_BYTES = 107  # of `sun_path`, its closing zero left out
_CREDENTIALS = struct.Struct("3i")  # pid, uid, gid of SO_PEERCRED, unix(7)
_SOMEBODY_THERE_S = 1.0


class UnixListener:
    """A listening socket file, until `close`; all but its owner and root get `group_role`.

    Raises
    ------
    InputError, DeviceError
        The path is taken or in use, there is no such group, or no permission.
    """

    def __init__(self, path: Path, group: str | None, group_role: Role) -> None:
        self._path, self._group_role = path, group_role
        # looked up now, as a name service may take its time and a tick has none
        self._names = {entry.pw_uid: entry.pw_name for entry in pwd.getpwall()}
        try:
            self._made_folder = not path.parent.exists()
            path.parent.mkdir(parents=True, exist_ok=True)
            _remove_stale(path)
            self.socket = _bound(path, group)
        except OSError as error:
            reason = os_reason(error)
            raise DeviceError(f"{path}: no control port there ({reason}); choose another with port.socket") from None
        self._inode = path.stat().st_ino

    def peer(self, connection: socket.socket) -> session.Peer:
        """Who has connected, as the kernel says."""
        raw = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
        _, uid, _ = _CREDENTIALS.unpack(raw)
        role: Role = "tune" if uid in (0, os.getuid()) else self._group_role
        return session.Peer(f"unix:{self._names.get(uid, uid)}", role)

    def close(self) -> None:
        """Close it and remove the file, unless it has become another's; a folder made for it goes too, if empty."""
        self.socket.close()
        with contextlib.suppress(OSError):
            if self._path.stat().st_ino == self._inode:
                self._path.unlink()
                if self._made_folder:
                    self._path.parent.rmdir()


def _remove_stale(path: Path) -> None:
    """Remove a socket file that nobody listens on: its owner was killed."""
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(mode):
        raise InputError(f"{path}: is there and no socket; remove it, or choose another path with port.socket")
    with socket.socket(socket.AF_UNIX) as probe, short(path) as address:
        probe.settimeout(_SOMEBODY_THERE_S)  # of a listener that hangs the queue may be full
        try:
            probe.connect(address)
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)
            return
        except FileNotFoundError:
            return
        except (TimeoutError, BlockingIOError):
            pass
    raise DeviceError(f"{path}: another hold is listening there; stop it, or choose another path with port.socket")


def _bound(path: Path, group: str | None) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX)
    umask = os.umask(0o777 & ~_MODE)  # the file must at no moment let in more than it shall
    try:
        with short(path) as address:
            listener.bind(address)
        if group is not None:
            os.chown(path, -1, grp.getgrnam(group).gr_gid)
        listener.listen(endpoint.BACKLOG)
    except KeyError:
        listener.close()
        path.unlink()
        raise InputError(f"port.group: there is no group {group!r} on this machine") from None
    except OSError:
        listener.close()
        raise
    finally:
        os.umask(umask)
    listener.setblocking(False)
    return listener


@contextlib.contextmanager
def short(path: Path) -> Iterator[str]:
    """A name for the path that fits a socket address: itself, or one by way of its folder's open descriptor."""
    if len(os.fsencode(path)) <= _PATH_BYTES:
        yield str(path)
        return
    folder = os.open(path.parent, os.O_PATH | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{folder}/{path.name}"
    finally:
        os.close(folder)
