"""Each command that needs a library of an extra names it in one line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

# a program in which some libraries cannot be imported, as in an installation without extras
WITHOUT = """
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {libraries!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

import importlib.util
found = importlib.util.find_spec
importlib.util.find_spec = lambda name, *rest: (
    None if name.split(".")[0] in {libraries!r} else found(name, *rest)
)
sys.meta_path.insert(0, Absent())
from membrane_ctrl.cli import run
sys.exit(run({words!r}))
"""
EXTRAS = ("nicegui", "fastapi", "starlette", "h5py", "distributed", "apprise")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["serve"], "`serve` needs nicegui: pip install 'membrane-ctrl[web]'"),
        (
            ["tune", "explore", "absent"],
            "`tune explore` needs nicegui: pip install 'membrane-ctrl[web]'",
        ),
        (
            ["measure", "frames.h5"],
            "frames.h5, a SOFAST file, needs h5py: pip install 'membrane-ctrl[sofast]'",
        ),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_a_missing_extra_is_named_in_one_line(
    words: list[str], expected: str, tmp_path: Path
) -> None:
    (tmp_path / "frames.h5").touch()
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT.format(libraries=EXTRAS, words=words)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (2, f"membrane-ctrl: {expected}\n")
