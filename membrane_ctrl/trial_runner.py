"""Runs Monte Carlo trials: here, over the cores, or on a Dask cluster; the numbers are the same wherever they run."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress

from membrane_ctrl.errors import DeviceError, InputError
from membrane_ctrl.metrology.geometry_spread import GeometrySpread
from membrane_ctrl.metrology.monte_carlo import TrialBench, run_trials

FloatArray = NDArray[np.float64]

_BATCH = 100  # trials a job: a tenth of a second each, so that the bar moves and no worker waits for long
# A process takes some two seconds to start (imports, compiled loops): less work than this is done here.
_WORTH_PROCESSES = 5000
_CONNECT_S = 10


def run_everywhere(
    benches: Sequence[TrialBench],
    spread: GeometrySpread,
    seed: int,
    trials: int,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
) -> FloatArray:
    """Parameters (trials, sets, 36) in mm, with a progress bar on a terminal.

    Parameters
    ----------
    benches, spread, seed
        See `monte_carlo.run_trials`.
    workers : int, optional
        Processes; chosen by the amount of work if not given.
    scheduler : str, optional
        Address of a Dask scheduler, as tcp://host:8786, to run there instead.

    Raises
    ------
    InputError
        If Dask is asked for and not installed, or if the spread is too wide for the fit to converge.
    DeviceError
        If the scheduler does not answer.
    """
    batches = [range(first, min(first + _BATCH, trials)) for first in range(0, trials, _BATCH)]
    job = partial(run_trials, benches, spread, seed)
    if workers is None:
        workers = (os.cpu_count() or 1) if trials * len(benches) >= _WORTH_PROCESSES else 1
    try:
        with _results(job, batches, min(workers, len(batches)), scheduler) as results:
            return np.concatenate(list(_shown(results, trials)))
    except ArithmeticError as error:
        raise InputError(f"uncertainty: {error}") from None


@contextmanager
def _results(job: Any, batches: list[range], workers: int, scheduler: str | None) -> Iterator[Iterator[FloatArray]]:
    """Results of the batches, in their order."""
    if scheduler is not None:
        with _dask_client(scheduler) as client:
            yield (future.result() for future in client.map(job, batches, pure=False))
    elif workers > 1:
        with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
            yield pool.map(job, batches)
    else:
        yield map(job, batches)


def _dask_client(address: str) -> Any:
    try:
        distributed = importlib.import_module("distributed")
    except ImportError:
        text = "--scheduler: Dask is not installed; install the extra `dask` (pip install 'membrane-ctrl[dask]')"
        raise InputError(text) from None
    try:
        return distributed.Client(address, timeout=_CONNECT_S)
    except ValueError as error:
        raise InputError(f"--scheduler {address}: {error}") from None
    except OSError as error:  # a timeout is one
        raise DeviceError(f"--scheduler {address}: does not answer ({error})") from None


def _shown(results: Iterator[FloatArray], trials: int) -> Iterator[FloatArray]:
    """The same, with a bar on stderr if that is a terminal."""
    with Progress(console=Console(stderr=True), disable=not sys.stderr.isatty(), transient=True) as progress:
        task = progress.add_task("trials", total=trials)
        for part in results:
            progress.update(task, advance=len(part))
            yield part
