"""Simulation and measurement run without the POSIX modules and flags that Windows and macOS lack.

They run on Linux with these blocked: that shows what the program asks for, not that it runs there.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

_WITHOUT_POSIX = """
import mmap, sys
import psutil  # of the viewer's library: it has modules of its own for each system

NAMES = {"fcntl", "resource", "termios", "pwd", "grp", "tty", "pty"}

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name in NAMES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

for name in NAMES:
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Blocked())
for name in ("MAP_SHARED", "MAP_PRIVATE", "PROT_READ", "PROT_WRITE"):
    delattr(mmap, name)
from membrane_ctrl.cli import run
sys.exit(run(sys.argv[1:]))
"""


def run_without_posix(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", _WITHOUT_POSIX, *words],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )


def test_a_simulated_set_is_measured(tmp_path: Path) -> None:
    simulated = run_without_posix(tmp_path, "simulate", "set", "--shrink", "12")
    assert simulated.returncode == 0, simulated.stderr
    measured = run_without_posix(tmp_path, "measure", "set", "--no-pictures")
    assert measured.returncode == 0, measured.stderr


def test_reviewing_commands_start(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    commands = (
        ("runs",),
        ("report", "last"),
        ("review", "last"),
        ("review", "--all"),
        ("config", "explain", "loop"),
    )
    for words in commands:
        done = run_without_posix(tmp_path, *words)
        assert "Traceback" not in done.stderr
        assert "No module" not in done.stderr
