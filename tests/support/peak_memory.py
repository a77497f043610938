"""The largest memory that this process has had: the kernel's VmHWM, which it can be made to forget.

`ru_maxrss` of getrusage begins, in a new process, with the peak of the process that started it, and
never falls.
"""

from __future__ import annotations

from pathlib import Path

_PROCESS = Path("/proc/self")


def peak_mb() -> float:
    """Largest resident memory in MB since the start of the program or the last `reset_peak`."""
    return _memory_mb("VmHWM")


def reset_peak() -> float:
    """Make the present resident memory the peak; returns it in MB."""
    (_PROCESS / "clear_refs").write_text("5")
    return _memory_mb("VmRSS")


def _memory_mb(name: str) -> float:
    lines = (_PROCESS / "status").read_text().splitlines()
    kilobytes = next(line.split()[1] for line in lines if line.startswith(f"{name}:"))
    return float(kilobytes) * 1024 / 1e6
