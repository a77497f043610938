"""The command `devices`: hardware and drivers on this machine."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.table import Table

from firmware_iface import drivers, roles
from firmware_iface.links import aravis
from firmware_iface.links.port_names import list_serial_ports
from membrane_ctrl.model import errors, terminal

_DRM = Path("/sys/class/drm")


@dataclass(frozen=True, slots=True)
class FoundDevice:
    """A port, camera or display, or a driver that another package provides."""

    # "port", "camera", "display", or a kind of driver: "driver", "camera driver", "screen driver"
    kind: str
    name: str  # its own description
    paste: str = ""  # configuration line that names it; may be empty


def list_devices(as_json: bool) -> int:
    """Print every device found, and the searches that failed."""
    cameras, missing = find_cameras()
    found = [*find_ports(), *cameras, *find_displays(), *find_drivers()]
    if as_json:
        listed = [asdict(device) for device in found]
        print(json.dumps({"schema": "membrane-devices/1", "devices": listed, "notes": missing}))
        return errors.Exit.DONE
    table = Table("kind", "name", "to paste")
    for device in found:
        table.add_row(device.kind, device.name, device.paste)
    console = terminal.table_console()
    console.print(table if found else "nothing found: no serial port, camera or display")
    for note in missing:
        console.print(note)
    return errors.Exit.DONE


def find_ports() -> list[FoundDevice]:
    """Serial ports, by USB identity if they have one: it survives replugging."""
    return [
        FoundDevice(
            "port", f"{port.path}: {port.description}", f'port = "{port.usb_name or port.path}"'
        )
        for port in list_serial_ports()
    ]


def find_cameras() -> tuple[list[FoundDevice], list[str]]:
    """GenICam cameras, and a note if the search is impossible."""
    try:
        cameras = list(aravis.find_cameras())
    except roles.LinkError as error:
        return [], [str(error)]
    return [
        FoundDevice("camera", f"{camera.vendor} {camera.model}", f'camera = "{camera.camera_id}"')
        for camera in cameras
    ], []


def find_displays(root: Path = _DRM) -> list[FoundDevice]:
    """Connected displays, as listed by the kernel; needs no desktop."""
    found = []
    for status in sorted(root.glob("card*-*/status")):
        if status.read_text(encoding="ascii").strip() != "connected":
            continue
        connector = status.parent.name.split("-", 1)[1]
        modes = (status.parent / "modes").read_text(encoding="ascii").split()
        size = modes[0] if modes else "size unknown"
        width, _, height = size.partition("x")
        paste = ""
        if width.isdigit() and height.isdigit():
            paste = f"width_px = {width}\nheight_px = {height}"
        found.append(FoundDevice("display", f"{connector}, {size}", paste))
    return found


def find_drivers() -> list[FoundDevice]:
    """Drivers that other packages provide (docs/how-to/new-device.md); none of them is loaded."""
    return [
        FoundDevice(
            kind.name,
            f"{entry.name}, of {entry.dist.name} {entry.dist.version}"
            if entry.dist
            else entry.name,
            f'driver = "external"\nname = "{entry.name}"',
        )
        for kind in drivers.KINDS
        for entry in drivers.list_installed(kind.group)
    ]
