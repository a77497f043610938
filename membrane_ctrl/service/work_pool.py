"""Threads for one kind of work, with a bound on the tasks that wait."""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

T = TypeVar("T")


class PoolFullError(RuntimeError):
    """As many tasks of this kind are running and waiting as its pool admits."""


class WorkPool:
    """Threads for one kind of work.

    Parameters
    ----------
    name
        Kind of work, for the names of the threads.
    workers
        Tasks that run at the same time.
    waiting_max
        Tasks that may wait for a thread.
    niceness
        Added to the niceness of the process, for work that should yield to everything else.
    """

    def __init__(self, name: str, workers: int, waiting_max: int, niceness: int = 0) -> None:
        self.name = name
        self._tasks_max = workers + waiting_max
        self._tasks = 0
        self._lock = threading.Lock()
        # on Linux, `os.nice` changes the calling thread only
        self._threads = ThreadPoolExecutor(
            workers, f"page {name}", initializer=os.nice, initargs=(niceness,)
        )

    async def run(self, function: Callable[..., T], *arguments: Any) -> T:
        """Return what the function returns, or raise what it raises. Raises PoolFullError if too
        many tasks wait.
        """
        with self._lock:
            if self._tasks >= self._tasks_max:
                raise PoolFullError(f"{self.name}: too many requests are waiting; try again")
            self._tasks += 1
        try:
            task = self._threads.submit(function, *arguments)
        except BaseException:
            self._count_end()
            raise
        task.add_done_callback(self._count_end)
        return await asyncio.wrap_future(task)

    def _count_end(self, _: Future[Any] | None = None) -> None:
        with self._lock:
            self._tasks -= 1
