"""Results of steps as plain JSON and back: dataclasses, configuration sections, arrays, tuples and numbers."""

from __future__ import annotations

import json
import math
import types
import typing
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from pydantic import BaseModel, ValidationError

from membrane_ctrl.errors import InputError
from membrane_ctrl.recording import plain_json
from membrane_ctrl.recording.atomic import read_text, users, write_text_atomic

T = TypeVar("T")
_BYTES_MAX = 64_000_000  # candidates with their curves are some megabytes


def plain(value: Any) -> Any:
    """What JSON can hold; numbers that are not finite become words."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def built(kind: type[T], data: Any) -> T:
    """The value of a type from its plain form. Raises TypeError, ValueError or KeyError if it is none."""
    return cast(T, _built(kind, data))


def _built(kind: Any, data: Any) -> Any:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return None if data is None else _built(next(a for a in arguments if a is not type(None)), data)
    if origin is typing.Literal:
        if data not in arguments:
            raise ValueError(f"{data!r} is none of {arguments}")
        return data
    if origin is tuple:
        inner = [arguments[0]] * len(data) if arguments[-1] is Ellipsis else arguments
        return tuple(_built(a, item) for a, item in zip(inner, data, strict=True))
    if origin is np.ndarray:
        return np.array(data, dtype=float)
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return kind.model_validate(data)
    if is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        return cast(Any, kind)(**{f.name: _built(hints[f.name], data[f.name]) for f in fields(kind)})
    return kind(data)


def write(path: Path, value: Any) -> None:
    """Write a result in one step."""
    write_text_atomic(users(path), json.dumps(plain(value), indent=1, allow_nan=False) + "\n")


def read(path: Path, kind: type[T]) -> T:
    """Read a result back. Raises InputError (one line) if it is not there or is no such result."""
    try:
        return built(kind, plain_json.loads(read_text(users(path), _BYTES_MAX)))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, ValueError, TypeError, KeyError, ValidationError) as error:
        raise InputError(f"{path}: damaged ({str(error).splitlines()[0]}); repeat the step that wrote it") from None
