"""Calls of drivers of cameras and displays, whose code may be another package's: any failure
becomes a LinkError.
"""

import contextlib
from typing import Any

from firmware_iface.roles import LinkError

_SHOWN = 300  # characters of a driver's message


def call_driver(
    name: str, driver: Any, method: str, *arguments: Any, returns: type[Any] = object
) -> Any:
    """Call a method of a driver and check the type of its result.

    Raises LinkError (a subclass of it if the driver does) with one line that names the device.

    Parameters
    ----------
    name : str
        Kind and name of the device, such as "camera acme".
    driver : object
        Perhaps of another package: anything may be raised.
    method : str
        Name of the method.
    *arguments : object
        For the method, in their order.
    returns : type
        What the result must be an instance of.
    """
    try:
        found = getattr(driver, method)(*arguments)
    except LinkError as error:
        error.args = (_name_device(name, _one_line(error)),)
        raise
    except (Exception, SystemExit) as error:  # whatever its code does
        raise LinkError(f"{name}: {method}: {type(error).__name__}: {_one_line(error)}") from error
    if not isinstance(found, returns):
        raise LinkError(
            f"{name}: {method} returned {type(found).__name__} instead of {returns.__name__}"
        )
    return found


def close_driver(driver: Any) -> None:
    """Close a driver, whatever its code does."""
    with contextlib.suppress(Exception, SystemExit):
        driver.close()


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:_SHOWN] or "no message"


def _name_device(name: str, message: str) -> str:
    """Prefix a message with the device's name, unless it begins with the kind of device."""
    kind = name.partition(" ")[0]
    if message.startswith(kind):
        return message
    return f"{name}: {message}"
