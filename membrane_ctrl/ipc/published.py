"""The rings of a run for programs that the run did not start: their addresses in its folder, `rings.json`.

Reading them costs the control process nothing, and every tick is there for a minute: what a session needs and a
stream of status lines through the port is not (docs/decisions/96-a-session-reads-the-rings.md).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from multiprocessing import resource_tracker
from pathlib import Path

from membrane_ctrl.ipc.ring import RingAddress, RingReader
from membrane_ctrl.recording.atomic import write_text_atomic

_FILE = "rings.json"


def publish(run_dir: Path, rings: Mapping[str, RingAddress | None]) -> None:
    """Write the addresses of the rings that there are. Raises OSError."""
    found = {name: asdict(address) for name, address in rings.items() if address is not None}
    write_text_atomic(run_dir / _FILE, json.dumps(found, indent=1) + "\n")


def attach(run_dir: Path) -> dict[str, RingReader]:
    """Readers of a run's rings, each at its newest message.

    Raises
    ------
    FileNotFoundError
        The run has published none, or is over.
    """
    found = json.loads((run_dir / _FILE).read_text(encoding="utf-8"))
    readers: dict[str, RingReader] = {}
    for name, values in found.items():
        address = RingAddress(**values)
        readers[name] = RingReader(address)
        # Python below 3.13 takes whoever attaches for the owner and would remove the memory at our end.
        resource_tracker.unregister(f"/{address.name.lstrip('/')}", "shared_memory")
        readers[name].latest()
    return readers
