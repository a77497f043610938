"""Drivers of devices, each of which fills a role of `roles.py`; and those of other packages.

Another package names its driver in the entry point group `membrane_ctrl.drivers`, and an emulator of the instrument
in `membrane_ctrl.emulators` (docs/new-device.md). Only an installed package is ever executed: no configuration, run
folder or working folder can name a file.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

DRIVERS, EMULATORS = "membrane_ctrl.drivers", "membrane_ctrl.emulators"


def installed(group: str = DRIVERS) -> Iterator["EntryPoint"]:
    """Yield the drivers (or emulators) that other packages provide, by name; loads none of them."""
    from importlib.metadata import entry_points

    yield from sorted(entry_points(group=group), key=lambda entry: entry.name)


def load(name: str, group: str = DRIVERS) -> Any:
    """Import the driver class (or emulator class) that another package installs under this name.

    Raises ValueError if none or several do, or if it cannot be imported.
    """
    found = [entry for entry in installed(group) if entry.name == name]
    kind = "emulator" if group == EMULATORS else "driver"
    if not found:
        known = ", ".join(entry.name for entry in installed(group)) or "none"
        raise ValueError(f"no {kind} {name!r} is installed; installed: {known} (docs/new-device.md)")
    if len(found) > 1:
        packages = " and ".join(entry.dist.name if entry.dist else entry.value for entry in found)
        raise ValueError(f"{packages} both install a {kind} {name!r}; uninstall one")
    try:
        return found[0].load()
    except Exception as error:  # whatever its module does
        raise ValueError(
            f"the {kind} {name} ({found[0].value}) does not load: {type(error).__name__}: {error}"
        ) from error
