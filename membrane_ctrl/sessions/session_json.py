"""JSON files of a session: dataclasses of results, with arrays as lists of numbers.

pydantic reads the configuration and state trees, but not these: they are the plain dataclasses of
the numerics, whose arrays have no declared shape."""

import json
import math
import types
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import (
    Any,
    Literal,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from pydantic import BaseModel, ValidationError

from membrane_ctrl.model import errors, files, plain_json, program

T = TypeVar("T")
_LARGEST = 1e60  # no quantity is near it; its fourth power is still finite
_PLAIN_BYTES_MAX = 64_000_000  # candidates with their curves take a few megabytes
SCHEMA = "membrane-session/1"  # of all JSON files of a tuning session


def to_plain(value: Any) -> Any:
    """Plain JSON data; numbers that are not finite become words."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, np.ndarray):
        return to_plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [to_plain(item) for item in value]
    if isinstance(value, dict):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def build_value(kind: type[T], data: Any) -> T:
    """Build a value of a type from its plain form, as `to_plain` made it.

    Parameters
    ----------
    kind : type
        A dataclass or pydantic model, or a type of its fields: optional, literal, tuple, array,
        number, text.
    data : object
        Plain JSON of a file that may be damaged or edited. Keys that the type does not have are
        left out.

    Raises
    ------
    TypeError, ValueError, KeyError
        It does not fit, lacks a field, or has a number that no quantity of a bench has.
    """
    return cast(T, _build_plain(kind, data))


def _build_plain(kind: Any, data: Any) -> Any:
    """Build a value by the annotation of its field, from the outermost type inwards."""
    # Generic types: optional, one of several words, tuples, arrays.
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        if data is None:
            return None
        return _build_plain(next(a for a in arguments if a is not type(None)), data)
    if origin is Literal:
        if data not in arguments:
            raise ValueError(f"{data!r} is not one of {arguments}")
        return data
    if origin is tuple:
        inner = arguments
        if arguments[-1] is Ellipsis:
            inner = (arguments[0],) * len(data)
        return tuple(_build_plain(a, item) for a, item in zip(inner, data, strict=True))
    if origin is np.ndarray:
        return np.array(data, dtype=float)
    # Objects, field by field.
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return kind.model_validate(data)
    if is_dataclass(kind):
        hints = get_type_hints(kind)
        return cast(Any, kind)(
            **{f.name: _build_plain(hints[f.name], data[f.name]) for f in fields(kind)}
        )
    # Plain values.
    value = kind(data)
    if isinstance(value, float) and _LARGEST < abs(value) < math.inf:
        raise ValueError(f"{value:g} is not a plausible quantity")
    return value


def write_session_file(path: Path, value: Any, schema: str = SCHEMA) -> None:
    """Write a JSON file of a session atomically.

    Parameters
    ----------
    path : Path
        In the folder of the session.
    value : dataclass or dict
        Becomes plain JSON (`to_plain`): a dataclass of numbers, texts, arrays and other
        dataclasses.
    schema : str
        Format with version, which the file states beside the program that writes it.
    """
    table = {**program.file_origin(schema), **to_plain(value)}
    files.write_text_atomic(
        files.resolve_user_path(path), json.dumps(table, indent=1, allow_nan=False) + "\n"
    )


def read_session_file(path: Path, kind: type[T], schema: str = SCHEMA) -> T:
    """Read a JSON file of a session.

    Parameters
    ----------
    path : Path
        In the folder of the session, which may come from elsewhere.
    kind : type
        Of the dataclass that was written.
    schema : str
        Format with version that the file must have.

    Raises
    ------
    InputError
        One line: the file is missing, of another format, or invalid.
    """
    try:
        table = plain_json.loads(files.read_text(files.resolve_user_path(path), _PLAIN_BYTES_MAX))
        if not isinstance(table, dict):
            raise ValueError("no JSON object")
        program.remove_origin(table, schema)
        return build_value(kind, table)
    except FileNotFoundError:
        raise errors.InputError(f"{path}: no such file") from None
    except (OSError, ValueError, TypeError, KeyError, ValidationError) as error:
        raise errors.InputError(
            f"{path}: damaged ({str(error).splitlines()[0]}); repeat the step that wrote it"
        ) from None
