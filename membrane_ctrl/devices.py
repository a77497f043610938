"""`devices`: what is plugged into this machine, with the text to paste into a configuration."""

from __future__ import annotations

import importlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from firmware_iface.links.usb_ports import serial_ports
from membrane_ctrl.errors import Exit

_DRM = Path("/sys/class/drm")
_NO_ARAVIS = "aravis is not installed: apt install gir1.2-aravis-0.8, then pip install 'PyGObject<3.51'"


@dataclass(frozen=True, slots=True)
class Found:
    """One thing that is there.

    Attributes
    ----------
    kind : str
        "port", "camera" or "display".
    name : str
        What it says it is.
    paste : str
        The line of a configuration that names it; empty when none does.
    """

    kind: str
    name: str
    paste: str = ""


def list_devices(as_json: bool) -> int:
    """Print everything that was found, and what could not be looked for."""
    cameras, missing = find_cameras()
    found = [*find_ports(), *cameras, *find_displays()]
    if as_json:
        listed = [asdict(device) for device in found]
        print(json.dumps({"schema": "membrane-devices/1", "devices": listed, "notes": missing}))
        return Exit.DONE
    table = Table("kind", "name", "to paste")
    for device in found:
        table.add_row(device.kind, escape(device.name), escape(device.paste))
    console = Console()
    console.print(table if found else "nothing found: no serial port, camera or display")
    for note in missing:
        console.print(escape(note))
    return Exit.DONE


def find_ports() -> list[Found]:
    """Serial ports; by their USB identity where they have one, since that survives a replug."""
    return [
        Found("port", f"{port.path}: {port.description}", f'port = "{port.usb_name or port.path}"')
        for port in serial_ports()
    ]


def find_cameras() -> tuple[list[Found], list[str]]:
    """GenICam cameras, and a note when they cannot be looked for."""
    try:
        aravis = _aravis()
    except (ImportError, ValueError):
        return [], [_NO_ARAVIS]
    aravis.update_device_list()
    count = aravis.get_n_devices()
    return [
        Found(
            "camera",
            f"{aravis.get_device_vendor(index)} {aravis.get_device_model(index)}",
            f'camera = "{aravis.get_device_id(index)}"',
        )
        for index in range(count)
    ], []


def _aravis() -> Any:
    importlib.import_module("gi").require_version("Aravis", "0.8")  # an optional extra
    return importlib.import_module("gi.repository.Aravis")


def find_displays(root: Path = _DRM) -> list[Found]:
    """Connected displays, as the kernel knows them: works without a running desktop."""
    found = []
    for status in sorted(root.glob("card*-*/status")):
        if status.read_text(encoding="ascii").strip() != "connected":
            continue
        connector = status.parent.name.split("-", 1)[1]
        modes = (status.parent / "modes").read_text(encoding="ascii").split()
        size = modes[0] if modes else "size unknown"
        found.append(Found("display", f"{connector}, {size}"))
    return found
