"""All sockets of the port, bound before anything else of the run exists: an address in use is refused in one line."""

from __future__ import annotations

import socket
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from membrane_ctrl.port.unix import SOCKET_NAME, UnixListener
from membrane_ctrl.port_config import PortConfig

if TYPE_CHECKING:
    from membrane_ctrl.port.tls import TlsListener


@dataclass(frozen=True, slots=True)
class Listeners:
    """Bound and listening; None for what is not wanted."""

    unix: UnixListener | None = None
    tls: TlsListener | None = None
    metrics: socket.socket | None = None
    path: Path | None = None

    @property
    def addresses(self) -> dict[str, str]:
        """Where they are, for people."""
        found = {"socket": str(self.path)} if self.unix else {}
        tcp = {"tls": self.tls.socket if self.tls else None, "metrics": self.metrics}
        for name, listener in tcp.items():
            if listener is not None:
                host, port = listener.getsockname()[:2]
                found[name] = f"{host}:{port}"
        return found


def listeners_for(config: PortConfig, logs_dir: Path, stack: ExitStack) -> Listeners:
    """Bind what the configuration asks for; the stack closes it. Raises InputError or DeviceError."""
    if not config.enabled:
        return Listeners()
    path = Path(config.socket) if config.socket else logs_dir / SOCKET_NAME
    unix = UnixListener(path, config.group, config.group_role)
    stack.callback(unix.close)
    tls = metrics = None
    if config.tls is not None:
        from membrane_ctrl.port.tls import TlsListener

        tls = TlsListener(config.tls)
        stack.callback(tls.close)
    if config.metrics_port is not None:
        from membrane_ctrl.port.tls import listen_tcp

        metrics = listen_tcp("127.0.0.1", config.metrics_port, "port.metrics_port")
        stack.callback(metrics.close)
    return Listeners(unix, tls, metrics, path)
