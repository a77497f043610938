"""Copies of a virtual bench with its controller, so that tests share one computed start of a hold.

A copy continues exactly as the original would, and neither changes the other.
"""

from __future__ import annotations

import copy
import copyreg
import struct
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

T = TypeVar("T")


def _remake(packing: struct.Struct) -> tuple[type[struct.Struct], tuple[str]]:
    return struct.Struct, (packing.format,)


copyreg.pickle(struct.Struct, _remake)  # which `copy` does not know


class Originals(Generic[T]):
    """Objects that are made once a process; each caller gets a copy.

    Parameters
    ----------
    count_max : int
        How many are kept; the one that was asked for longest ago is forgotten.
    """

    def __init__(self, count_max: int = 16) -> None:
        self._count_max = count_max
        self._kept: dict[Hashable, T] = {}

    def copy_of(self, key: Hashable, make: Callable[[], T]) -> T:
        """A copy of the object of this key, which is made if it is not there."""
        original = self._kept.pop(key, None) or make()
        self._kept[key] = original
        if len(self._kept) > self._count_max:
            del self._kept[next(iter(self._kept))]
        return copy.deepcopy(original)
