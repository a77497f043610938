"""Telemetry rows as a table: messages of the telemetry ring in, one NumPy column a field out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.telemetry import FIELDS

Rows = NDArray[np.float64]
COLUMN: dict[str, int] = {name: place for place, name in enumerate(FIELDS)}


def unpack(messages: Sequence[bytes]) -> Rows:
    """(n, len(FIELDS)) table of packed `TelemetryRow`s, in their order."""
    return np.frombuffer(b"".join(messages), dtype="<f8").reshape(-1, len(FIELDS))


def column(rows: Rows, name: str) -> NDArray[np.float64]:
    """One field of all rows, (n,)."""
    return rows[:, COLUMN[name]]


def changes(codes: NDArray[np.float64], before: float) -> list[tuple[int, int]]:
    """Where a code changes: (row, new code) for each, the first row compared with `before` (NaN: nothing before)."""
    previous = np.concatenate(([before], codes[:-1]))
    return [(int(row), int(codes[row])) for row in np.flatnonzero((codes != previous) & np.isfinite(codes))]
