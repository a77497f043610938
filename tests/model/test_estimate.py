"""A shape estimate as bytes: exact to the last bit, and other bytes are refused."""

from __future__ import annotations

import json
import math
import pickle
import random
from dataclasses import astuple, replace
from typing import Any

import numpy as np
import pytest

from membrane_ctrl.model.shape_estimate import ShapeEstimate, pack_estimate, unpack_estimate
from membrane_ctrl.model.zernike_terms import COVARIANCE_UPPER_SIZE, ZERNIKE_TERMS
from tests.worlds.synthetic_shape import shape_at

ESTIMATE = unpack_estimate(pack_estimate(shape_at(3.0)))
BYTES = pack_estimate(ESTIMATE)
LINE, _, ARRAYS = BYTES.partition(b"\n")
COEFFS_BYTES = 8 * ZERNIKE_TERMS


def bits(estimate: ShapeEstimate) -> list[object]:
    return [
        value.tobytes() if isinstance(value, np.ndarray) else repr(value)
        for value in astuple(estimate)
    ]


def with_head(**changed: object) -> bytes:
    return json.dumps({**json.loads(LINE), **changed}).encode() + b"\n" + ARRAYS


@pytest.mark.parametrize(
    "estimate",
    [
        shape_at(1.0),
        replace(
            shape_at(2.0),
            verdict="rejected",
            coeffs_um=np.full(ZERNIKE_TERMS, np.nan),
            sag_um=math.nan,
            reason="dark: ü",
        ),
        replace(
            shape_at(3.0),
            covariance_um2=np.random.default_rng(1).normal(size=(ZERNIKE_TERMS, ZERNIKE_TERMS)),
            time_s=-0.0,
        ),
        replace(
            shape_at(4.0), covariance_um2=np.full((ZERNIKE_TERMS, ZERNIKE_TERMS), np.nan), cycle=7
        ),
    ],
)
def test_an_estimate_that_was_sent_comes_back_to_the_last_bit(estimate: ShapeEstimate) -> None:
    sent = unpack_estimate(pack_estimate(estimate))
    assert bits(unpack_estimate(pack_estimate(sent))) == bits(sent)
    assert bits(replace(sent, covariance_um2=estimate.covariance_um2)) == bits(estimate)


def test_the_covariance_is_sent_in_single_precision_and_the_message_is_small() -> None:
    sent = shape_at(3.0)
    assert ESTIMATE.covariance_um2 == pytest.approx(sent.covariance_um2, rel=1e-7)
    assert np.array_equal(ESTIMATE.covariance_um2, sent.covariance_um2.astype(np.float32))
    assert len(ARRAYS) == COEFFS_BYTES + 4 * COVARIANCE_UPPER_SIZE
    assert len(LINE) < 1000


@pytest.mark.parametrize(
    "message",
    [
        b"",
        pickle.dumps(ESTIMATE),
        b"[" * 8000 + b"\n" + ARRAYS,
        b"[]\n" + ARRAYS,
        LINE,
        BYTES[:-1],
        BYTES + b"\0",
        LINE + b" " * 10_000 + b"\n" + ARRAYS,
        with_head(terms=1_000_000_000),
        with_head(terms=-ZERNIKE_TERMS),
        with_head(covariance_um2=[1.0]),
        with_head(__class__="x"),
        with_head(sag_um="37000"),
        with_head(sag_um=True),
        with_head(sag_um=math.inf),
        with_head(sag_um=10**400),
        with_head(time_s=math.nan),
        with_head(time_s=None),
        with_head(verdict="fine"),
        with_head(kind=["full"]),
        with_head(cycle=1.5),
        with_head(cycle=-1),
        with_head(cycle=2**80),
        with_head(reason=7),
        LINE + b"\n" + np.full(ZERNIKE_TERMS, np.inf).tobytes() + ARRAYS[COEFFS_BYTES:],
        LINE
        + b"\n"
        + ARRAYS[:COEFFS_BYTES]
        + np.full(COVARIANCE_UPPER_SIZE, np.inf, "<f4").tobytes(),
    ],
    ids=range(26),
)
def test_invalid_messages_are_refused_as_estimate(message: bytes) -> None:
    with pytest.raises(ValueError):  # JSON's own words are as good as ours
        unpack_estimate(message)


def test_random_damage_is_refused_or_gives_an_estimate_of_the_right_kinds() -> None:
    random_of = random.Random(15)
    taken = 0
    for _ in range(3000):
        data = bytearray(BYTES)
        for _ in range(random_of.randint(1, 3)):
            place = random_of.randrange(len(LINE) if random_of.random() < 0.8 else len(data))
            data[place] = random_of.randrange(256)
        try:
            found: Any = unpack_estimate(bytes(data))
        except ValueError:
            continue
        taken += 1
        assert found.coeffs_um.shape == (ZERNIKE_TERMS,)
        assert found.covariance_um2.shape == (ZERNIKE_TERMS, ZERNIKE_TERMS)
        assert isinstance(found.sag_um, float)
        assert math.isfinite(found.time_s)
    assert taken > 100
