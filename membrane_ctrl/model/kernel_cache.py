"""Compiles loops with Numba, and stores the compiled code where a folder can be written.

A container with a foreign user id, a read-only disk or a full one has no such folder. Then each
start compiles, which takes up to a minute, and one note announces it.
"""

import os
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

_FOLDER = "NUMBA_CACHE_DIR"  # set by the package's `__init__`, or by the user
_NOTED = "MEMBRANE_CTRL_CACHE_NOTED"  # in the environment: child processes do not repeat the note


def compile_loop(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function, with Numba's options.

    The compiled code is stored if a folder can be written; any trouble with it costs time only.
    """
    from numba import njit

    def compile_function(function: Callable[..., Any]) -> Any:
        dispatcher = njit(**options)(function)
        if has_folder():
            _store_code(dispatcher)
        return dispatcher

    return compile_function


@cache
def has_folder() -> bool:
    """Whether compiled code can be stored; notes on stderr, once, if not."""
    folder = os.environ.get(_FOLDER, "")
    try:
        if not folder:
            raise OSError("there is no home directory")
        Path(folder).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError as error:
        _print_note(f"{folder or 'the cache'}: {error.strerror or error}")
        return False


def _store_code(dispatcher: Any) -> None:
    """Let a dispatcher store its code; an error in doing so, as on a full disk, is noted."""
    try:
        dispatcher.enable_caching()
    except (RuntimeError, OSError) as error:  # no folder suits Numba
        _print_note(str(error))
        return
    code_cache = dispatcher._cache
    save = code_cache.save_overload

    def save_if_possible(*arguments: Any) -> None:
        try:
            save(*arguments)
        except OSError as error:
            _print_note(f"{error.filename or os.environ[_FOLDER]}: {error.strerror or error}")

    code_cache.save_overload = save_if_possible


def _print_note(why: str) -> None:
    if os.environ.get(_NOTED):
        return
    os.environ[_NOTED] = "1"
    print(
        f"membrane-ctrl: compiled code cannot be stored ({why}), so each start compiles it, which "
        f"takes up to a minute; name a writable folder in {_FOLDER} to avoid that",
        file=sys.stderr,
    )
