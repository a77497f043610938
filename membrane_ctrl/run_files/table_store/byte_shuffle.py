"""Shuffles the bytes of numbers before they are packed: all first bytes, then all second ones.

Neighbouring readings share sign, exponent and leading digits. A packer finds that only if these
bytes stand beside each other; frames of a second then need a quarter less room. The same idea is
the "shuffle" filter of HDF5 and Blosc, and Parquet's byte stream split.
"""

from collections.abc import Callable

import numpy as np
import pyarrow as pa

from membrane_ctrl.model.arrays import AnyArray


def shuffle_batch(batch: pa.RecordBatch) -> pa.RecordBatch:
    """Shuffle the numbers of a batch.

    Parameters
    ----------
    batch : pyarrow.RecordBatch
        Rows of a journal's frame; it is not changed.

    Returns
    -------
    pyarrow.RecordBatch
        Of the same schema and null values. Columns of numbers and of lists of equal length of
        numbers are shuffled, others are as they were.
    """
    return _map_columns(batch, lambda words: words.T)


def unshuffle_batch(batch: pa.RecordBatch) -> pa.RecordBatch:
    """Undo `shuffle_batch`."""
    return _map_columns(batch, lambda words: words.reshape(words.shape[::-1]).T)


def _map_columns(batch: pa.RecordBatch, order: Callable[[AnyArray], AnyArray]) -> pa.RecordBatch:
    columns = [_map_numbers(column, order) for column in batch.columns]
    return pa.record_batch(columns, schema=batch.schema)


def _map_numbers(column: pa.Array, order: Callable[[AnyArray], AnyArray]) -> pa.Array:
    """A column with its bytes in another order; `order` takes (numbers, bytes of a number)."""
    if pa.types.is_fixed_size_list(column.type) and column.null_count == 0:
        values = _map_numbers(column.flatten(), order)
        return pa.FixedSizeListArray.from_arrays(values, type=column.type)
    if not (pa.types.is_integer(column.type) or pa.types.is_floating(column.type)):
        return column
    if column.offset:  # a slice: its validity bits do not begin with a byte
        column = column.take(pa.array(range(len(column)), pa.int64()))
    validity, numbers = column.buffers()
    width = column.type.bit_width // 8
    count = len(column)
    words = np.frombuffer(numbers, np.uint8, count * width).reshape(count, width)
    ordered = pa.py_buffer(order(words).tobytes())
    return pa.Array.from_buffers(column.type, count, [validity, ordered], column.null_count)
