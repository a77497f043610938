"""On which processor and with which libraries numbers are computed: their last bits depend on it.

The same program gives the same bits on the same processor with the same libraries. Elsewhere the
order of a sum in the linear algebra, or the last bit of a sine, may be another
(docs/how-to/replay.md).
"""

import platform
from functools import cache
from pathlib import Path

import numpy as np

_CPUINFO = Path("/proc/cpuinfo")
# Of x86, and of ARM, which has no names
_MODEL_KEYS = ("model name", "CPU implementer", "CPU part")


@cache
def describe_arithmetic() -> str:
    """Processor, C library, Python and NumPy in one line."""
    libc = " ".join(platform.libc_ver()).strip() or platform.system()
    python = f"{platform.python_implementation()} {platform.python_version()}"
    return f"{platform.machine()} {_processor_model()}; {libc}; {python}; NumPy {np.__version__}"


def _processor_model() -> str:
    try:
        text = _CPUINFO.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return platform.processor()
    return find_model(text)


def find_model(cpuinfo: str) -> str:
    """The model of the first processor in the text of /proc/cpuinfo."""
    values: dict[str, str] = {}
    for line in cpuinfo.splitlines():
        key, _, value = line.partition(":")
        values.setdefault(key.strip(), value.strip())
    return " ".join(values[key] for key in _MODEL_KEYS if key in values)
