"""A copy of the product's source in which one fact is changed, and programs that run from it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[3]
PACKAGES = ("membrane_ctrl", "firmware_iface", "tuning")


@dataclass(frozen=True, slots=True)
class ChangedSource:
    """A folder with the packages of the product.

    Attributes
    ----------
    folder : Path
        Parent of the packages.
    """

    folder: Path

    @classmethod
    def copy_to(cls, folder: Path) -> ChangedSource:
        """Copy the packages, without anything compiled."""
        for name in PACKAGES:
            shutil.copytree(
                ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__")
            )
        return cls(folder)

    def copy_more(self, *names: str) -> None:
        """Copy further folders of the repository: tests, or documents that programs write."""
        for name in names:
            shutil.copytree(
                ROOT / name, self.folder / name, ignore=shutil.ignore_patterns("__pycache__")
            )

    def replace(self, path: str, old: str, new: str) -> None:
        """Replace a text that occurs exactly once in a file; `path` is relative to the folder."""
        file = self.folder / path
        text = file.read_text(encoding="utf-8")
        assert text.count(old) == 1, f"{path}: {old!r} occurs {text.count(old)} times"
        file.write_text(text.replace(old, new), encoding="utf-8")

    def run_python(self, *words: object) -> str:
        """Run the interpreter on the changed source; returns its standard output. Fails unless it
        ends with 0.
        """
        environment = os.environ | {"PYTHONPATH": str(self.folder)}
        environment.pop("NUMBA_CACHE_DIR", None)  # compiled code stays in the copy
        command = [sys.executable, *(str(word) for word in words)]
        done = subprocess.run(
            command, cwd=self.folder, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
        return done.stdout

    def run_program(self, *words: object) -> str:
        """Run `membrane-ctrl` of the changed source, as `run_python`."""
        return self.run_python("-m", "membrane_ctrl", *words)
