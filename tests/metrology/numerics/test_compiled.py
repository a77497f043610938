"""Compiled kernels, cached on disk."""

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path

import numba
import pytest

from membrane_ctrl.metrology.numerics import compiled

KERNELS = """
from cached_steps import added
from membrane_ctrl.metrology.numerics.compiled import compile_kernel

@compile_kernel
def total(point):
    return added(point.x, point.y)
"""
STEPS = """
from membrane_ctrl.metrology.numerics.compiled import compile_step

@compile_step
def added(x, y):
    return x + y
"""
POINT = """
from typing import NamedTuple

class Point(NamedTuple):
    x: float
    y: float
"""
MODULES = ("cached_kernels", "cached_steps", "cached_former_place", "cached_present_place")


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of modules, and a cache in it."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    (tmp_path / "cached_kernels.py").write_text(KERNELS)
    (tmp_path / "cached_steps.py").write_text(STEPS)
    (tmp_path / "cached_former_place.py").write_text(POINT)
    yield tmp_path
    for name in MODULES:
        sys.modules.pop(name, None)


def total(folder: Path, module: str) -> tuple[float, int]:
    """Sum of a point whose class is in a module, in a new process as it were; how often the cache
    had the kernel.
    """
    for name in MODULES:
        sys.modules.pop(name, None)
    importlib.invalidate_caches()
    compiled._source_checksum.cache_clear()

    point = importlib.import_module(module).Point(1.0, 2.0)
    kernel = importlib.import_module("cached_kernels").total
    return kernel(point), sum(kernel.stats.cache_hits.values())


def test_a_cache_of_an_earlier_version_is_no_error(place: Path) -> None:
    """The class of an argument was in a module that is gone."""
    assert total(place, "cached_former_place") == (3.0, 0)
    (place / "cached_former_place.py").rename(place / "cached_present_place.py")
    assert [total(place, "cached_present_place") for _ in range(2)] == [(3.0, 0), (3.0, 1)]


@pytest.mark.parametrize("left", [0.0, 0.5, 0.95])
def test_a_torn_index_is_no_error(place: Path, left: float) -> None:
    assert total(place, "cached_former_place") == (3.0, 0)
    (index,) = (place / "cache").rglob("cached_kernels.*.nbi")
    index.write_bytes(index.read_bytes()[: int(left * index.stat().st_size)])
    assert [total(place, "cached_former_place") for _ in range(2)] == [(3.0, 0), (3.0, 1)]


def test_a_kernel_is_compiled_again_when_one_that_it_calls_has_changed(place: Path) -> None:
    """Numba looks at the kernel's own file only: after an update, half of it was of the former
    version.
    """
    assert total(place, "cached_former_place") == (3.0, 0)
    (place / "cached_steps.py").write_text(STEPS.replace("x + y", "2 * x + y"))
    assert [total(place, "cached_former_place") for _ in range(2)] == [(4.0, 0), (4.0, 1)]
