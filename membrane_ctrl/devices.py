"""`devices`: what is plugged into this machine, with the text to paste into a configuration."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from firmware_iface.links import aravis
from firmware_iface.links.usb_ports import serial_ports
from firmware_iface.roles import LinkError
from membrane_ctrl.errors import Exit
from membrane_ctrl.terminal import table_console

_DRM = Path("/sys/class/drm")


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
    console = table_console()
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
        cameras = list(aravis.find_cameras())
    except LinkError as error:
        return [], [str(error)]
    return [
        Found("camera", f"{camera.vendor} {camera.model}", f'camera = "{camera.camera_id}"') for camera in cameras
    ], []


def find_displays(root: Path = _DRM) -> list[Found]:
    """Connected displays, as the kernel knows them: works without a running desktop."""
    found = []
    for status in sorted(root.glob("card*-*/status")):
        if status.read_text(encoding="ascii").strip() != "connected":
            continue
        connector = status.parent.name.split("-", 1)[1]
        modes = (status.parent / "modes").read_text(encoding="ascii").split()
        size = modes[0] if modes else "size unknown"
        width, _, height = size.partition("x")
        paste = f"width_px = {width}\nheight_px = {height}" if width.isdigit() and height.isdigit() else ""
        found.append(Found("display", f"{connector}, {size}", paste))
    return found
