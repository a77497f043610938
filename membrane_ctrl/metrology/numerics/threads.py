"""Two threads of our own for kernels that release the interpreter lock.

Kernels are plain compiled loops over [start, stop). Splitting them here, instead of in the
compiler's parallel loops, keeps idle threads asleep (the control loop shares the machine), avoids
a library that only one thread may enter, and adds partial sums in a fixed order, so that results
repeat to the last bit.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import TypeVar

T = TypeVar("T")
WORKERS = 2
FEW = 4096  # points: waking a thread takes longer


@cache
def _thread_pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(WORKERS - 1, thread_name_prefix="metrology")


def split_over_threads(run: Callable[[int, int], T], count: int, fewest: int = 0) -> list[T]:
    """`run(start, stop)` over [0, count) in WORKERS pieces; results in order. The caller's thread
    takes one.

    A count below `fewest` is not split.
    """
    if count < fewest:
        return [run(0, count)]
    edges = [count * k // WORKERS for k in range(WORKERS + 1)]
    others = [_thread_pool().submit(run, start, stop) for start, stop in pairwise(edges[1:])]
    first = run(edges[0], edges[1])
    return [first, *(other.result() for other in others)]
