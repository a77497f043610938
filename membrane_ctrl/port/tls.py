"""The port on TCP: nobody without a certificate that the configured authority has signed.

The name is the certificate's common name (CN), the role its organisational unit (OU: read, operate or tune); without
one of these it is `read`.
"""

from __future__ import annotations

import socket
import ssl
import time
from pathlib import Path
from typing import Any

from membrane_ctrl.commands import Role
from membrane_ctrl.errors import DeviceError, InputError
from membrane_ctrl.port.door import BACKLOG
from membrane_ctrl.port.people import Peer
from membrane_ctrl.port.protocol import WHO_BYTES
from membrane_ctrl.port_config import TlsConfig

_ROLES: dict[str, Role] = {"read": "read", "operate": "operate", "tune": "tune"}


class TlsListener:
    """A listening TCP socket and what its handshakes need.

    Parameters
    ----------
    config : TlsConfig
        Address and certificates.

    Raises
    ------
    InputError, DeviceError
        One line: a file that is no certificate or key, an address that cannot be had.
    """

    def __init__(self, config: TlsConfig) -> None:
        self.context = server_context(config)
        self.socket = listen_tcp(config.host, config.port, "port.tls")

    def peer(self, certificate: dict[str, Any]) -> Peer:
        """Who the certificate (as of `getpeercert`) names, and as what; who has no name may only read.

        All the nameless would be one commander, and the record could not say who it was.
        """
        subject = {key: value for part in certificate.get("subject", ()) for key, value in part}
        name = "".join(c for c in subject.get("commonName", "") if c.isprintable()).strip()
        if not name:
            return Peer("tls:nameless", "read")
        who = f"tls:{name}".encode()[:WHO_BYTES].decode(errors="ignore")
        return Peer(who, _ROLES.get(subject.get("organizationalUnitName", ""), "read"))

    def lasts_s(self, certificate: dict[str, Any]) -> float:
        """How long the certificate is valid from now on: a connection must not outlive it."""
        return ssl.cert_time_to_seconds(certificate["notAfter"]) - time.time()

    def close(self) -> None:
        """Close the socket."""
        self.socket.close()


def server_context(config: TlsConfig) -> ssl.SSLContext:
    """TLS 1.3, and a client certificate or nothing. Raises InputError naming the file."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.verify_mode = ssl.CERT_REQUIRED
    context.num_tickets = 0  # a resumed session would not look at the certificate's date again
    load_pair(context, Path(config.certificate_file), Path(config.key_file))
    load_authority(context, Path(config.client_ca_file))
    return context


def client_context(certificate: Path, key: Path, authority: Path) -> ssl.SSLContext:
    """The other side of `server_context`. Raises InputError naming the file."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    load_pair(context, certificate, key)
    load_authority(context, authority)
    return context


def load_pair(context: ssl.SSLContext, certificate: Path, key: Path) -> None:
    """The own certificate and its key, which must not ask for a password. Raises InputError."""
    for path in (certificate, key):
        _require_readable(path)
    try:
        context.load_cert_chain(certificate, key, password=lambda: "")
    except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
        raise InputError(f"{certificate}, {key}: no certificate with its unencrypted key ({error})") from None


def load_authority(context: ssl.SSLContext, authority: Path) -> None:
    """Whose signature counts. Raises InputError."""
    _require_readable(authority)
    try:
        context.load_verify_locations(authority)
    except (OSError, ValueError) as error:
        raise InputError(f"{authority}: no certificate of an authority ({error})") from None


def listen_tcp(host: str, port: int, field: str) -> socket.socket:
    """A listening socket. Raises DeviceError naming the configuration's field."""
    try:
        listener = socket.create_server((host, port), backlog=BACKLOG)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise DeviceError(f"{field}: cannot listen on {host}:{port} ({reason})") from None
    listener.setblocking(False)
    return listener


def _require_readable(path: Path) -> None:
    try:
        path.open("rb").close()
    except OSError as error:
        raise InputError(f"{path}: {(error.strerror or str(error)).lower()}") from None
