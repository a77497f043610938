"""The command line as a whole: what it loads, and how unforeseen errors end."""

from __future__ import annotations

import subprocess
import sys

import pytest

from membrane_ctrl import cli
from membrane_ctrl.model.errors import Exit

HEAVY = ("control", "cv2", "matplotlib", "numba", "pyarrow", "rerun", "scipy")  # 0.1 s to 1 s of importing each


def loaded(code: str) -> set[str]:
    """The heavy libraries that a new process has loaded after some code."""
    shown = f"import sys\n{code}\nprint(*(name for name in {HEAVY!r} if name in sys.modules))"
    return set(
        subprocess.run([sys.executable, "-c", shown], capture_output=True, text=True, check=True).stdout.split()
    )


def test_the_command_line_loads_no_heavy_library() -> None:
    assert loaded("import membrane_ctrl.cli") == set()


@pytest.mark.parametrize("words", [["ctl", "status"], ["runs"], ["safe", "absent.toml"]], ids=" ".join)
def test_the_quick_commands_load_what_they_need_alone(words: list[str]) -> None:
    code = "import contextlib, io\nfrom membrane_ctrl.cli import run\n"
    code += f"with contextlib.redirect_stdout(io.StringIO()):\n    run({words})"
    assert loaded(code) <= {"pyarrow"}


def test_hold_says_what_it_does_before_it_loads_the_control_program() -> None:
    code = "from membrane_ctrl.model import terminal\nfrom membrane_ctrl.cli import run\n"
    code += "terminal.progress = lambda words: sys.exit(str('membrane_ctrl.hold' in sys.modules))\n"
    code += "run(['hold', '--twin'])"
    said = subprocess.run([sys.executable, "-c", f"import sys\n{code}"], capture_output=True, text=True, check=False)
    assert said.stderr == "False\n"


def test_a_file_error_that_no_command_foresaw_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> int:
        raise OSError(28, "No space left on device", "some/file")

    monkeypatch.setattr("membrane_ctrl.commissioning.devices.list_devices", full)
    assert cli.run(["devices"]) == Exit.DEVICE_FAILED
    assert capsys.readouterr().err == (
        "membrane-ctrl: some/file: no space left on device; "
        "check that it exists, its permissions and the free disk space\n"
    )
