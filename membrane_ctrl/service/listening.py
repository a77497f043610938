"""Checks, before the server starts, that its address is free and its certificate can be used."""

from __future__ import annotations

import socket
import ssl
from pathlib import Path

from membrane_ctrl.model.errors import DeviceError, InputError, os_reason


def require_certificate(certificate: Path, key: Path) -> None:
    """Raise InputError for files that are no certificate and its key.

    Parameters
    ----------
    certificate : Path
        In PEM, with the chain if there is one.
    key : Path
        In PEM, without a password: nobody could type it at a start by systemd.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    for path in (certificate, key):
        _require_readable(path)
    try:
        context.load_cert_chain(certificate, key, password=lambda: "")
    except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
        raise InputError(
            f"{certificate}, {key}: not a certificate and its unencrypted key ({error})"
        ) from None


def require_free_address(host: str, port: int) -> None:
    """Raise DeviceError if a server cannot listen there.

    The socket is closed again, so that the reason is known before the service starts its threads.

    Parameters
    ----------
    host : str
        Name or address; with a colon it is one of IPv6.
    port : int
        0 is always free.
    """
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        socket.create_server((host, port), family=family).close()
    except OSError as error:
        reason = os_reason(error)
        raise DeviceError(f"port: cannot listen on {host}:{port} ({reason})") from None


def _require_readable(path: Path) -> None:
    try:
        path.open("rb").close()
    except OSError as error:
        raise InputError(f"{path}: {os_reason(error)}") from None
