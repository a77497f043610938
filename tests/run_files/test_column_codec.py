"""Columns of tick records: any bits go in, the same bits come out."""

from __future__ import annotations

import math
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from membrane_ctrl.controller.tick import RECORD
from membrane_ctrl.run_files.column_file import decode_columns, encode_columns


@given(st.integers(0, 60), st.randoms(use_true_random=False))
@settings(max_examples=40, deadline=None)
def test_any_bytes_come_back(count: int, random: object) -> None:
    data = random.randbytes(count * RECORD.itemsize)  # type: ignore[attr-defined]
    records = np.frombuffer(data, dtype=RECORD)
    back, taken = decode_columns(encode_columns(records) + b"behind", RECORD, count)
    assert back.tobytes() == data
    assert taken == len(encode_columns(records))


@pytest.mark.parametrize(
    "values",
    [
        [0.1, 0.2, 0.3, -1234.5], [101325.218, 101325.147], [0.55584] * 3, [0.0, -0.0], [math.nan, 1.5], [math.inf],
        [1e300, 1.0], [5e-324], [2.0**31 / 10], [0.1 + 0.2], [1e9, -1e9],
    ],
)  # fmt: skip
def test_values_at_the_edges_of_the_decimals_come_back(values: list[float]) -> None:
    records = np.zeros(len(values), dtype=RECORD)
    records["displacement_um"] = values
    back, _ = decode_columns(encode_columns(records), RECORD, len(values))
    assert back.tobytes() == records.tobytes()


def test_what_a_device_counts_in_tenths_takes_a_byte_or_two() -> None:
    records = np.zeros(50, dtype=RECORD)
    empty = len(zlib.compress(encode_columns(records), 6))
    records["displacement_um"] = np.rint(np.random.default_rng(1).normal(scale=10, size=50)) / 10
    assert len(zlib.compress(encode_columns(records), 6)) - empty < 100
