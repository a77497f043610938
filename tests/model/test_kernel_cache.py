"""Compiled code where it can be stored, and where it cannot: commands run, with one note."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import membrane_ctrl
from membrane_ctrl.model import kernel_cache
from membrane_ctrl.model.account import account_name

PACKAGE = Path(membrane_ctrl.__file__).parent
# mkdir fails there, for root as well
UNWRITABLE = "/proc/none"


@pytest.fixture(autouse=True)
def _asked_again(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.delenv("MEMBRANE_CTRL_CACHE_NOTED", raising=False)
    kernel_cache.has_folder.cache_clear()
    yield
    kernel_cache.has_folder.cache_clear()


def double(x: float) -> float:
    return 2.0 * x


def test_code_is_stored_in_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "new"))
    assert kernel_cache.has_folder()
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("folder", [UNWRITABLE, None])
def test_without_a_folder_code_runs_with_one_note(
    folder: str | None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if folder is None:
        monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    else:
        monkeypatch.setenv("NUMBA_CACHE_DIR", folder)
    for _ in range(2):
        assert kernel_cache.compile_loop(nogil=True)(double)(1.5) == 3.0
    note = capsys.readouterr().err
    assert note.count("\n") == 1
    assert "each start compiles it" in note
    assert "NUMBA_CACHE_DIR" in note


def test_a_disk_that_fills_up_costs_time_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*arguments: object) -> None:
        raise OSError(28, "No space left on device", "/cache/x.nbi")

    from numba.core import caching

    monkeypatch.setattr(caching.Cache, "save_overload", refuse)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert kernel_cache.compile_loop()(double)(1.5) == 3.0
    assert "No space left on device" in capsys.readouterr().err


def test_no_other_module_enables_the_cache_of_numba() -> None:
    asking = {
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.rglob("*.py")
        if "numba import" in (text := path.read_text(encoding="utf-8")) or "import numba" in text
    }
    assert asking == {"model/kernel_cache.py"}


def test_a_command_runs_without_home_or_account(tmp_path: Path) -> None:
    """Neither a home that can be written nor a name for the user id."""
    program = (
        "import getpass, sys\n"
        "def nameless(): raise KeyError('getpwuid(): uid not found: 4711')\n"
        "getpass.getuser = nameless\n"
        "from membrane_ctrl.model.account import account_name\n"
        "assert account_name().isdigit()\n"
        "from membrane_ctrl.metrology.numerics.grouped_sums import sum_by_group\n"
        "from membrane_ctrl.sim.optics.film_terms import height_and_slopes\n"
    )
    environment = {
        "PATH": os.environ["PATH"],
        "HOME": UNWRITABLE,
        "PYTHONPATH": str(PACKAGE.parent),
    }
    done = subprocess.run(
        [sys.executable, "-B", "-c", program],
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_the_account_is_named() -> None:
    assert account_name()
