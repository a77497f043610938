"""Holds a pneumatic membrane mirror to the micrometre and measures its optical figure while it does
so.
"""

import contextlib
import os
from pathlib import Path

__version__ = "1.0.0"

# Compiled kernels beside the modules would outlive `pip uninstall`. Without a home directory they
# are not stored (`model/kernel_cache.py`).
with contextlib.suppress(RuntimeError):
    _CACHES = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()
    os.environ.setdefault("NUMBA_CACHE_DIR", str(_CACHES / "membrane-ctrl"))
