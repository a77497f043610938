"""All that a controller remembers, as bytes: a replay can begin in the middle of a run, to the last bit.

A pickle, read back with nothing but our own plain classes allowed in it: a run folder may come from anywhere. Rules
of the safety table go by their code. The classes' attributes go along by name: memory of another layout, recorded by
another version of the control code, is refused and not half understood.
"""

from __future__ import annotations

import io
import json
import pickle
import zlib
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

from membrane_ctrl.controller import Controller
from membrane_ctrl.safety import TABLE, Rule

_OURS = ("membrane_ctrl.", "firmware_iface.")
_PURE = ("membrane_ctrl.control.", "membrane_ctrl.actuator_test")  # no I/O in them, whatever is made
_FOREIGN = {
    ("collections", "deque"),
    ("numpy", "dtype"),
    ("numpy", "ndarray"),
    ("numpy._core.numeric", "_frombuffer"),
}
_RULES = {rule.code: rule for rule in TABLE}


class UnknownMemoryError(ValueError):
    """Damaged, or of another layout; the message says what."""


def remember(controller: Controller) -> bytes:
    """The controller's memory; empty while something is under way that cannot be written down (an experiment)."""
    try:
        layout, data = _written(controller)
    except (pickle.PicklingError, TypeError, AttributeError):
        return b""
    return zlib.compress(json.dumps(layout).encode() + b"\n" + data, 1)


def recall(memory: bytes, fresh: Controller) -> Controller:
    """The controller as it was.

    Parameters
    ----------
    memory : bytes
        Of `remember`.
    fresh : Controller
        A new one of the same configuration: how today's code is laid out.

    Raises
    ------
    UnknownMemoryError
    """
    try:
        line, _, data = zlib.decompress(memory).partition(b"\n")
        today, _ = _written(fresh)
        reader = _Reader(data, today)
        _compare(json.loads(line), today, reader)
        controller = reader.load()
    except UnknownMemoryError:
        raise
    except Exception as error:  # a damaged pickle raises whatever it runs into
        raise UnknownMemoryError(f"the recorded memory cannot be read ({type(error).__name__}: {error})") from None
    if not isinstance(controller, Controller):
        raise UnknownMemoryError("what was recorded is no controller's memory")
    return controller


Layout = dict[str, list[str]]


def _written(controller: Controller) -> tuple[Layout, bytes]:
    file = io.BytesIO()
    writer = _Writer(file)
    writer.dump(controller)
    return writer.layout, file.getvalue()


class _Writer(pickle.Pickler):
    """Notes the attributes of each class it comes by."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, 5)
        self.layout: Layout = {}

    def persistent_id(self, thing: object) -> int | None:
        if isinstance(thing, Rule):
            return thing.code
        kind = type(thing)
        if kind.__module__.startswith(_OURS) and not isinstance(thing, Enum):
            name = f"{kind.__module__}:{kind.__qualname__}"
            if name not in self.layout:
                self.layout[name] = _attributes(thing)
        return None


class _Reader(pickle.Unpickler):
    """Makes nothing but plain data: what today's controller is made of, dataclasses, enums, and what is pure."""

    def __init__(self, data: bytes, today: Layout) -> None:
        super().__init__(io.BytesIO(data))
        self._today = today

    def persistent_load(self, code: object) -> Rule:
        return _RULES[code]  # type: ignore[index]  # a code that is none raises

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _FOREIGN:
            return super().find_class(module, name)
        if module.startswith(_OURS):
            found = super().find_class(module, name)
            # what a module has imported is not its own, however it is called there
            own = isinstance(found, type) and (found.__module__, found.__qualname__) == (module, name)
            if own and (
                f"{module}:{name}" in self._today
                or module.startswith(_PURE)
                or is_dataclass(found)
                or issubclass(found, Enum)
            ):
                return found
        raise UnknownMemoryError(f"the recorded memory asks for {module}.{name}, which is no part of a controller")


def _attributes(thing: object) -> list[str]:
    """Names of what an object (or a dataclass itself) holds."""
    if is_dataclass(thing):
        return [field.name for field in fields(thing)]
    return sorted(vars(thing))


def _compare(recorded: Layout, today: Layout, reader: _Reader) -> None:
    """Raise UnknownMemoryError at the first class that is laid out otherwise."""
    for name, attributes in recorded.items():
        kind = reader.find_class(*name.split(":", 1))
        known = today.get(name) or (_attributes(kind) if is_dataclass(kind) else attributes)
        if known != attributes:
            changed = ", ".join(sorted(set(known) ^ set(attributes))) or "another order"
            raise UnknownMemoryError(f"the recorded memory has another layout of {name.split(':')[1]} ({changed})")
