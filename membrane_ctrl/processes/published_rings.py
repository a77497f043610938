"""Publishes a run's rings: their addresses stand in a file of the run's folder.

The control process keeps a lock on that file while it lives, so other processes notice its end
even if it was killed.
"""

import fcntl
import json
import os
import re
from collections.abc import Collection, Mapping
from contextlib import ExitStack
from dataclasses import asdict
from mmap import PROT_READ, mmap
from pathlib import Path
from typing import Any

from membrane_ctrl.model.files import open_plain, read_bytes, write_text_atomic
from membrane_ctrl.processes.ring import RingAddress, RingError, RingReader

_FILE = "rings.json"
_FILE_BYTES_MAX = 4096  # three rings take 250
_NAME = re.compile(r"psm_[0-9a-f]{8}")  # the names that Python's `SharedMemory` gives
_RINGS = frozenset({"telemetry", "events", "shapes"})
_SHARED_MEMORY_FOLDER = Path("/dev/shm")


def publish_rings(run_dir: Path, rings: Mapping[str, RingAddress | None], stack: ExitStack) -> None:
    """Write the addresses of the existing rings into the run's folder, and lock that file.

    Called by the control process. The lock is the sign that it lives: the kernel removes it however
    the process ends (`is_control_alive`).

    Parameters
    ----------
    run_dir : Path
        Folder of the run.
    rings : mapping of RingAddress or None
        By name: `telemetry`, `events`, `shapes`; None for one that this run has not.
    stack : ExitStack
        Ends the lock; the file stays.

    Raises
    ------
    OSError
        The folder cannot be written.
    """
    found = {name: asdict(address) for name, address in rings.items() if address is not None}
    write_text_atomic(run_dir / _FILE, json.dumps(found, indent=1) + "\n")
    file = stack.enter_context(open_plain(run_dir / _FILE))
    fcntl.flock(file, fcntl.LOCK_EX)


def is_control_alive(run_dir: Path) -> bool:
    """Whether the control process of a run lives. Raises OSError if the run has published nothing.

    Between the publication and the lock it does not seem to: ask twice.
    """
    with open_plain(run_dir / _FILE) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def attach_rings(run_dir: Path, whole: Collection[str] = ()) -> dict[str, RingReader]:
    """Attach readers to the rings of a run, each at its newest message.

    Parameters
    ----------
    run_dir : Path
        The run.
    whole : collection of str
        Names of rings to read from their oldest message.

    Returns
    -------
    dict of RingReader
        Readers by name.

    Raises
    ------
    FileNotFoundError
        The run has published none, or is over.
    OSError, RingError
        The addresses are not those of our rings.
    """
    readers: dict[str, RingReader] = {}
    with ExitStack() as stack:
        for name, address in _read_addresses(run_dir / _FILE).items():
            readers[name] = RingReader(address, _map_memory(address))
            stack.callback(readers[name].close)
            if name not in whole:
                readers[name].latest()
        stack.pop_all()
    return readers


def _read_addresses(path: Path) -> dict[str, RingAddress]:
    text = read_bytes(path, _FILE_BYTES_MAX)
    try:
        return {name: _parse_address(name, values) for name, values in json.loads(text).items()}
    except (ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
        raise RingError(f"{_FILE} is damaged: {error}") from None


def _parse_address(ring: str, values: dict[str, Any]) -> RingAddress:
    name = values["name"]
    slots = values["slots"]
    slot_bytes = values["slot_bytes"]
    if (
        ring not in _RINGS
        or not _NAME.fullmatch(name)
        or type(slots) is not int
        or type(slot_bytes) is not int
    ):
        raise RingError(f"{ring!r:.40} is not the address of a ring")
    return RingAddress(name, slots, slot_bytes)


def _map_memory(address: RingAddress) -> mmap:
    """Map the ring's memory read-only. Raises OSError, RingError."""
    with open_plain(_SHARED_MEMORY_FOLDER / address.name) as file:
        found, size_bytes = os.fstat(file.fileno()), address.size_bytes
        if found.st_uid != os.geteuid():
            raise RingError(f"{address.name} belongs to user {found.st_uid}: run as that user")
        if found.st_size != size_bytes:
            raise RingError(
                f"{address.name} has {found.st_size} bytes, not the {size_bytes} of the ring"
            )
        return mmap(file.fileno(), size_bytes, prot=PROT_READ)
