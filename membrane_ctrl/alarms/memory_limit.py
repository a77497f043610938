"""Limits the memory of the process while it calls a library that reads what a server sends."""

from __future__ import annotations

import contextlib
import resource
from collections.abc import Iterator
from pathlib import Path

_MEMORY_BYTES = 400_000_000  # beyond what the process has; a usual answer has some kilobytes


@contextlib.contextmanager
def limited_memory() -> Iterator[None]:
    """Within this context, the process may take `_MEMORY_BYTES` more than it has."""
    before = resource.getrlimit(resource.RLIMIT_DATA)
    most_bytes = _data_bytes() + _MEMORY_BYTES
    if before[0] != resource.RLIM_INFINITY:
        most_bytes = min(most_bytes, before[0])
    resource.setrlimit(resource.RLIMIT_DATA, (most_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


def _data_bytes() -> int:
    """Memory of the process that counts against the limit."""
    rows = Path("/proc/self/status").read_text().splitlines()
    kilobytes = next(row.split()[1] for row in rows if row.startswith("VmData:"))
    return 1024 * int(kilobytes)
