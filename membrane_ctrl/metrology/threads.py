"""Two threads of our own for kernels that release the interpreter lock.

The kernels are plain compiled loops over [start, stop). Splitting them here, instead of in the compiler's parallel
loops, keeps idle threads asleep (the control loop shares the machine), has no library that may be entered only
once, and adds partial sums in a fixed order, so that results repeat to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import TypeVar

T = TypeVar("T")
WORKERS = 2


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(WORKERS - 1, thread_name_prefix="metrology")


def split(run: Callable[[int, int], T], count: int) -> list[T]:
    """`run(start, stop)` over [0, count) in WORKERS pieces; results in order. The caller's thread takes one."""
    edges = [count * k // WORKERS for k in range(WORKERS + 1)]
    others = [_pool().submit(run, start, stop) for start, stop in pairwise(edges[1:])]
    first = run(edges[0], edges[1])
    return [first, *(other.result() for other in others)]
