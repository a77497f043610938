"""Bytes put together wrongly are named, and sound pictures are not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from membrane_ctrl.config.schema import CameraConfig, OpticsConfig
from membrane_ctrl.measure.capture_set import read_set
from membrane_ctrl.measure.pixel_format import find_pixel_mistake, find_size_mistake
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.sim.optics.film_shape import typical_film
from membrane_ctrl.sim.optics.simulate import simulate_set
from membrane_ctrl.sim.optics.simulation_spec import SimulationSpec

Words = np.ndarray


def pictures(bits: int, noise: float = 0.004) -> Words:
    """Fringes of three periods, a bright and a dark picture, in a disc, with noise."""
    rng = np.random.default_rng(5)
    row, column = np.mgrid[:96, :120]
    disc = np.hypot(row - 47.5, column - 59.5) < 45
    light = [0.5 + 0.4 * np.cos(2 * np.pi * column / period) for period in (120, 40, 17)]
    light += [np.full(row.shape, 0.9), np.full(row.shape, 0.02)]
    scene = np.stack([np.where(disc, each, 0.01) for each in light])
    counts = (2**bits - 1) * np.clip(scene + noise * rng.standard_normal(scene.shape), 0, 1)
    return np.round(counts).astype(np.uint8 if bits == 8 else np.uint16)


def pack_p(words: Words) -> Words:
    """Mono12p: the low byte of the first pixel comes first."""
    first, second = words[..., 0::2], words[..., 1::2]
    parts = (first & 0xFF, first >> 8 | (second & 0xF) << 4, second >> 4)
    return np.stack(parts, axis=-1).astype(np.uint8)


def pack_packed(words: Words) -> Words:
    """Mono12Packed: the high byte of the first pixel comes first."""
    first, second = words[..., 0::2], words[..., 1::2]
    parts = (first >> 4, first & 0xF | (second & 0xF) << 4, second >> 4)
    return np.stack(parts, axis=-1).astype(np.uint8)


def unpack_p(packed: Words) -> Words:
    low, both, high = np.moveaxis(packed.astype(np.uint16), -1, 0)
    words = np.stack([low | (both & 0xF) << 8, both >> 4 | high << 4], axis=-1)
    return words.reshape(*words.shape[:2], -1)


def unpack_packed(packed: Words) -> Words:
    first, both, second = np.moveaxis(packed.astype(np.uint16), -1, 0)
    words = np.stack([first << 4 | both & 0xF, second << 4 | both >> 4], axis=-1)
    return words.reshape(*words.shape[:2], -1)


def pack_ten(words: Words) -> Words:
    """Mono10p: four pixels in five bytes, low bits first."""
    a, b, c, d = (words[..., k::4].astype(np.uint32) for k in range(4))
    parts = (a & 0xFF, a >> 8 | (b & 0x3F) << 2, b >> 6 | (c & 0xF) << 4)
    parts = (*parts, c >> 4 | (d & 3) << 6, d >> 2)
    return np.stack(parts, axis=-1).astype(np.uint8)


def as_picture(packed: Words) -> Words:
    """Bytes as they come, in rows of their own length."""
    return packed.reshape(*packed.shape[:2], -1)


def cut(packed: Words) -> Words:
    """As many bytes as there should be pixels."""
    return packed.reshape(len(packed), -1)[:, : 96 * 120].reshape(-1, 96, 120)


def test_the_packings_are_undone_by_their_own_inverse() -> None:
    words = pictures(12)
    assert np.array_equal(unpack_p(pack_p(words)), words)
    assert np.array_equal(unpack_packed(pack_packed(words)), words)


@pytest.mark.parametrize("noise", [0.0, 0.004, 0.03])
@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_sound_pictures_are_not_blamed(bits: int, noise: float) -> None:
    assert find_pixel_mistake(pictures(bits, noise)) == ""


@pytest.mark.parametrize("shift", [0, 4])
@pytest.mark.parametrize("bits", [10, 12])
def test_swapped_bytes_are_named(bits: int, shift: int) -> None:
    found = find_pixel_mistake((pictures(bits) << shift).byteswap())
    assert found == "the two bytes of each pixel are in the wrong order"


@pytest.mark.parametrize(
    ("spoil", "name"),
    [
        (lambda words: unpack_p(pack_packed(words)), "unpacked as Mono12p"),
        (lambda words: unpack_packed(pack_p(words)), "unpacked as Mono12Packed"),
        (lambda words: as_picture(pack_p(words)), "packed two in three bytes, were read as bytes"),
        (lambda words: cut(pack_packed(words)), "packed two in three bytes, were read as bytes"),
        (lambda words: as_picture(words.view(np.uint8)), "16-bit pixels were read as bytes"),
        (lambda words: cut(words.view(np.uint8)), "16-bit pixels were read as bytes"),
        (lambda words: cut(pack_ten(words >> 2)), "packed four in five bytes"),
    ],
)
def test_packed_pixels_are_named(spoil: Callable[[Words], Words], name: str) -> None:
    assert name in find_pixel_mistake(spoil(pictures(12)))


def test_pure_noise_and_dark_pictures_have_no_such_cause() -> None:
    rng = np.random.default_rng(3)
    for dtype in (np.uint8, np.uint16):
        noise = rng.integers(0, np.iinfo(dtype).max, (4, 64, 60), dtype, endpoint=True)
        assert find_pixel_mistake(noise) == ""
        assert find_pixel_mistake(np.zeros((4, 64, 60), dtype)) == ""
    narrow = np.where(np.indices((64, 60))[1] % 4 < 2, 250, 5).astype(np.uint8)
    assert find_pixel_mistake(np.stack([narrow] * 3)) == ""


def test_a_size_that_packing_explains() -> None:
    assert "12-bit" in find_size_mistake((96, 180), (96, 120), np.dtype(np.uint8))
    assert "12-bit" in find_size_mistake((96, 90), (96, 120), np.dtype(np.uint16))
    assert "10-bit" in find_size_mistake((96, 150), (96, 120), np.dtype(np.uint8))
    assert "16-bit" in find_size_mistake((96, 240), (96, 120), np.dtype(np.uint8))
    assert find_size_mistake((96, 100), (96, 120), np.dtype(np.uint8)) == ""
    assert find_size_mistake((48, 180), (96, 120), np.dtype(np.uint8)) == ""


def test_a_set_with_swapped_bytes_is_refused_by_name(tmp_path: Path) -> None:
    """Before its depth is judged by its brightest pixel."""
    folder = tmp_path / "set"
    camera = CameraConfig(width_px=153, height_px=128, pixel_um=3.45 * 16, bits=12)
    simulate_set(
        folder, SimulationSpec(OpticsConfig(camera=camera), typical_film(37.1, 500.0, seed=1))
    )
    assert not read_set(folder).unusable
    for path in folder.glob("*.png"):
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED).byteswap())
    with pytest.raises(InputError, match="two bytes of each pixel are in the wrong order"):
        read_set(folder)
