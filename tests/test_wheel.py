"""The wheel: what it ships, and that nothing is left of it once it is uninstalled."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

from membrane_ctrl import __version__

ROOT = Path(__file__).parents[1]
COMMIT = "0123456789ab" + 28 * "c"
PACKAGES = ("membrane_ctrl", "firmware_iface", "tuning")
_BUILD = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"
_KERNEL = """
import numpy as np
from membrane_ctrl.review.statistics.allan_deviation import allan_deviation
allan_deviation(np.arange(100.0), 1.0)
"""
# what a user writes: mypy must find our types, and take them seriously
_PROGRAM = """
from firmware_iface.roles import Pump
from membrane_ctrl.review import open_run
from tuning.gains_file import load_gains

duration_s: str = open_run("logs/last").utc(0.0)
"""


def run(*words: object, cwd: Path, **environment: str) -> str:
    """Output of a command that succeeds, in an environment that knows neither the sources nor their
    kernels.
    """
    clean = {
        name: value
        for name, value in os.environ.items()
        if name not in ("PYTHONPATH", "NUMBA_CACHE_DIR")
    }
    done = subprocess.run(
        [str(word) for word in words],
        cwd=cwd,
        env=clean | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built offline, from a copy of the sources: what an earlier build left in the checkout does
    not count.
    """
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in (*PACKAGES, "tests", "benchmarks", "logs"):
        shutil.copytree(
            ROOT / name,
            source / name,
            ignore=shutil.ignore_patterns("__pycache__", "*Z-*", "*.sock"),
        )
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    (source / ".git" / "refs").mkdir(parents=True)
    (source / ".git" / "HEAD").write_text(f"{COMMIT}\n")
    run(sys.executable, "-c", _BUILD, out, cwd=source)
    (path,) = out.glob("*.whl")
    return path


class Installed:
    """The wheel in a virtual environment, which takes what it depends on from this one."""

    def __init__(self, folder: Path, wheel: Path) -> None:
        self.folder = folder
        run(sys.executable, "-m", "venv", "--without-pip", folder / "venv", cwd=folder)
        self.python = folder / "venv" / "bin" / "python"
        (site,) = (folder / "venv").glob("lib/*/site-packages")
        (site / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
        self.empty = folder / "empty"
        self.empty.mkdir()
        self.before = self.files()
        self.pip(
            "install",
            "--quiet",
            "--no-index",
            "--no-deps",
            "--no-compile",
            "--ignore-installed",
            wheel,
        )

    def pip(self, *words: object) -> None:
        run(sys.executable, "-m", "pip", "--python", self.python, *words, cwd=self.folder)

    def command(self, *words: str) -> str:
        return run(self.python.with_name("membrane-ctrl"), *words, cwd=self.empty)

    def files(self) -> set[Path]:
        return set((self.folder / "venv").rglob("*"))


@pytest.fixture
def installed(wheel: Path, tmp_path: Path) -> Installed:
    return Installed(tmp_path, wheel)


def test_the_wheel_holds_the_packages_with_their_data_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    sources = [
        path for package in PACKAGES for path in (ROOT / package).rglob("*") if path.is_file()
    ]
    expected = {
        path.relative_to(ROOT).as_posix() for path in sources if "__pycache__" not in path.parts
    }
    assert names == expected | {"membrane_ctrl/build_commit.txt"}
    assert {f"{package}/py.typed" for package in PACKAGES} < names


def test_an_installed_copy_runs_and_leaves_nothing_behind(installed: Installed) -> None:
    assert installed.command("--version").strip() == f"membrane-ctrl {__version__} (0123456789ab)"
    (installed.empty / "twin.toml").write_text(installed.command("examples", "twin.toml"))
    assert "twin.toml" in installed.command("check", "twin.toml")
    run(
        installed.python,
        "-c",
        _KERNEL,
        cwd=installed.empty,
        XDG_CACHE_HOME=str(installed.folder / "caches"),
    )
    assert list(installed.folder.glob("caches/membrane-ctrl/*/*.nbi"))
    installed.pip("uninstall", "--quiet", "--yes", "membrane-ctrl")
    assert installed.files() == installed.before


@pytest.mark.campaign
def test_a_hold_of_an_installed_copy_leaves_nothing_behind(installed: Installed) -> None:
    installed.command("hold", "--twin", "--standby", "--duration", "5s", "--name", "short")
    assert [path.name for path in installed.empty.iterdir()] == ["logs"]
    installed.pip("uninstall", "--quiet", "--yes", "membrane-ctrl")
    assert installed.files() == installed.before


@pytest.mark.campaign
def test_an_outside_program_has_the_types(installed: Installed) -> None:
    (installed.empty / "program.py").write_text(_PROGRAM)
    (installed.empty / "mypy.ini").write_text("[mypy]\nfollow_imports = silent\n")
    words = ["-m", "mypy", "--strict", "--python-executable", str(installed.python), "program.py"]
    done = subprocess.run(
        [sys.executable, *words], cwd=installed.empty, capture_output=True, text=True, check=False
    )
    assert done.stdout.splitlines()[:-1] == [
        "program.py:6: error: Incompatible types in assignment "
        '(expression has type "datetime", variable has type "str")  [assignment]'
    ]
