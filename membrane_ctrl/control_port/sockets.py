"""The sockets of the port: a socket file, TLS on TCP, metrics; bound before anything else of the
run exists.

File permissions decide who may use the socket file; its owner may tune. On TCP every client needs a
certificate signed by the configured authority: its common name (CN) is the peer's name, its
organisational unit (OU) the role (read, operate or tune); if one of them is missing, the peer may
only read.
"""

import contextlib
import grp
import os
import pwd
import socket
import ssl
import stat
import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from membrane_ctrl.config.port import PortConfig, TlsConfig
from membrane_ctrl.control_port import endpoint, protocol
from membrane_ctrl.controller.commands import Role
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
        self._path, self._group_role = path, group_role
        # looked up now: a name service may be too slow for a tick
        self._names = {entry.pw_uid: entry.pw_name for entry in pwd.getpwall()}
        try:
            self._made_folder = not path.parent.exists()
            path.parent.mkdir(parents=True, exist_ok=True)
            _remove_stale(path)
            self.socket = _bound(path, group)
        except OSError as error:
            raise DeviceError(
                f"{path.parent}: cannot be written, and there is no control port in it "
                f"({os_reason(error)}); choose "
                "another folder for the runs with --logs or recording.logs_dir, or for the "
                "socket with port.socket"
            ) from None
        self._inode = path.stat().st_ino

    def peer(self, connection: socket.socket) -> protocol.Peer:
        """Identity of the client, from the kernel."""
        raw = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
        pid, uid, _ = _CREDENTIALS.unpack(raw)
        role: Role = "tune" if uid in (0, os.getuid()) else self._group_role
        who = f"unix:{self._names.get(uid, uid)}"
        return protocol.Peer(
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


def _bound(path: Path, group: str | None) -> socket.socket:
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


_ROLES: dict[str, Role] = {"read": "read", "operate": "operate", "tune": "tune"}


class TlsListener:
    """A listening TCP socket and the context of its handshakes.

    Raises InputError for a bad certificate or key, DeviceError if the address cannot be used.
    """

    def __init__(self, config: TlsConfig) -> None:
        self.context = server_context(config)
        self.socket = listen_tcp(config.host, config.port, "port.tls")

    def peer(self, certificate: dict[str, Any]) -> protocol.Peer:
        """Name and role in a certificate (from `getpeercert`); without a name, which commands
        record, read only.
        """
        subject = {key: value for part in certificate.get("subject", ()) for key, value in part}
        name = "".join(c for c in subject.get("commonName", "") if c.isprintable()).strip()
        if not name:
            return protocol.Peer("tls:nameless", "read")
        who = f"tls:{name}".encode()[: protocol.WHO_BYTES].decode(errors="ignore")
        return protocol.Peer(who, _ROLES.get(subject.get("organizationalUnitName", ""), "read"))

    def lasts_s(self, certificate: dict[str, Any]) -> float:
        """Remaining validity of the certificate: a connection must not outlive it."""
        return ssl.cert_time_to_seconds(certificate["notAfter"]) - time.time()

    def close(self) -> None:
        """Close the socket."""
        self.socket.close()


def server_context(config: TlsConfig) -> ssl.SSLContext:
    """TLS 1.3 with a mandatory client certificate. Raises InputError naming the file."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.verify_mode = ssl.CERT_REQUIRED
    context.num_tickets = 0  # a resumed session would not check the certificate's date again
    load_pair(context, Path(config.certificate_file), Path(config.key_file))
    load_authority(context, Path(config.client_ca_file))
    return context


def client_context(certificate: Path, key: Path, authority: Path) -> ssl.SSLContext:
    """The client's counterpart of `server_context`. Raises InputError naming the file."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    load_pair(context, certificate, key)
    load_authority(context, authority)
    return context


def load_pair(context: ssl.SSLContext, certificate: Path, key: Path) -> None:
    """Load our certificate and its key, which must not need a password. Raises InputError."""
    for path in (certificate, key):
        _require_readable(path)
    try:
        context.load_cert_chain(certificate, key, password=lambda: "")
    except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
        raise InputError(
            f"{certificate}, {key}: not a certificate and its unencrypted key ({error})"
        ) from None


def load_authority(context: ssl.SSLContext, authority: Path) -> None:
    """Load the trusted authority. Raises InputError."""
    _require_readable(authority)
    try:
        context.load_verify_locations(authority)
    except (OSError, ValueError) as error:
        raise InputError(f"{authority}: not an authority's certificate ({error})") from None


def listen_tcp(host: str, port: int, field: str) -> socket.socket:
    """A listening socket. Raises DeviceError naming the configuration's field."""
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        listener = socket.create_server((host, port), family=family, backlog=endpoint.BACKLOG)
    except OSError as error:
        reason = os_reason(error)
        raise DeviceError(f"{field}: cannot listen on {host}:{port} ({reason})") from None
    listener.setblocking(False)
    return listener


def _require_readable(path: Path) -> None:
    try:
        path.open("rb").close()
    except OSError as error:
        raise InputError(f"{path}: {os_reason(error)}") from None


@dataclass(frozen=True, slots=True)
class Listeners:
    """All sockets of the port, bound before anything else of the run exists; None for those not
    configured.
    """

    unix: UnixListener | None = None
    tls: TlsListener | None = None
    metrics: socket.socket | None = None
    path: Path | None = None

    @property
    def addresses(self) -> dict[str, str]:
        """Their addresses, for people."""
        found = {"socket": str(self.path)} if self.unix else {}
        tcp = {"tls": self.tls.socket if self.tls else None, "metrics": self.metrics}
        for name, listener in tcp.items():
            if listener is not None:
                host, port = listener.getsockname()[:2]
                found[name] = f"{host}:{port}"
        return found


def listeners_for(config: PortConfig, logs_dir: Path, stack: contextlib.ExitStack) -> Listeners:
    """Bind the configured sockets; the stack closes them. Raises InputError or DeviceError."""
    if not config.enabled:
        return Listeners()
    path = config.socket_in(logs_dir)
    unix = UnixListener(path, config.group, config.group_role)
    stack.callback(unix.close)
    tls = metrics = None
    if config.tls is not None:
        tls = TlsListener(config.tls)
        stack.callback(tls.close)
    if config.metrics_port is not None:
        metrics = listen_tcp("127.0.0.1", config.metrics_port, "port.metrics_port")
        stack.callback(metrics.close)
    return Listeners(unix, tls, metrics, path)
