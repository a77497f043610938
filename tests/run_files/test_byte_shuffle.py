"""Shuffled bytes come back bit by bit, and need less room."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest

from membrane_ctrl.run_files.table_store.byte_shuffle import shuffle_batch, unshuffle_batch

RNG = np.random.default_rng(4)
COUNT = 50
SIGNALLING = np.array([0x7FF0_0000_0000_0001] * COUNT, np.uint64).view(np.float64)
COLUMNS: dict[str, pa.Array] = {
    "doubles": pa.array(RNG.normal(size=COUNT)),
    "singles": pa.array(RNG.normal(size=COUNT).astype(np.float32)),
    "with nulls": pa.array([None if n % 3 == 0 else 1.5 * n for n in range(COUNT)]),
    "all null": pa.array([None] * COUNT, pa.float64()),
    "bits of NaN": pa.array(SIGNALLING, from_pandas=False),
    "codes": pa.array(range(COUNT), pa.int64()),
    "small": pa.array(range(COUNT), pa.uint8()),
    "flags": pa.array([n % 2 == 0 for n in range(COUNT)]),
    "texts": pa.array([f"text {n}" for n in range(COUNT)]),
    "times": pa.array(range(COUNT), pa.timestamp("us", "UTC")),
    "lists": pa.FixedSizeListArray.from_arrays(
        pa.array(RNG.normal(size=COUNT * 36), pa.float32()), 36
    ),
}


@pytest.mark.parametrize("name", COLUMNS)
@pytest.mark.parametrize(("start", "rows"), [(0, COUNT), (3, 20), (5, 1), (9, 0)])
def test_every_kind_of_column_comes_back_bit_by_bit(name: str, start: int, rows: int) -> None:
    batch = pa.record_batch([COLUMNS[name]], names=[name]).slice(start, rows)
    back = unshuffle_batch(shuffle_batch(batch))
    back.validate(full=True)
    assert back.schema == batch.schema
    if name == "bits of NaN":
        found, expected = (each.column(0).to_numpy().view(np.uint64) for each in (back, batch))
        assert np.array_equal(found, expected)
    else:
        assert back.column(0).equals(batch.column(0))


def test_a_list_without_values_in_it_comes_back() -> None:
    column = pa.array([[1.0, 2.0], None, [3.0, 4.0]], pa.list_(pa.float64(), 2))
    batch = pa.record_batch([column], names=["lists"])
    assert unshuffle_batch(shuffle_batch(batch)).equals(batch)


def test_readings_pack_into_less() -> None:
    walk = 1000.0 + np.cumsum(RNG.normal(size=COUNT))
    batch = pa.record_batch([pa.array(walk.round(3))], names=["displacement_um"])
    codec = pa.Codec("zstd", compression_level=3)
    plain, shuffled = (
        len(codec.compress(each.serialize(), asbytes=True))
        for each in (batch, shuffle_batch(batch))
    )
    assert shuffled < 0.9 * plain
