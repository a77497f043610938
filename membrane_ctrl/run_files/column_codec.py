"""Codes columns of numbers so that zstd compresses them well, and decodes them bit by bit.

Each number becomes an integer: in a column of short decimals (a device counts in tenths of a micrometre, and 12.3 is
the double nearest to 123 / 10) that count, in any other column the bits of the float. The codec stores the difference
from the previous row or, in a column that nearly equals a sum of others, the exclusive or with the bits of that sum.
Bytes are sorted by position: the first byte of all rows, then the second. The field's metadata give kind and sum;
`codes`, stored with each batch, gives the code of each column.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

_CODES = {
    pa.float64(): "<f8", pa.float32(): "<f4", pa.int64(): "<i8", pa.uint32(): "<u4", pa.uint8(): "|u1",
}  # fmt: skip
_KIND = re.compile(rb"([1-9]\d{0,3})(<f8|<f4|<i8|<u4|\|u1)")
KIND, SUM = b"kind", b"sum"
AS_IT_IS, BITS, OF_SUM = b"-", b"b", b"s"  # codes; a digit: the number of decimals
_DIGITS_MAX = 6
_TERMS_MAX = 8
_WHOLE_MAX = 2.0**53


def stored_schema(schema: pa.Schema) -> pa.Schema:
    """A table's schema with numbers, and fixed-size lists of them, as bytes; other columns stay."""
    return pa.schema([_stored_field(field) for field in schema], metadata=schema.metadata)


def _stored_field(field: pa.Field) -> pa.Field:
    listed = pa.types.is_fixed_size_list(field.type)
    count, single = (field.type.list_size, field.type.value_type) if listed else (1, field.type)
    if single not in _CODES:
        return field
    about = {**(field.metadata or {}), KIND: f"{count}{_CODES[single]}"}
    return pa.field(field.name, pa.binary(count * np.dtype(_CODES[single]).itemsize), metadata=about)


def kind_of(field: pa.Field) -> tuple[int, np.dtype[Any]] | None:
    """Numbers per row of a stored column, and their kind; None if it is stored plainly. Raises pa.ArrowInvalid."""
    text = (field.metadata or {}).get(KIND)
    if text is None:
        return None
    found = _KIND.fullmatch(text)
    kind = np.dtype(found[2].decode()) if found else None
    if found is None or kind is None or field.type != pa.binary(int(found[1]) * kind.itemsize):
        raise pa.ArrowInvalid(f"column {field.name} does not have its stated kind")
    return int(found[1]), kind


def encode(batch: pa.RecordBatch, schema: pa.Schema) -> tuple[pa.RecordBatch, bytes]:
    """Encode a batch into its stored schema, with its codes."""
    arrays, codes = [], b""
    numbers = {field.name: _numbers(batch.column(field.name)) for field in schema if kind_of(field)}
    for field in schema:
        code, column, stored = AS_IT_IS, batch.column(field.name), kind_of(field)
        if stored is not None:
            values = numbers[field.name].reshape(batch.num_rows, -1)
            terms = (field.metadata or {}).get(SUM)
            code, words = _words(values, None if terms is None else _sum(terms, numbers, stored[1]))
            planes = words.view("u1").reshape(words.size, -1).T.tobytes()
            column = pa.Array.from_buffers(field.type, batch.num_rows, [None, pa.py_buffer(planes)])
        codes += code
        arrays.append(column)
    return pa.record_batch(arrays, schema=schema), codes


def _numbers(column: pa.Array) -> NDArray[Any]:
    flat = column.flatten() if pa.types.is_fixed_size_list(column.type) else column
    return np.ascontiguousarray(flat.to_numpy(zero_copy_only=False))


def _words(values: NDArray[Any], of_sum: NDArray[Any] | None) -> tuple[bytes, NDArray[Any]]:
    """Choose the code of (n, k) numbers, and compute the integers to store."""
    bits = values.view(f"<u{values.dtype.itemsize}")
    if of_sum is not None:
        return OF_SUM, bits ^ of_sum.view(bits.dtype).reshape(bits.shape)
    code, whole = BITS, bits
    if values.dtype == "<f8" and np.isfinite(values).all():
        largest = float(np.abs(values).max())
        for digits in range(_DIGITS_MAX + 1):
            if largest * 10.0**digits >= _WHOLE_MAX:
                break
            counted = np.rint(values * 10.0**digits).astype("<i8")
            if np.array_equal((counted / 10.0**digits).view("<u8"), bits):  # minus zero is not zero
                code, whole = b"%d" % digits, counted.view("<u8")
                break
    steps = np.diff(whole, axis=0, prepend=np.zeros_like(whole[:1]))
    signed = steps.view(f"<i{steps.dtype.itemsize}")
    # the sign comes last, so that a small negative step is a small number too
    return code, np.ascontiguousarray(((signed << 1) ^ (signed >> (8 * steps.dtype.itemsize - 1))).view(steps.dtype))


def _terms(text: bytes) -> list[str]:
    return text.decode(errors="replace").split()


def _sum(terms: bytes, numbers: Mapping[str, NDArray[Any]], kind: np.dtype[Any]) -> NDArray[Any]:
    """The sum of columns, subtracting those with a minus, in a column's kind."""
    with np.errstate(all="ignore"):
        total: NDArray[Any] = np.zeros(1)
        for term in _terms(terms):
            total = total - numbers[term[1:]] if term.startswith("-") else total + numbers[term]
        return total.astype(kind)


def needed(schema: pa.Schema, names: Sequence[str]) -> list[str]:
    """Columns and the summands of their sums, each after those it needs. Raises pa.ArrowInvalid."""
    found: dict[str, None] = {}

    def add(name: str, above: tuple[str, ...]) -> None:
        place = schema.get_field_index(name)  # -1 also where there are two
        stored = kind_of(schema.field(place)) if place >= 0 else None
        if name in above or place < 0 or (above and stored is None):
            raise pa.ArrowInvalid(f"column {above[0] if above else name} is a sum of missing columns")
        terms = _terms((schema.field(place).metadata or {}).get(SUM, b"")) if stored else []
        if len(above) + len(terms) > _TERMS_MAX:
            raise pa.ArrowInvalid(f"column {name} is a sum of too many columns")
        for term in terms if name not in found else ():
            add(term.removeprefix("-"), (*above, name))
        found[name] = None

    for name in names:
        add(name, ())
    return list(found)


def decode(batch: pa.RecordBatch, schema: pa.Schema, codes: bytes | None, names: Sequence[str]) -> pa.RecordBatch:
    """Decode columns of a batch to numbers; the batch has those `needed`, the schema is the whole file's.

    Without codes (in a journal or an earlier version) the columns are plain. Raises pa.ArrowInvalid if codes or
    columns do not come from `encode`.
    """
    if codes is None and not any(kind_of(schema.field(name)) for name in names):
        return batch.select(list(names))
    if codes is None or len(codes) != len(schema) or not batch.num_rows:
        raise pa.ArrowInvalid("a batch without rows, or without the codes of its columns")
    numbers: dict[str, NDArray[Any]] = {}
    arrays: dict[str, pa.Array] = {}
    for name in needed(schema, names):
        place = schema.get_field_index(name)
        stored, column = kind_of(schema.field(place)), batch.column(name)
        if stored is None:
            arrays[name] = column
            continue
        count, kind = stored
        terms = (schema.field(place).metadata or {}).get(SUM)
        of_sum = _sum(terms, numbers, kind) if terms is not None and codes[place : place + 1] == OF_SUM else None
        data = np.frombuffer(column.buffers()[1], "u1")[column.offset * column.type.byte_width :]
        words = data[: len(column) * column.type.byte_width].reshape(kind.itemsize, -1).T
        whole = np.ascontiguousarray(words).view(f"<u{kind.itemsize}").reshape(-1, count)
        numbers[name] = _decoded(codes[place : place + 1], whole, kind, of_sum).reshape(-1)
        flat = pa.array(numbers[name])
        arrays[name] = flat if count == 1 else pa.FixedSizeListArray.from_arrays(flat, count)
    return pa.record_batch({name: arrays[name] for name in names})


def _decoded(code: bytes, words: NDArray[Any], kind: np.dtype[Any], of_sum: NDArray[Any] | None) -> NDArray[Any]:
    if of_sum is not None:
        return np.asarray((words ^ of_sum.view(words.dtype).reshape(-1, 1)).view(kind))
    steps = (words >> 1) ^ (-(words & 1).astype(words.dtype)).astype(words.dtype)
    bits = np.cumsum(steps, axis=0, dtype=words.dtype)
    if code == BITS:
        return bits.view(kind)
    if kind != "<f8" or not code.isdigit() or int(code) > _DIGITS_MAX:
        raise pa.ArrowInvalid("a batch has an unknown code")
    return np.asarray(bits.view("<i8") / 10.0 ** int(code))
