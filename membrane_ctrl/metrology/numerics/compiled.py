"""How the package's loops are compiled: options, and a cache that notices changed sources."""

import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from membrane_ctrl.model.kernel_cache import compile_loop
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

# Sums may be reordered, which vector units need; NaN and infinity keep their meaning.
_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"reassoc", "contract", "nsz", "arcp"},
}
_FOLDER = Path(__file__).parents[1]  # of all kernels


def compile_kernel(function: Callable[..., Any]) -> Any:
    """Compile a loop; the result is cached on disk and runs without the interpreter lock."""
    return _recompiled_if_stale(compile_loop(**_OPTIONS)(function))


def compile_step(function: Callable[..., Any]) -> Any:
    """Compile what a loop does to one point. Inlined by force: a loop with a call in it uses no
    vector units.
    """
    return _recompiled_if_stale(compile_loop(forceinline=True, **_OPTIONS)(function))


def _recompiled_if_stale(dispatcher: Any) -> Any:
    """Let an index of the cache that is of other sources, or that cannot be read, count as empty.

    A kernel contains the kernels that it calls and the number of Zernike terms, but Numba looks for
    changes only in its own file. And it raises if an index was cut by a power failure, or names the
    classes of arguments by modules that are gone.
    """
    file = getattr(dispatcher._cache, "_cache_file", None)  # None where no folder is writable
    if file is not None:
        source = Path(dispatcher.py_func.__code__.co_filename)
        sources = _source_checksum(_FOLDER if _FOLDER in source.parents else source.parent)
        file._source_stamp = file._source_stamp, sources, ZERNIKE_TERMS
        load = file._load_index

        def load_index() -> dict[Any, str]:
            try:
                return dict(load())
            except OSError:
                raise
            except Exception:
                return {}

        file._load_index = load_index
    return dispatcher


@cache
def _source_checksum(folder: Path) -> int:
    """Checksum of the kernels in a folder."""
    texts = [path.read_bytes() for path in sorted(folder.rglob("*.py"))]
    return zlib.crc32(
        b"".join(text for text in texts if b"@compile_kernel" in text or b"@compile_step" in text)
    )
