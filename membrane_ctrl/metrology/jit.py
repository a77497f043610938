"""How the package's loops are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit

# Sums may be reordered, which vector units need; NaN and infinity keep their meaning.
_OPTIONS: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"reassoc", "contract", "nsz", "arcp"},
}


def kernel(function: Callable[..., Any]) -> Any:
    """Compile a loop; the result is cached on disk and runs without the interpreter lock."""
    return njit(**_OPTIONS)(function)


def step(function: Callable[..., Any]) -> Any:
    """Compile what a loop does to one point. Inlined by force: a loop with a call in it uses no vector units."""
    return njit(forceinline=True, **_OPTIONS)(function)
