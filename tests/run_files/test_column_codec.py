"""Columns of numbers as they are stored: any bits go in, the same bits come out."""

from __future__ import annotations

import math

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from membrane_ctrl.controller.tick import RECORD
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.run_files.column_codec import SUM, decode, encode, stored_schema

SCHEMA = pa.schema(
    [
        pa.field("a", pa.float64()), pa.field("b", pa.float64(), metadata={SUM: "a -c"}),
        pa.field("c", pa.float32(), metadata={SUM: "a"}), pa.field("n", pa.uint8()),
        pa.field("list", pa.list_(pa.float32(), 3)), pa.field("word", pa.string()),
    ]
)  # fmt: skip


def back(batch: pa.RecordBatch) -> pa.RecordBatch:
    stored = stored_schema(batch.schema)
    coded, codes = encode(batch, stored)
    coded.validate(full=True)
    return decode(coded, stored, codes, batch.schema.names)


@given(st.integers(1, 60), st.randoms(use_true_random=False))
@settings(max_examples=40, deadline=None)
def test_any_bytes_come_back(count: int, random: object) -> None:
    data = random.randbytes(count * RECORD.itemsize)  # type: ignore[attr-defined]
    records = np.frombuffer(data, dtype=RECORD)
    names = RECORD.names or ()
    found = back(pa.record_batch({name: np.ascontiguousarray(records[name]) for name in names}))
    for name in names:
        assert found.column(name).to_numpy().tobytes() == records[name].tobytes(), name


def test_sums_lists_and_words_come_back() -> None:
    rng = np.random.default_rng(1)
    a, c = rng.normal(size=50), rng.normal(size=50).astype("<f4")
    lists = pa.FixedSizeListArray.from_arrays(pa.array(rng.normal(size=150).astype("<f4")), 3)
    rows = [a, np.where(np.arange(50) == 7, np.nan, a - c), c, np.arange(50, dtype="u1"), lists, pa.array(["x"] * 50)]
    batch = pa.record_batch([pa.array(row) for row in rows], schema=SCHEMA)
    found = back(batch)
    for name in ("a", "b", "c", "n"):
        assert found.column(name).to_numpy().tobytes() == batch.column(name).to_numpy().tobytes(), name
    assert found.column("list").flatten().equals(batch.column("list").flatten())
    assert found.column("word").equals(batch.column("word"))


@pytest.mark.parametrize(
    "values",
    [
        [0.1, 0.2, 0.3, -1234.5], [101325.218, 101325.147], [0.55584] * 3, [0.0, -0.0], [math.nan, 1.5], [math.inf],
        [1e300, 1.0], [5e-324], [2.0**31 / 10], [0.1 + 0.2], [1e9, -1e9], [2.0**53, 2.0**53 - 1],
    ],
)  # fmt: skip
def test_values_at_the_edges_of_the_decimals_come_back(values: list[float]) -> None:
    found = back(pa.record_batch({"x": np.array(values)}))
    assert found.column("x").to_numpy().tobytes() == np.array(values).tobytes()


def test_what_a_device_counts_in_tenths_takes_a_byte_or_two() -> None:
    values = np.rint(np.random.default_rng(1).normal(scale=10, size=3000)) / 10 + 0.0  # no minus zero
    schema = stored_schema(pa.schema([("x", pa.float64())]))
    coded, _ = encode(pa.record_batch({"x": values}), schema)
    assert len(pa.compress(coded.column(0).buffers()[1], codec="zstd")) < 4500


def test_a_figure_of_whole_nanometres_takes_thirty_bytes() -> None:
    """Terms with 5 nm of noise, 20 a second: less than 60 MB a day."""
    rng = np.random.default_rng(2)
    coeffs = (
        np.round(rng.normal(scale=100, size=ZERNIKE_TERMS) + rng.normal(scale=0.005, size=(2000, ZERNIKE_TERMS)), 3)
        + 0.0
    )
    field = pa.list_(pa.float64(), ZERNIKE_TERMS)
    batch = pa.record_batch({"c": pa.FixedSizeListArray.from_arrays(pa.array(coeffs.ravel()), ZERNIKE_TERMS)})
    coded, _ = encode(batch, stored_schema(pa.schema([("c", field)])))
    assert len(pa.compress(coded.column(0).buffers()[1], codec="zstd")) < 33 * 2000
    assert np.array_equal(back(batch).column("c").flatten().to_numpy(), coeffs.ravel())


def about(**sums: bytes) -> pa.Schema:
    fields = [pa.field(name, pa.float64(), metadata={SUM: text} if text else None) for name, text in sums.items()]
    return stored_schema(pa.schema(fields))


@pytest.mark.parametrize(
    ("schema", "codes"),
    [
        (about(x=b"", y=b""), b"b"),
        (about(x=b"", y=b""), None),
        (about(x=b"", y=b""), b"b9"),
        (about(x=b"", y=b""), b"b?"),
        (about(x=b"y", y=b"x"), b"ss"),
        (about(x=b"", y=b"z"), b"bs"),
        (about(x=b"", y=b"x " * 100), b"bs"),
        (about(x=b"", y=b"\xff"), b"bs"),
        (about(x=b"", y=b"").set(1, pa.field("y", pa.binary(8), metadata={b"kind": b"2<f8"})), b"bb"),
        (about(x=b"", y=b"").set(1, pa.field("y", pa.binary(8), metadata={b"kind": b"1|O"})), b"bb"),
    ],
)
def test_what_no_recorder_writes_is_refused(schema: pa.Schema, codes: bytes | None) -> None:
    cells = pa.array([bytes(8)] * 5, pa.binary(8))
    with pytest.raises(pa.ArrowInvalid):
        decode(pa.record_batch([cells, cells], schema=schema), schema, codes, ["x", "y"])


def test_a_batch_without_rows_is_refused() -> None:
    schema = about(x=b"")
    with pytest.raises(pa.ArrowInvalid):
        decode(pa.RecordBatch.from_pylist([], schema), schema, b"b", ["x"])
