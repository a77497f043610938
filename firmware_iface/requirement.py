"""What the conformance tests of boards and drivers require, and raise."""

from collections.abc import Callable

from firmware_iface.roles import LinkError


class ConformanceError(Exception):
    """A device or driver violated a requirement; the message states how."""


def require(right: bool, problem: str) -> None:
    """Raise ConformanceError with the problem unless the device or driver behaved correctly."""
    if not right:
        raise ConformanceError(problem)


def require_error(act: Callable[[], object], kind: type[LinkError]) -> str:
    """Require that a call fails with this error and a message of one line; return the message."""
    try:
        act()
    except kind as error:
        message = str(error)
        require(bool(message) and "\n" not in message, f"{message!r} is not a message of one line")
        return message
    except LinkError as error:
        raise ConformanceError(
            f"raises {type(error).__name__} instead of {kind.__name__}: {error}"
        ) from error
    raise ConformanceError(f"raises no {kind.__name__}")
