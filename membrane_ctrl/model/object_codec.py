"""Converts objects of our classes to plain data for JSON and back, bit by bit.

The reader makes only what the classes declare: the fields of a dataclass; of another class the
attributes of an example, by the types that its methods annotate (`self.x: T = ...`) or else by
those of the example's values. It calls no constructor, and refuses an attribute that is missing,
unknown or of another type.
"""

import ast
import base64
import inspect
import sys
import textwrap
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from types import NoneType, SimpleNamespace, UnionType
from typing import Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.model.shape_estimate import ShapeEstimate, pack_estimate, unpack_estimate

_SCALARS = frozenset({NoneType, bool, int, float, str})
_SEQUENCES: tuple[type, ...] = (tuple, list, set, frozenset)
_DTYPES = frozenset({"<f8", "<f4", "<c16", "<i8", "|b1"})
_OURS = ("membrane_ctrl.", "firmware_iface.")
_CLASS = ""  # the key of an object's class; no attribute has this name
_INT_MAX = 2**63
_MAXLEN_MAX = 1 << 20


class CodecError(ValueError):
    """The data are damaged or of another layout; the message says where."""


class Special(NamedTuple):
    """A custom encoding for a class and its subclasses; raises TypeError for objects that cannot be
    encoded.
    """

    encode: Callable[[Any], Any]
    decode: Callable[[Any, type], Any]


Specials = Mapping[type, Special]


def _estimate(data: Any, _: type) -> ShapeEstimate:
    if type(data) is not str:
        raise CodecError("the shape estimate is damaged")
    return unpack_estimate(base64.b64decode(data, validate=True))


ESTIMATE = Special(lambda estimate: base64.b64encode(pack_estimate(estimate)).decode(), _estimate)


def encode(value: object, specials: Specials) -> Any:
    """Encode an object. Raises TypeError for unsupported types, and for objects reachable by two
    ways.
    """
    return _encoded(value, specials, set())


def _encoded(value: Any, specials: Specials, seen: set[int]) -> Any:
    kind = type(value)
    if kind in _SCALARS:
        return value
    if isinstance(value, Enum):
        return value.value if isinstance(value, int) else value.name
    if kind in _SEQUENCES:
        return [_encoded(item, specials, seen) for item in value]
    if kind is deque:
        return {"maxlen": value.maxlen, "items": [_encoded(item, specials, seen) for item in value]}
    if kind is dict:
        if all(type(key) is str for key in value):
            return {key: _encoded(item, specials, seen) for key, item in value.items()}
        return [
            [_encoded(key, specials, seen), _encoded(item, specials, seen)]
            for key, item in value.items()
        ]
    if isinstance(value, (np.ndarray, np.generic)):
        data = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode()
        return {"dtype": value.dtype.str, "shape": value.shape, "data": data}
    if (special := _special(kind, specials)) is not None:
        return special.encode(value)
    if not kind.__module__.startswith(_OURS):
        raise TypeError(f"{kind.__qualname__} cannot be written down")
    if id(value) in seen and not (is_dataclass(kind) and kind.__dataclass_params__.frozen):  # type: ignore[attr-defined]
        raise TypeError(f"{kind.__qualname__} is reached by two ways")
    seen.add(id(value))
    found: dict[str, Any] = {_CLASS: kind.__qualname__}
    for name in _attributes(value):
        item = getattr(value, name)
        found[name] = item if type(item) in _SCALARS else _encoded(item, specials, seen)
    return found


def _attributes(value: object) -> list[str]:
    return list(getattr(value, "__dataclass_fields__", None) or vars(value))


def _special(kind: type, specials: Specials) -> Special | None:
    return next((specials[base] for base in kind.__mro__ if base in specials), None)


class Decoder:
    """Makes objects from `encode`'s data; `examples` has an object of every class that is not a
    dataclass.

    Raises TypeError for an attribute whose type the examples do not reveal.
    """

    def __init__(self, examples: tuple[object, ...], specials: Specials) -> None:
        self._specials = specials
        self._classes: dict[type, dict[str, Any]] = {}
        for example in examples:
            self._learn(example)
        for types in list(self._classes.values()):
            for hint in types.values():
                self._learn_hint(hint)

    def _learn(self, example: Any) -> None:
        kind: type = type(example)
        if kind in (*_SEQUENCES, deque, dict):
            for item in example.values() if kind is dict else example:
                self._learn(item)
        elif (
            kind not in self._classes
            and kind.__module__.startswith(_OURS)
            and not self._is_leaf(kind)
        ):
            declared = _declared(kind)
            values = {name: getattr(example, name) for name in _attributes(example)}
            self._classes[kind] = {
                name: declared[name]
                if name in declared
                else _type_of(value, f"{kind.__name__}.{name}")
                for name, value in values.items()
            }
            for value in values.values():
                self._learn(value)

    def _learn_hint(self, hint: Any) -> None:
        """Learn dataclasses absent from the examples, such as the result of a test that has not
        run.
        """
        for part in get_args(hint):
            self._learn_hint(part)
        if (
            not isinstance(hint, type)
            or hint in self._classes
            or self._is_leaf(hint)
            or not is_dataclass(hint)
        ):
            return
        self._classes[hint] = _declared(hint)
        for part in self._classes[hint].values():
            self._learn_hint(part)

    def _is_leaf(self, kind: type) -> bool:
        return issubclass(kind, Enum) or _special(kind, self._specials) is not None

    def decode(self, data: Any, hint: Any, where: str = "") -> Any:
        """Decode an object of type `hint`. Raises CodecError."""
        where = where or getattr(hint, "__name__", str(hint))
        origin, parts = get_origin(hint), get_args(hint)
        if hint is Any:
            return data
        if origin in (Union, UnionType):
            return self._either(data, parts, where)
        if origin is Literal:
            _must(type(data) in (str, int) and data in parts, where, data)
            return data
        if hint in _SCALARS:
            return _scalar(data, hint, where)
        if (origin or hint) is np.ndarray:
            return _array(data, where)
        if origin is dict:
            return self._dict(data, parts[0], parts[1], where)
        if origin is deque:
            return self._deque(data, parts[0], where)
        if origin in _SEQUENCES:
            return self._sequence(data, origin, parts, where)
        if isinstance(hint, type) and issubclass(hint, Enum):
            return _enum(data, hint, where)
        if (
            special := _special(hint, self._specials) if isinstance(hint, type) else None
        ) is not None:
            return special.decode(data, hint)
        return self._object(data, hint, where)

    def _either(self, data: Any, alternatives: tuple[Any, ...], where: str) -> Any:
        if data is None and NoneType in alternatives:
            return None
        error = CodecError(where)
        for hint in alternatives:
            if hint is not NoneType:
                try:
                    return self.decode(data, hint, where)
                except CodecError as refused:
                    error = refused
        raise error

    def _dict(self, data: Any, key: Any, item: Any, where: str) -> dict[Any, Any]:
        pairs = list(data.items()) if isinstance(data, dict) else data
        _must(isinstance(pairs, list), where, data)
        _must(
            all(isinstance(pair, (list, tuple)) and len(pair) == 2 for pair in pairs), where, data
        )
        return {
            self.decode(name, key, where): self.decode(value, item, where) for name, value in pairs
        }

    def _deque(self, data: Any, hint: Any, where: str) -> deque[Any]:
        _must(isinstance(data, dict) and set(data) == {"maxlen", "items"}, where, data)
        maxlen, items = data["maxlen"], data["items"]
        _must(maxlen is None or (type(maxlen) is int and 0 <= maxlen < _MAXLEN_MAX), where, maxlen)
        _must(isinstance(items, list), where, items)
        return deque((self.decode(item, hint, where) for item in items), maxlen)

    def _sequence(self, data: Any, origin: type, parts: tuple[Any, ...], where: str) -> Any:
        _must(isinstance(data, list), where, data)
        if origin is not tuple or parts[-1] is Ellipsis:
            return origin(self.decode(item, parts[0], where) for item in data)
        _must(len(data) == len(parts), where, data)
        return tuple(self.decode(item, part, where) for item, part in zip(data, parts, strict=True))

    def _object(self, data: Any, kind: Any, where: str) -> Any:
        if kind not in self._classes:
            raise CodecError(f"{where}: objects of this kind are not accepted")
        _must(isinstance(data, dict) and data.get(_CLASS) == kind.__qualname__, where, data)
        types = self._classes[kind]
        if changed := (data.keys() - {_CLASS}) ^ types.keys():
            raise CodecError(
                f"another layout of {kind.__qualname__} ({', '.join(sorted(changed))})"
            )
        made = object.__new__(kind)
        for name, hint in types.items():
            object.__setattr__(
                made, name, self.decode(data[name], hint, f"{kind.__qualname__}.{name}")
            )
        return made


@cache
def _declared(kind: type) -> dict[str, Any]:
    """Types that a class declares for its objects' attributes."""
    if is_dataclass(kind):
        hints = get_type_hints(kind)
        return {field.name: hints[field.name] for field in fields(kind)}
    found: dict[str, str] = {}
    for node in ast.walk(ast.parse(textwrap.dedent(inspect.getsource(kind)))):
        match node:
            case ast.AnnAssign(
                target=ast.Attribute(value=ast.Name(id="self"), attr=name), annotation=annotation
            ):
                found[name] = ast.unparse(annotation)
    return get_type_hints(
        SimpleNamespace(__annotations__=found), vars(sys.modules[kind.__module__])
    )


def _type_of(value: Any, where: str) -> Any:
    """The type of an undeclared attribute, from a value that is neither None nor empty."""
    kind = type(value)
    if kind is tuple and value:
        return tuple[tuple(_type_of(item, where) for item in value)]  # type: ignore[misc]
    if kind is list and value:
        return list[_type_of(value[0], where)]  # type: ignore[misc]
    if kind is dict and value:
        key, item = next(iter(value.items()))
        return dict[_type_of(key, where), _type_of(item, where)]  # type: ignore[misc]
    if value is None or isinstance(value, (*_SEQUENCES, deque, dict)):
        raise TypeError(f"{where}: annotate it where it is first assigned; its type cannot be seen")
    return kind


def _must(holds: bool, where: str, data: Any) -> None:
    if not holds:
        raise CodecError(f"{where} cannot be {str(data)[:40]!r}")


def _scalar(data: Any, hint: type, where: str) -> Any:
    """A number, word, bool or None; a NumPy scalar stays one."""
    if isinstance(data, dict):
        value = _array(data, where)
        _must(
            value.shape == () and value.dtype.kind == {float: "f", int: "i", bool: "b"}.get(hint),
            where,
            data,
        )
        return value[()]
    if hint is float and type(data) is int:  # an attribute of type float may hold a whole number
        _must(abs(data) < _INT_MAX, where, "a number this large")
        return data
    _must(type(data) is hint and (type(data) is not int or abs(data) < _INT_MAX), where, data)
    return data


def _enum(data: Any, hint: type[Enum], where: str) -> Enum:
    whole = issubclass(hint, int)
    _must(type(data) is (int if whole else str), where, data)
    try:
        return hint(data) if whole else hint[data]
    except (ValueError, KeyError):
        raise CodecError(f"{where} cannot be {str(data)[:40]!r}") from None


def _array(data: Any, where: str) -> NDArray[Any]:
    _must(isinstance(data, dict) and set(data) == {"dtype", "shape", "data"}, where, data)
    dtype, shape, text = data["dtype"], data["shape"], data["data"]
    _must(type(dtype) is str and dtype in _DTYPES and type(text) is str, where, dtype)
    _must(
        type(shape) is list and len(shape) <= 2 and all(type(n) is int and n >= 0 for n in shape),
        where,
        shape,
    )
    try:
        return np.frombuffer(base64.b64decode(text, validate=True), dtype).reshape(shape).copy()
    except ValueError:
        raise CodecError(f"{where} is damaged") from None
