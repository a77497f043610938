"""Simulation and measurement run without the POSIX modules and flags that Windows and macOS lack.

They run on Linux with these blocked: that shows what the program asks for, not that it runs there.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

_WITHOUT_POSIX = """
import json, mmap, sys
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
for words in json.loads(sys.argv[1]):
    code = run(words)
sys.exit(code)
"""


def run_without_posix(folder: Path, *commands: str) -> subprocess.CompletedProcess[str]:
    """Run commands one after the other in one program, which ends as the last one does."""
    words = json.dumps([command.split() for command in commands])
    return subprocess.run(
        [sys.executable, "-c", _WITHOUT_POSIX, words],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )


def test_a_simulated_set_is_measured(tmp_path: Path) -> None:
    done = run_without_posix(tmp_path, "simulate set --shrink 12", "measure set --no-pictures")
    assert done.returncode == 0, done.stderr


def test_reviewing_commands_start(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    done = run_without_posix(
        tmp_path, "runs", "report last", "review last", "review --all", "config explain loop"
    )
    assert "Traceback" not in done.stderr
    assert "No module" not in done.stderr
    assert done.stdout.count("[loop]") == 1  # the last one, so all were run
