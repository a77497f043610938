"""Walks the page headers of a Parquet column chunk, to find its memory before Arrow allocates it.

A page header states the size to which its page unpacks and the number of its values, and Arrow
trusts both. It is a structure in Thrift's compact protocol (`parquet.thrift`: `PageHeader`,
`DataPageHeader`, `DictionaryPageHeader`): a field is a byte with its type and the step of its
number, then its value; numbers are varints, zigzag coded.
"""

from dataclasses import dataclass

_TRUE, _FALSE, _BYTE, _I16, _I32, _I64, _DOUBLE, _BINARY, _LIST, _SET, _MAP, _STRUCT = range(1, 13)
_DEPTH_MAX = 8
_LIST_MAX = 1000  # a page header has no lists today
_VARINT_BYTES_MAX = 10
# Fields of `PageHeader`, and `num_values` of the headers within it.
_TYPE = 1
_UNPACKED = 2
_PACKED = 3
_DATA_PAGE = 5
_DICTIONARY_PAGE = 7
_DATA_PAGE_2 = 8
_NUM_VALUES = 1
_DICTIONARY_TYPE = 2

Fields = dict[int, "int | Fields"]


@dataclass(frozen=True, slots=True)
class ChunkSize:
    """What a column chunk unpacks to."""

    unpacked_bytes: int
    values: int  # of its data pages


def measure_chunk(data: bytes) -> ChunkSize:
    """Add up the pages of a column chunk. Raises ValueError if they do not fill it exactly."""
    place = unpacked_bytes = values = 0
    while place < len(data):
        header, place = _read_struct(data, place, 0)
        kind, unpacked, packed = (
            _read_number(header, field) for field in (_TYPE, _UNPACKED, _PACKED)
        )
        count = _values_of(header)
        if packed < 0 or unpacked < 0 or count < 0 or place + packed > len(data):
            raise ValueError("a page that does not lie within its column")
        place += packed
        unpacked_bytes += unpacked
        values += count if kind != _DICTIONARY_TYPE else 0
    return ChunkSize(unpacked_bytes, values)


def _read_number(fields: Fields, field: int) -> int:
    value = fields.get(field)
    if not isinstance(value, int):
        raise ValueError("a page header without its sizes")
    return value


def _values_of(header: Fields) -> int:
    for field in (_DATA_PAGE, _DICTIONARY_PAGE, _DATA_PAGE_2):
        inner = header.get(field)
        if isinstance(inner, dict):
            return _read_number(inner, _NUM_VALUES)
    return 0


def _read_struct(data: bytes, place: int, depth: int) -> tuple[Fields, int]:
    """The numbers and structures of a structure, by field number, and the place after it."""
    if depth > _DEPTH_MAX:
        raise ValueError("a page header that is nested too deep")
    fields: Fields = {}
    number = 0
    while True:
        # A field begins with a byte: its type, and by how much its number is larger than the last
        # one; a difference of 0 means that the number follows. The byte 0 ends the structure
        head = _read_byte(data, place)
        place += 1
        if head == 0:
            return fields, place
        kind = head & 0x0F
        step = head >> 4
        if step:
            number += step
        else:
            zigzag, place = _read_varint(data, place)
            number = _decode_zigzag(zigzag)
        if kind in (_TRUE, _FALSE):
            continue
        value, place = _read_value(data, place, kind, depth)
        if value is not None:
            fields[number] = value


def _read_value(
    data: bytes, place: int, kind: int, depth: int
) -> tuple["int | Fields | None", int]:
    """A value, None if it is neither a number nor a structure, and the place after it."""
    if kind in (_I16, _I32, _I64):
        zigzag, place = _read_varint(data, place)
        return _decode_zigzag(zigzag), place
    if kind == _STRUCT:
        return _read_struct(data, place, depth + 1)
    if kind == _BYTE:
        return None, place + 1
    if kind == _DOUBLE:
        return None, place + 8
    if kind == _BINARY:
        size, place = _read_varint(data, place)
        return None, place + size
    if kind in (_LIST, _SET):
        return None, _skip_list(data, place, depth)
    raise ValueError("a page header with an unknown kind of field")


def _skip_list(data: bytes, place: int, depth: int) -> int:
    head = _read_byte(data, place)
    place += 1
    count, kind = head >> 4, head & 0x0F
    if count == 15:
        count, place = _read_varint(data, place)
    if count > _LIST_MAX:
        raise ValueError("a page header with a long list")
    for _ in range(count):
        if kind in (_TRUE, _FALSE):
            place += 1
        else:
            _, place = _read_value(data, place, kind, depth + 1)
    return place


def _read_byte(data: bytes, place: int) -> int:
    if place >= len(data):
        raise ValueError("a page header that is cut off")
    return data[place]


def _read_varint(data: bytes, place: int) -> tuple[int, int]:
    value = 0
    for shift in range(_VARINT_BYTES_MAX):
        byte = _read_byte(data, place + shift)
        value |= (byte & 0x7F) << (7 * shift)
        if byte < 0x80:
            return value, place + shift + 1
    raise ValueError("a page header with a number that is too long")


def _decode_zigzag(zigzag: int) -> int:
    return (zigzag >> 1) ^ -(zigzag & 1)
