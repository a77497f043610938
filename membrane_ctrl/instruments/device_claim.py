"""One program per device on this machine, whatever its folder or user.

A claim is a name in the kernel's table of abstract sockets (unix(7)): not a file, which a link
could redirect, a sandbox hide, another user own or a killed process leave behind. The kernel
identifies the listener that owns it.
"""

import contextlib
import hashlib
import socket
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path

from membrane_ctrl.model.errors import DeviceError
from membrane_ctrl.model.terminal import one_line

# of SO_PEERCRED: pid, uid, gid
_CREDENTIALS = struct.Struct("3i")
# Each refused program connects to the holder's socket once to identify it; the kernel queues this
# many
_ASKERS = 4096
_SHOWN = 100  # characters of the holder's command line


@contextlib.contextmanager
def claim_devices(devices: Iterable[str]) -> Iterator[None]:
    """Claim these devices (`device_names`, `modbus_names`) until the end of the block or of the
    process.

    Raises DeviceError, naming the device, the program that uses it and the remedy in one line.
    """
    # An abstract socket for each name: the kernel frees it however the process ends, and knows
    # which process has it. In sorted order, so that two programs with common devices do not each
    # get one of them
    with contextlib.ExitStack() as stack:
        for device in sorted(set(devices)):
            held = stack.enter_context(socket.socket(socket.AF_UNIX))
            address = _socket_address(device)
            try:
                held.bind(address)
            except OSError:
                raise DeviceError(
                    f"{device}: in use by {_describe_owner(address)}; stop that first "
                    "(`membrane-ctrl ctl stop`, or Ctrl-C)"
                ) from None
            held.listen(_ASKERS)
        yield


def _socket_address(device: str) -> bytes:
    return b"\0membrane-ctrl/device/" + hashlib.sha256(device.encode()).hexdigest()[:32].encode()


def _describe_owner(address: bytes) -> str:
    """The process that listens there, if known."""
    with socket.socket(socket.AF_UNIX) as probe:
        probe.setblocking(False)
        try:
            probe.connect(address)
            raw = probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
        except OSError:
            return "another program"
    pid = int(_CREDENTIALS.unpack(raw)[0])
    try:
        words = (
            Path(f"/proc/{pid}/cmdline")
            .read_bytes()
            .decode(errors="replace")
            .rstrip("\0")
            .split("\0")
        )
    except OSError:  # it has just ended, or the process table is hidden
        return f"process {pid}"
    return f"process {pid} ({one_line(' '.join(words))[:_SHOWN]})"
