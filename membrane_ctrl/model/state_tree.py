"""What a program remembers, as a tree of dataclasses: encoded to JSON, decoded with every value
checked, compared.

A node is a dataclass that derives from `StateNode` and declares its fields with exact types:
numbers, bools, texts, enums, arrays of a shape (`ArrayShape`), sections of the configuration, other
nodes, and lists, tuples and dicts of these. Sets are no fields: their order differs from process to
process.

Numbers survive to the last bit; of a NaN only that it is one. Arrays are base64 of their bytes,
which is cheap to write and exact.
"""

import base64
import binascii
import dataclasses
import json
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, GetCoreSchemaHandler, TypeAdapter, ValidationError
from pydantic_core import CoreSchema, core_schema

T = TypeVar("T", bound="StateNode")

Count = Annotated[int, Field(ge=0, lt=2**53)]  # a number of events, a mask of bits
_SHOWN_NUMBERS = 8  # of an array
_ADAPTERS: "dict[type[StateNode], TypeAdapter[Any]]" = {}


class StateError(ValueError):
    """The data are damaged, or of another layout; the message names the first wrong value."""


class StateNode:
    """Base of the dataclasses of a state tree."""

    __slots__ = ()
    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]
    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(
        strict=True, extra="forbid", ser_json_inf_nan="constants", revalidate_instances="never"
    )

    def start_afresh(self) -> None:
        """Set all fields to their defaults; every field must have one."""
        fresh = type(self)()
        for name in self.__dataclass_fields__:
            setattr(self, name, getattr(fresh, name))


@dataclass(frozen=True)
class ArrayShape:
    """Annotates an array field of a node with its shape and element type.

    Parameters
    ----------
    shape : tuple of int
        -1 for one axis of any length.
    dtype : str
        As NumPy spells it, little-endian.
    """

    shape: tuple[int, ...]
    dtype: str = "<f8"

    def __get_pydantic_core_schema__(
        self, source: object, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Schema of the array as base64 text."""
        encoder = core_schema.plain_serializer_function_ser_schema(
            self._encode_array, return_schema=core_schema.str_schema(), when_used="json"
        )
        return core_schema.no_info_plain_validator_function(
            self._decode_array, serialization=encoder
        )

    def _encode_array(self, array: NDArray[Any]) -> str:
        if not self._has_shape(array.shape) or array.dtype != self.dtype:
            raise ValueError(
                f"an array {array.dtype.str}{array.shape} where {self.dtype}{self.shape} is "
                "declared"
            )
        return base64.b64encode(np.ascontiguousarray(array).data).decode()

    def _decode_array(self, data: object) -> NDArray[Any]:
        if not isinstance(data, str):
            raise ValueError("an array is a text in base64")
        try:
            values = np.frombuffer(base64.b64decode(data, validate=True), dtype=self.dtype)
        except (binascii.Error, ValueError) as error:
            raise ValueError(f"no array: {error}") from None
        try:
            return values.reshape(self.shape).copy()
        except ValueError:
            raise ValueError(f"{values.size} numbers where {self.shape} are declared") from None

    def _has_shape(self, shape: tuple[int, ...]) -> bool:
        if len(shape) != len(self.shape):
            return False
        return all(length in (given, -1) for given, length in zip(shape, self.shape, strict=True))


def _make_adapter(kind: type[StateNode]) -> TypeAdapter[Any]:
    """Return the encoder and decoder of a tree, made once: that takes as long as many ticks."""
    if kind not in _ADAPTERS:
        _ADAPTERS[kind] = TypeAdapter(kind)
    return _ADAPTERS[kind]


def encode_state(node: StateNode) -> bytes:
    """Encode a tree as JSON.

    Raises
    ------
    ValueError
        A value is not of its declared type.
    """
    encoded: bytes = _make_adapter(type(node)).dump_json(node, warnings="error")
    return encoded


def decode_state(data: bytes, kind: type[T], most_bytes: int) -> T:
    """Decode a tree, which may come from anywhere.

    Parameters
    ----------
    data : bytes
        What `encode_state` wrote, however spelled.
    kind : type
        Of the tree's root.
    most_bytes : int
        Longer data are refused before they are read.

    Returns
    -------
    kind

    Raises
    ------
    StateError
        A value is missing, unknown, of another type or outside its bounds.
    """
    # 1. The size, before anything is parsed
    if len(data) > most_bytes:
        raise StateError(f"{len(data)} bytes where at most {most_bytes} are expected")
    # 2. Every value against its declared type and bounds; unknown fields are refused
    try:
        node: T = _make_adapter(kind).validate_json(data)
    except ValidationError as error:
        raise StateError(_describe_first_error(error)) from None
    # 3. No field is missing: it would have got its default. What this program writes for the tree
    # must be what was read
    found = _parse_json(data)
    expected = _parse_json(encode_state(node))
    if found != expected:
        where = next(_find_missing(found, expected, ""), "not the values that this program writes")
        raise StateError(f"another layout: {where}")
    return node


def _parse_json(data: bytes) -> Any:
    """Return the values of JSON; NaN as a text, which equals itself."""
    return json.loads(data, parse_constant=str)


def _describe_first_error(error: ValidationError) -> str:
    """Return the first wrong value of many: its place, what is wrong, and the value."""
    first = error.errors(include_url=False)[0]
    place = ".".join(str(part) for part in first["loc"])
    return f"{place or 'the whole'}: {first['msg']} ({str(first['input'])[:40]})"


def _find_missing(found: Any, expected: Any, place: str) -> Iterator[str]:
    """Yield the places of the expected tree that the other one lacks."""
    if isinstance(expected, dict) and isinstance(found, dict):
        for name in expected:
            if name in found:
                yield from _find_missing(found[name], expected[name], f"{place}.{name}")
            else:
                yield f"{place}.{name}".lstrip(".") + " is missing"
    if isinstance(expected, list) and isinstance(found, list):
        for index, (one, other) in enumerate(zip(found, expected, strict=False)):
            yield from _find_missing(one, other, f"{place}.{index}")


def to_plain(node: StateNode) -> dict[str, Any]:
    """Return the tree as dicts, lists and numbers, for people and for tests.

    Arrays are lists of numbers, enums their names.
    """
    plain: dict[str, Any] = _make_adapter(type(node)).dump_python(node)
    return {name: _with_lists(value) for name, value in plain.items()}


def _with_lists(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, dict):
        return {str(getattr(key, "name", key)): _with_lists(part) for key, part in value.items()}
    if isinstance(value, list | tuple | deque):
        return [_with_lists(part) for part in value]
    return getattr(value, "name", value)


def describe_tree(node: StateNode) -> list[str]:
    """Return the tree for people: a line `place  value` for each value.

    An array of more than eight numbers is one line with its shape and range.
    """
    return [
        f"{place:<48} {text}"
        for place, text in _list_leaves(_make_adapter(type(node)).dump_python(node), "")
    ]


def _list_leaves(value: Any, place: str) -> Iterator[tuple[str, str]]:
    """Yield place and text of each value; lists of values are one text, lists of nodes are not."""
    if isinstance(value, np.ndarray) and value.size > _SHOWN_NUMBERS:
        shape = " x ".join(str(length) for length in value.shape)
        finite = value[np.isfinite(value)]
        span = "none finite"
        if finite.size:
            span = f"{finite.min():g} to {finite.max():g}"
        yield place, f"{shape} numbers, {span}"
    elif isinstance(value, Mapping) and value:
        for name, part in value.items():
            yield from _list_leaves(part, _join_place(place, name))
    elif isinstance(value, list | tuple | deque) and value and isinstance(value[0], Mapping):
        for index, part in enumerate(value):
            yield from _list_leaves(part, _join_place(place, index))
    else:
        yield place, str(_with_lists(value))


def find_differences(one: StateNode, other: StateNode, within: float = 0.0) -> list[str]:
    """Return where two trees of the same kind differ; NaN equals NaN.

    Parameters
    ----------
    one, other : StateNode
    within : float
        Numbers are the same that differ by no more than this share of their size, at least of 1.
        Texts, which may contain such numbers, are then not compared.

    Returns
    -------
    list of str
        `place: one value, other value`.
    """
    adapter = _make_adapter(type(one))
    return list(_find_differences(adapter.dump_python(one), adapter.dump_python(other), "", within))


def _join_place(place: str, key: Any) -> str:
    """Return the place of a member: that of the whole, then its key or the name of an enum."""
    name = getattr(key, "name", key)
    return f"{place}.{name}".lstrip(".")


def _find_differences(one: Any, other: Any, place: str, within: float) -> Iterator[str]:
    """Yield the places that differ: go down into dicts and lists of the same length in step."""
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        one = one.tolist()
        other = other.tolist()
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        for key in dict.fromkeys([*one, *other]):
            part = one.get(key, "absent")
            part_of_other = other.get(key, "absent")
            inner = _join_place(place, key)
            yield from _find_differences(part, part_of_other, inner, within)
    elif _is_list(one) and _is_list(other) and len(one) == len(other):
        for index, (part, part_of_other) in enumerate(zip(one, other, strict=True)):
            yield from _find_differences(part, part_of_other, _join_place(place, index), within)
    elif not _is_same(one, other, within):
        yield f"{place}: {_with_lists(one)!r}, {_with_lists(other)!r}"


def _is_same(one: Any, other: Any, within: float) -> bool:
    if within and isinstance(one, str) and isinstance(other, str) and not isinstance(one, Enum):
        return True
    if within and isinstance(one, complex | float) and isinstance(other, complex | float):
        return abs(one - other) <= within * max(1.0, abs(one)) or repr(one) == repr(other)
    return repr(one) == repr(other)  # distinguishes 0.0 from -0.0, and 1 from 1.0


def _is_list(value: Any) -> bool:
    return isinstance(value, list | tuple | deque)
