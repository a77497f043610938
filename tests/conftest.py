"""No test leaves an asyncio task or a child process behind; examples are the same in every run."""

from __future__ import annotations

import asyncio
import gc
import inspect
import itertools
import multiprocessing
import os
import shutil
import signal
import tempfile
from collections.abc import AsyncIterator, Callable, Generator, Iterator
from pathlib import Path

import pytest
from hypothesis import settings
from steady_loop import SteadyLoop

from membrane_ctrl.instruments import lock_store
from tests.support import real_data
from tests.support.file_order import sort_items
from tests.support.undrawn import undrawn_figures

# No test sees or leaves locks on this machine's devices, nor does a program that a module's fixture
# starts.
_LOCKS_FOLDER = tempfile.mkdtemp(prefix="membrane-locks-")
_NUMBERS = itertools.count()
_EMPTY_FOLDERS: list[Path] = []
os.environ[lock_store.VARIABLE] = _LOCKS_FOLDER
# The keys of a test's services are its own.
_STATE_FOLDER = tempfile.mkdtemp(prefix="membrane-state-")
os.environ["XDG_STATE_HOME"] = _STATE_FOLDER
# No hold of a test starts a service, unless the test is about that.
os.environ["MEMBRANE_CTRL_SERVICE"] = "false"

settings.register_profile("seeded", derandomize=True, deadline=None)
settings.load_profile("seeded")


def pytest_asyncio_loop_factories() -> dict[str, Callable[[], SteadyLoop]]:
    return {"steady": SteadyLoop}


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """What is imported and collected stays to the end: the collector of garbage need not look at
    it.
    """
    gc.disable()
    collected = yield
    gc.freeze()
    gc.enable()
    return collected


def pytest_itemcollected(item: pytest.Item) -> None:
    """Of a test with the mark `fast_cases`, only the cases that it names are fast tests."""
    mark = item.get_closest_marker("fast_cases")
    if mark is not None and _case_of(item) not in mark.args:
        item.add_marker(pytest.mark.campaign)


@pytest.hookimpl(tryfirst=True)  # before cases are left out by their marks
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Sort the tests, and refuse names in `fast_cases` that are those of no case."""
    sort_items(items)
    if any("[" in arg for arg in config.args):
        return
    named: dict[str, set[str]] = {}
    for item in items:
        if mark := item.get_closest_marker("fast_cases"):
            test = item.nodeid.partition("[")[0]
            named.setdefault(test, set(mark.args)).discard(_case_of(item))
    unknown = {test: sorted(names) for test, names in named.items() if names}
    if unknown:
        raise pytest.UsageError(f"`fast_cases` names what is no case: {unknown}")


def _case_of(item: pytest.Item) -> str:
    """The name of a case, as it stands in brackets."""
    return item.nodeid.partition("[")[2].removesuffix("]")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say so where tests of real frames were skipped."""
    skipped = terminalreporter.stats.get("skipped", [])
    reasons = [report.longrepr[2] for report in skipped if isinstance(report.longrepr, tuple)]
    if note := real_data.describe_skipped_frames(reasons):
        terminalreporter.write_line(note)


def pytest_sessionfinish() -> None:
    shutil.rmtree(_LOCKS_FOLDER, ignore_errors=True)
    shutil.rmtree(_STATE_FOLDER, ignore_errors=True)


@pytest.fixture
async def leaves_no_task() -> AsyncIterator[None]:
    before = asyncio.all_tasks()
    yield
    left = {task for task in asyncio.all_tasks() - before if not task.done()} - {
        asyncio.current_task()
    }
    assert not left, f"left running: {left}"


@pytest.fixture
def signals_are_heeded() -> Iterator[None]:
    """Started with `nohup`, or by a script's `&`, a test ignores signals, and so would its
    children.
    """
    before = {number: signal.getsignal(number) for number in (signal.SIGHUP, signal.SIGINT)}
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def undrawn() -> Iterator[None]:
    """For a test that needs no picture; pictures of its module's fixtures are drawn before."""
    with undrawn_figures():
        yield


def _make_locks_folder() -> Path:
    folder = Path(
        _LOCKS_FOLDER, str(next(_NUMBERS))
    )  # mktemp would list the folders of all tests before
    folder.mkdir()
    return folder


@pytest.fixture(autouse=True)
def own_locks() -> Iterator[None]:
    """The locks of a test are its own; a folder that a test leaves empty serves the next."""
    if not _EMPTY_FOLDERS:
        _EMPTY_FOLDERS.append(_make_locks_folder())
    folder = _EMPTY_FOLDERS.pop()
    os.environ[lock_store.VARIABLE] = str(folder)
    yield
    os.environ[lock_store.VARIABLE] = _LOCKS_FOLDER
    if folder.is_dir() and not any(folder.iterdir()):
        _EMPTY_FOLDERS.append(folder)


@pytest.fixture(autouse=True)
def leaves_nothing_behind(request: pytest.FixtureRequest) -> Iterator[None]:
    function = getattr(request, "function", None)
    if function is not None and inspect.iscoroutinefunction(function):
        request.getfixturevalue("leaves_no_task")
    yield
    left = multiprocessing.active_children()
    for process in left:
        process.kill()
        process.join()
    assert not left, f"left running: {left}"
