"""The command line as a whole: what it loads, and how unforeseen errors end."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from membrane_ctrl import cli
from membrane_ctrl.model.errors import Exit

HEAVY = (
    "control",
    "cv2",
    "matplotlib",
    "numba",
    "pyarrow",
    "rerun",
    "scipy",
)  # 0.1 s to 1 s of importing each


def loaded(code: str) -> set[str]:
    """The heavy libraries that a new process has loaded after some code."""
    shown = f"import sys\n{code}\nprint(*(name for name in {HEAVY!r} if name in sys.modules))"
    return set(
        subprocess.run(
            [sys.executable, "-c", shown], capture_output=True, text=True, check=True
        ).stdout.split()
    )


def test_the_command_line_loads_no_heavy_library() -> None:
    assert loaded("import membrane_ctrl.cli") == set()


@pytest.mark.parametrize(
    "words", [["ctl", "status"], ["runs"], ["safe", "absent.toml"], ["twin", "play"]], ids=" ".join
)
def test_the_quick_commands_load_what_they_need_alone(words: list[str]) -> None:
    code = "import contextlib, io\nfrom membrane_ctrl.cli import run\n"
    code += f"with contextlib.redirect_stdout(io.StringIO()):\n    run({words})"
    assert loaded(code) <= {"pyarrow"}


def test_hold_prints_its_first_line_before_it_loads_the_control_program() -> None:
    code = "from membrane_ctrl.model import terminal\nfrom membrane_ctrl.cli import run\n"
    code += "terminal.print_progress = "
    code += "lambda words: sys.exit(str('membrane_ctrl.hold' in sys.modules))\n"
    code += "run(['hold', '--twin'])"
    finished = subprocess.run(
        [sys.executable, "-c", f"import sys\n{code}"], capture_output=True, text=True, check=False
    )
    assert finished.stderr == "False\n"


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


@pytest.mark.parametrize("words", [[], ["config"], ["ctl"], ["alarm"], ["tune"]], ids=" ".join)
def test_a_group_without_a_command_prints_its_help(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(words) == Exit.BAD_INPUT
    printed = capsys.readouterr()
    assert "Usage: membrane-ctrl" in printed.out
    assert printed.err == ""


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["holdd"], "Did you mean 'hold'?"),
        (["ctl", "statsu"], "Did you mean 'status'?"),
        (["tnue"], "'tune'"),
    ],
    ids=str,
)
def test_a_misspelt_command_gets_a_suggestion(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(words) == Exit.BAD_INPUT
    assert message in capsys.readouterr().err


def test_a_package_that_cannot_be_imported_takes_away_its_own_command_only(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = EntryPoint("paint", "absent_package.cli:app", "membrane_ctrl.subcommands")
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [broken])
    assert cli.run(["--version"]) == Exit.DONE
    assert cli.run(["paint"]) == Exit.BAD_INPUT
    assert "paint: its package cannot be imported (No module" in capsys.readouterr().err


def test_help_loads_no_configuration() -> None:
    commands = [
        ["--help"],
        *([name, "--help"] for name in ("hold", "safe", "check", "config", "measure", "runs")),
    ]
    code = "import contextlib, io, sys\nfrom membrane_ctrl.cli import run\n"
    code += "with contextlib.redirect_stdout(io.StringIO()):\n"
    code += f"    assert [run(words) for words in {commands}] == {[0] * len(commands)}\n"
    code += "assert not {'membrane_ctrl.config.schema', 'numpy', 'asyncio'} & set(sys.modules)"
    assert loaded(code) == set()


def test_square_brackets_stay(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["hold", "--help"]) == 0
    assert "[devices]" in capsys.readouterr().out
    path = tmp_path / "[loop].toml"
    path.write_text("[shape]\nenabled = false\n")
    assert cli.run(["check", str(path)]) == 0
    assert "[loop].toml" in "".join(capsys.readouterr().out.split("\n"))


def test_a_folder_of_runs_that_cannot_be_written_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "runs").write_text("a file")
    assert (
        cli.run(["hold", "--twin", "--duration", "1s", "--logs", str(tmp_path / "runs")])
        == Exit.DEVICE_FAILED
    )
    assert f"{tmp_path / 'runs'}: cannot be written" in capsys.readouterr().err


def test_check_finds_an_absent_group(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "lab.toml").write_text("[port]\ngroup = 'nobody-has-this'\n")
    assert cli.run(["check", str(tmp_path / "lab.toml")]) == Exit.BAD_INPUT
    assert "no group 'nobody-has-this' on this machine; create it" in capsys.readouterr().err


def test_a_setting_that_only_its_driver_refuses_is_named_with_its_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    link = 'driver = "modbus_map"\nlink = "tcp://127.0.0.1:1"\nvalue = [0.0, 1.0]\n'  # no raw
    path = tmp_path / "lab.toml"
    roles = enumerate(("displacement", "gauge_pressure", "pump"))
    path.write_text(
        "".join(f"[devices.{role}]\n{link}address = {address}\n" for address, role in roles)
    )
    assert cli.run(["safe", str(path)]) == Exit.BAD_INPUT
    assert re.fullmatch(
        rf"membrane-ctrl: {path}: devices\.\w+: raw is missing.*\n", capsys.readouterr().err
    )
