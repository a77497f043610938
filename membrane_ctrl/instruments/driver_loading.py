"""Makes drivers and emulators of devices from their tables in the configuration; loads packages
that these name.

Only what opens or emulates devices imports this: reading a configuration loads no driver (decision
37).
"""

from typing import Any

from firmware_iface import driver_kind, drivers, settings
from membrane_ctrl.config import toml_file
from membrane_ctrl.model.errors import InputError


def name_of(section: Any) -> str:
    """Return the name of a table's driver."""
    return str(section.name if isinstance(section, settings.ExternalSection) else section.driver)


def check_settings(section: Any, where: str, kind: driver_kind.DriverKind) -> settings.Section:
    """Return the settings that a driver gets; a package's own class checks the table of its driver.

    Parameters
    ----------
    section : Section
        The table, as the configuration has it.
    where : str
        Its name, for the messages.
    kind : DriverKind
        Of the role: which entry points offer such drivers.

    Raises
    ------
    InputError
        No such driver, one without settings, or a key that its class refuses.
    """
    if not isinstance(section, settings.ExternalSection):
        checked: settings.Section = section  # when the configuration was read
        return checked
    expected = getattr(_load_driver(section, where, kind), "Settings", None)
    if not (isinstance(expected, type) and issubclass(expected, settings.Section)):
        raise InputError(
            f"{where}: the {kind.name} {section.name} has no class Settings "
            "(docs/how-to/new-device.md)"
        )
    return toml_file.parse_tables(section.keys, expected, where)


def make_driver(section: Any, where: str, kind: driver_kind.DriverKind, *more: Any) -> Any:
    """Make the driver of a table, not yet connected.

    Raises InputError for a driver that is not installed, does not load or cannot be made, and for a
    key that it refuses.

    Parameters
    ----------
    section : Section
        The table.
    where : str
        Its place in the configuration, for messages.
    kind : DriverKind
        Of the role: which entry points offer such drivers.
    *more : object
        What a driver of this kind gets after its settings.
    """
    make = _load_driver(section, where, kind)
    return _construct_driver(make, check_settings(section, where, kind), where, more)


def make_emulator(
    section: settings.ExternalSection, where: str, kind: driver_kind.DriverKind, *more: Any
) -> Any:
    """Make the emulator of a device of another vendor, not yet started.

    Parameters
    ----------
    section : ExternalSection
        The device's table; its `name` is the entry point's.
    where : str
        Place of the table in the configuration, for messages.
    kind : DriverKind
        The role's kind, for which the package offers the emulator.
    *more : object
        What an emulator of this kind gets after its settings.

    Raises
    ------
    InputError
        As for `make_driver`, and if the package has no emulator.
    """
    try:
        make = drivers.load_emulator(section.name, kind)
    except ValueError as error:
        raise InputError(f"{where}: {error}") from error
    return _construct_driver(make, check_settings(section, where, kind), where, more)


def _load_driver(section: Any, where: str, kind: driver_kind.DriverKind) -> Any:
    if not isinstance(section, settings.ExternalSection):
        return drivers.load_built_in(section.driver, kind)
    try:
        return drivers.load_driver(section.name, kind)
    except ValueError as error:
        raise InputError(f"{where}: {error}") from error


def _construct_driver(
    make: Any, checked: settings.Section, where: str, more: tuple[Any, ...]
) -> Any:
    try:
        return make(checked, *more)
    except ValueError as error:  # a setting that it refuses
        raise InputError(f"{where}: {error}") from error
    except (Exception, SystemExit) as error:  # whatever its code does
        raise InputError(
            f"{where}: {make.__name__} cannot be made: {type(error).__name__}: {error}"
        ) from error
