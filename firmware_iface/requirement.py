"""What the conformance tests of boards and drivers require, and raise."""

from collections.abc import Callable, Iterable

from firmware_iface.optical_roles import OpticalDevice
from firmware_iface.roles import LinkError


class ConformanceError(Exception):
    """A device or driver violated a requirement; the message states how."""


def require(right: bool, problem: str) -> None:
    """Raise ConformanceError unless the device or driver behaved correctly.

    Parameters
    ----------
    right : bool
        Whether it did.
    problem : str
        What is wrong otherwise, as a part of a sentence, with the measured value.
    """
    if not right:
        raise ConformanceError(problem)


def require_error(act: Callable[[], object], kind: type[LinkError]) -> str:
    """Require that a call fails with an error and a message of one line.

    Parameters
    ----------
    act : callable
        The call.
    kind : type
        The required error.

    Returns
    -------
    str
        The message.

    Raises
    ------
    ConformanceError
        It does not.
    """
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


def require_identity(device: OpticalDevice) -> None:
    """Require that opening gives an identity, and that the description has the port and is text."""
    identity = device.open()
    require(bool(identity.kind), "open returns an identity without a kind")
    described = device.describe()
    require("port" in described, "describe has no port")
    words = [word for pair in described.items() for word in pair]
    require(
        all(isinstance(word, str) for word in words), "describe returns something else than text"
    )


def overrides(bench: type, base: type, methods: Iterable[str]) -> bool:
    """Whether a bench can bring about certain faults, which its base leaves to it.

    Parameters
    ----------
    bench : type
        Class of a driver's author.
    base : type
        Class of this package from which it inherits; there the methods raise NotImplementedError.
    methods : iterable of str
        Names of the methods that the faults need, such as `unplug`; without any, True.
    """
    return all(getattr(bench, method) is not getattr(base, method) for method in methods)
