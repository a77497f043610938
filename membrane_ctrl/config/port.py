"""Configuration of the control port of a hold."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from firmware_iface.settings import Section

SOCKET_NAME = "control.sock"
LOCAL = "127.0.0.1"
LOCAL_HOSTS = frozenset({LOCAL, "localhost", "::1"})


class PortConfig(Section):
    """Where a running hold listens."""

    enabled: bool = True
    """Listen for commands. Set it to false to take none but signals."""
    socket: str | None = None
    """Socket file; control.sock beside the run folders when absent. Set it for a path that others
    expect.
    """
    group: str | None = None
    """Group that owns the socket file, whose members may connect. Set it to let others operate the
    mirror.
    """
    group_role: Literal["read", "operate", "tune"] = "operate"
    """Role of everyone but the owner and root, who have `tune`. Change it to restrict or trust the
    group.
    """
    commander_lapses_s: Annotated[float, Field(ge=1, le=1e6)] = 600.0
    """Silence after which another may command without --take-over. Change it to the pace of your
    shifts.
    """

    def socket_in(self, logs_dir: Path) -> Path:
        """The socket's file of a hold with its runs in `logs_dir`."""
        if self.socket:
            return Path(self.socket)
        return logs_dir / SOCKET_NAME
