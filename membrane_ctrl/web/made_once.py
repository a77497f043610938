"""Makes a thing once for all viewers who ask for it."""

import asyncio
import time
from collections.abc import Callable, Hashable
from typing import Any, Generic, TypeVar

from membrane_ctrl.service.work_pool import WorkPool

T = TypeVar("T")


class MadeOnce(Generic[T]):
    """Makes a thing on a thread of a pool, once for all who ask for it within its life."""

    def __init__(self, make: Callable[..., T], pool: WorkPool, life_s: float) -> None:
        self._make = make
        self._pool = pool
        self._life_s = life_s
        self._made: dict[tuple[Hashable, ...], tuple[asyncio.Task[T], float]] = {}

    async def get(self, *key: Hashable) -> T:
        """What `make` returns, or raises, for these arguments."""
        # What is too old goes, and so does a failure: the next viewer tries again
        now_s = time.monotonic()
        self._made = {k: made for k, made in self._made.items() if _is_current(*made, now_s)}
        if key not in self._made:
            self._made[key] = (
                asyncio.create_task(self._pool.run(self._make, *key)),
                now_s + self._life_s,
            )
        # A viewer who leaves cancels that viewer's wait, and not the task for the others
        return await asyncio.shield(self._made[key][0])


def _is_current(task: asyncio.Task[Any], end_s: float, now_s: float) -> bool:
    """Whether a task still runs, or has made a thing that is not too old."""
    if not task.done():
        return True
    failed = task.cancelled() or task.exception() is not None
    return not failed and end_s > now_s
