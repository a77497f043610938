"""Libraries that only an extra of the package installs."""

import importlib
from types import ModuleType

from membrane_ctrl.model import errors


def import_optional(name: str, extra: str) -> ModuleType:
    """Import a library. Raises InputError with how to install it.

    Parameters
    ----------
    name : str
        Such as `pandas`.
    extra : str
        The extra of this package that requires it, such as `data`.
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        raise errors.InputError(f"needs {name}: pip install 'membrane-ctrl[{extra}]'") from None
