"""Libraries that only an extra of the package installs."""

import importlib
import importlib.util
from types import ModuleType

from membrane_ctrl.model import errors

# What the page's service imports from the extra `web`
PAGE_LIBRARIES = ("nicegui", "fastapi_offline", "argon2", "prometheus_client")


def is_installed(name: str) -> bool:
    """Whether a library can be imported; does not import it."""
    return importlib.util.find_spec(name) is not None


def find_missing_page_library() -> str | None:
    """The first library of the page that is not installed; None if all are."""
    return next((name for name in PAGE_LIBRARIES if not is_installed(name)), None)


def describe_missing(user: str, name: str, extra: str) -> str:
    """Describe in one line what needs a library that is missing, and how to install it.

    Parameters
    ----------
    user : str
        What needs it, such as `--format h5`.
    name : str
        The library, such as `h5py`.
    extra : str
        The extra of this package that requires it.
    """
    return f"{user} needs {name}: pip install 'membrane-ctrl[{extra}]'"


def require_installed(name: str, extra: str, user: str) -> None:
    """Refuse to begin without a library, which is not imported yet.

    Parameters
    ----------
    name : str
        The library, such as `h5py`.
    extra : str
        The extra of this package that requires it.
    user : str
        What needs it, such as `--format h5`.

    Raises
    ------
    InputError
        It is not installed; the message states how to install it.
    """
    if not is_installed(name):
        raise errors.InputError(describe_missing(user, name, extra))


def import_optional(name: str, extra: str, user: str) -> ModuleType:
    """Import a library. Raises InputError with how to install it.

    Parameters
    ----------
    name : str
        Such as `pandas`.
    extra : str
        The extra of this package that requires it, such as `data`.
    user : str
        What needs it, such as `--format h5`.
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        raise errors.InputError(describe_missing(user, name, extra)) from None
