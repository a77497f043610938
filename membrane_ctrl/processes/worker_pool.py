"""Runs a job for many items: in this process, on several processes, or on a Dask cluster."""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, TypeVar

from membrane_ctrl.model import errors
from membrane_ctrl.model.optional import import_optional
from membrane_ctrl.processes.child import SPAWN_CONTEXT

_CONNECT_S = 30

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


@contextlib.contextmanager
def run_jobs(
    job: Callable[[_Item], _Result],
    items: Sequence[_Item],
    workers: int = 1,
    scheduler: str | None = None,
) -> Iterator[Iterable[_Result]]:
    """Run a job for many items, in this process, on processes, or on a Dask cluster.

    Parameters
    ----------
    job : callable
        A function of one item; picklable.
    items : sequence of _Item
        The items.
    workers : int
        Processes; 1 is this one.
    scheduler : str or None
        Address of a Dask scheduler, instead of processes.

    Returns
    -------
    iterator of iterable of _Result
        The results, in the order of the items.

    Raises
    ------
    InputError
        Dask is not installed, or its address is wrong.
    DeviceError
        The scheduler does not answer, or a worker was killed.
    """
    if scheduler is not None:
        with _dask_client(scheduler) as client:
            yield (future.result() for future in client.map(job, items, pure=False))
    elif workers > 1:
        from concurrent.futures.process import BrokenProcessPool, ProcessPoolExecutor

        try:
            with ProcessPoolExecutor(workers, mp_context=SPAWN_CONTEXT) as pool:
                yield pool.map(job, items)
        except BrokenProcessPool:
            raise errors.DeviceError(
                "a worker was killed, perhaps for want of memory; use fewer --workers"
            ) from None
    else:
        yield map(job, items)


def _dask_client(address: str) -> Any:
    distributed = import_optional("distributed", "dask", "--scheduler")
    try:
        return distributed.Client(address, timeout=_CONNECT_S)
    except ValueError as error:
        raise errors.InputError(f"--scheduler {address}: {error}") from None
    except OSError as error:  # includes time-outs
        raise errors.DeviceError(f"--scheduler {address}: does not answer ({error})") from None
