"""Drivers of devices, each of which fills a role of `roles.py`; and those of other packages.

A package names its driver in the entry point group of its kind, and an emulator of the device in
the group of its emulators (docs/how-to/new-device.md). The drivers of this package that are made
from their settings alone, and those of cameras and screens, are entry points as well, listed below.
Only an installed package is ever executed, and only when a configuration names it: no
configuration, run folder or working folder can name a file.
"""

from typing import TYPE_CHECKING, Any

from firmware_iface.driver_kind import DriverKind

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


INSTRUMENTS = DriverKind(
    "driver",
    "membrane_ctrl.drivers",
    "membrane_ctrl.emulators",
    {
        "keyence_dl_rs1a": "firmware_iface.drivers.keyence_dl_rs1a:KeyenceDlRs1a",
        "mks_937b": "firmware_iface.drivers.mks_937b:Mks937b",
        "optoncdt1420": "firmware_iface.drivers.optoncdt1420:Optoncdt1420",
        "vaisala_ptb330": "firmware_iface.drivers.vaisala_ptb330:VaisalaPtb330",
        "ventus": "firmware_iface.drivers.ventus:Ventus",
    },
)
CAMERAS = DriverKind(
    "camera driver",
    "membrane_ctrl.cameras",
    "membrane_ctrl.camera_emulators",
    {
        "aravis": "firmware_iface.drivers.camera_aravis:AravisCamera",
        "folder": "firmware_iface.drivers.camera_opencv:FolderCamera",
        "uvc": "firmware_iface.drivers.camera_opencv:UvcCamera",
    },
)
SCREENS = DriverKind(
    "screen driver",
    "membrane_ctrl.screens",
    "membrane_ctrl.screen_emulators",
    {"pygame": "firmware_iface.drivers.screen_pygame:PygameDisplay"},
)
KINDS = (INSTRUMENTS, CAMERAS, SCREENS)


def load_built_in(name: str, kind: DriverKind) -> Any:
    """Import the driver class of this name in this package; no other package can take its place.

    Parameters
    ----------
    name : str
        A key of `kind.built_in`, such as `mks_937b`.
    kind : DriverKind
        Of instruments, cameras or screens.

    Returns
    -------
    type
        The class, not yet made into a driver. What it imports (OpenCV, pygame) is imported now.

    Raises
    ------
    ImportError
        An extra that the driver needs is not installed.
    """
    from importlib.metadata import EntryPoint

    return EntryPoint(name, kind.built_in[name], kind.group).load()


def list_installed(group: str) -> list["EntryPoint"]:
    """List what other packages provide in a group, by name; load none of it."""
    from importlib.metadata import entry_points

    return sorted(entry_points(group=group), key=lambda entry: entry.name)


def load_driver(name: str, kind: DriverKind) -> Any:
    """Import the driver class that another package installs under a name.

    Parameters
    ----------
    name : str
        Of the driver.
    kind : DriverKind
        Its entry point group.

    Returns
    -------
    Any
        The class.

    Raises
    ------
    ValueError
        None or several packages do, or it cannot be loaded.
    """
    return _load_entry(name, kind.name, list_installed(kind.group))


def load_emulator(name: str, kind: DriverKind) -> Any:
    """Import the emulator class of the device of a driver that another package installs.

    Parameters
    ----------
    name : str
        Of the driver, under which its package also names the emulator.
    kind : DriverKind
        Its `emulators` is the entry point group.

    Raises
    ------
    ValueError
        None or several packages install one, or it cannot be loaded.
    """
    return _load_entry(
        name, f"{kind.name.removesuffix('driver')}emulator", list_installed(kind.emulators)
    )


def has_emulator(name: str, kind: DriverKind) -> bool:
    """Return whether an emulator of a driver's device is installed; nothing is imported.

    Parameters
    ----------
    name : str
        Of a driver that another package installs. The emulators of this package are no entry
        points, and are not found here.
    kind : DriverKind
        Of instruments, cameras or screens.
    """
    return any(entry.name == name for entry in list_installed(kind.emulators))


def _load_entry(name: str, what: str, entries: list["EntryPoint"]) -> Any:
    found = [entry for entry in entries if entry.name == name]
    if not found:
        known = ", ".join(entry.name for entry in entries) or "none"
        raise ValueError(
            f"no {what} {name!r} is installed; installed: {known} (docs/how-to/new-device.md)"
        )
    if len(found) > 1:
        packages = " and ".join(entry.dist.name if entry.dist else entry.value for entry in found)
        raise ValueError(f"{packages} both install a {what} {name!r}; uninstall one")
    try:
        return found[0].load()
    except (Exception, SystemExit) as error:  # whatever its module does
        raise ValueError(
            f"the {what} {name} ({found[0].value}) does not load: {type(error).__name__}: {error}"
        ) from error
