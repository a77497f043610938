"""`devices`: the hardware and drivers on this machine, with the text to paste into a configuration."""

import asyncio
import json
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.table import Table

from firmware_iface import conformance, drivers, roles
from firmware_iface.links import aravis
from firmware_iface.links.serial_port import serial_ports
from membrane_ctrl.instruments.bench import locked, modbus_names
from membrane_ctrl.model import errors, terminal

_DRM = Path("/sys/class/drm")


@dataclass(frozen=True, slots=True)
class FoundDevice:
    """A port, camera or display, or a driver that another package provides."""

    kind: str  # "port", "camera", "display" or "driver"
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
        FoundDevice("port", f"{port.path}: {port.description}", f'port = "{port.usb_name or port.path}"')
        for port in serial_ports()
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
        paste = f"width_px = {width}\nheight_px = {height}" if width.isdigit() and height.isdigit() else ""
        found.append(FoundDevice("display", f"{connector}, {size}", paste))
    return found


def find_drivers() -> list[FoundDevice]:
    """Drivers that other packages provide (docs/new-device.md); none of them is loaded."""
    return [
        FoundDevice(
            "driver",
            f"{entry.name}, of {entry.dist.name} {entry.dist.version}" if entry.dist else entry.name,
            f'driver = "external"\nname = "{entry.name}"',
        )
        for entry in drivers.installed()
    ]


def run_conformance(url: str, unit_id: int, as_json: bool) -> int:
    """`conformance`: test a board and report; exits with REJECTED if it fails.

    Raises InputError for a bad URL, DeviceError if the board does not answer or another program uses it.
    """
    try:
        with locked(modbus_names(url, unit_id)):
            findings = asyncio.run(conformance.examine(url, unit_id))
    except ValueError as error:
        raise errors.InputError(str(error)) from None
    except roles.LinkError as error:
        raise errors.DeviceError(str(error)) from None
    passed = not any(finding.problem for finding in findings)
    if as_json:
        checks = [asdict(finding) for finding in findings]
        print(json.dumps({"schema": "membrane-conformance/1", "board": url, "passed": passed, "checks": checks}))
    else:
        table = Table("check", "result", "docs/firmware.md")
        for finding in findings:
            table.add_row(finding.check, finding.problem or "passed", finding.section)
        terminal.table_console().print(table)
        terminal.table_console().print("conforms" if passed else "does not conform: do not use it to run a pump")
    return errors.Exit.DONE if passed else errors.Exit.REJECTED
