"""How the package's loops are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit


def kernel(function: Callable[..., Any]) -> Any:
    """Compile a loop; the result is cached on disk and runs without the interpreter lock.

    Sums may be reordered, which vector units need; NaN and infinity keep their meaning.
    """
    fast = {"reassoc", "contract", "nsz", "arcp"}
    return njit(cache=True, nogil=True, error_model="numpy", fastmath=fast)(function)
