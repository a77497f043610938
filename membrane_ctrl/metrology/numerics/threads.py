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
    """The other threads, started at the first use; the caller's thread is one of them."""
    return ThreadPoolExecutor(WORKERS - 1, thread_name_prefix="metrology")


def split_over_threads(run: Callable[[int, int], T], count: int, fewest: int = 0) -> list[T]:
    """Run a loop over [0, count) in WORKERS pieces, one of them in the caller's thread.

    Parameters
    ----------
    run : callable
        `run(start, stop)`; it must release the interpreter lock to gain anything.
    count : int
        Points.
    fewest : int
        A smaller count is not split.

    Returns
    -------
    list
        Results of the pieces, in their order.
    """
    if count < fewest:
        return [run(0, count)]
    edges = [count * k // WORKERS for k in range(WORKERS + 1)]
    pool = _thread_pool()
    others = [pool.submit(run, start, stop) for start, stop in pairwise(edges[1:])]
    first = run(edges[0], edges[1])
    return [first, *(other.result() for other in others)]
