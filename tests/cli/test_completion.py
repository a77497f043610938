"""Completion in the shell, by the variables with which the installed scripts call the program."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from membrane_ctrl import cli


def complete(words: str, folder: Path) -> list[str]:
    """What Bash offers for the last word of a command line, which is empty after a space."""
    environment = os.environ | {
        "_MEMBRANE_CTRL_COMPLETE": "complete_bash",
        "COMP_WORDS": words,
        "COMP_CWORD": str(len(words.split()) - (not words.endswith(" "))),
    }
    done = subprocess.run(
        [sys.executable, "-m", "membrane_ctrl"],
        env=environment,
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    assert not done.stderr
    return done.stdout.split()


@pytest.mark.fast_cases(
    "membrane-ctrl ho-expected0",
    "membrane-ctrl twin play laser_k-expected4",
    "membrane-ctrl check lab-expected6",
)
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("membrane-ctrl ho", ["hold"]),
        ("membrane-ctrl tu", ["tune"]),  # a command of another package
        ("membrane-ctrl ctl setp", ["setpoint"]),  # from the controller's table
        ("membrane-ctrl hold --st", ["--standby"]),
        ("membrane-ctrl twin play laser_k", ["laser_knocked"]),
        ("membrane-ctrl examples paper", ["paper-bench.toml"]),
        ("membrane-ctrl check lab", []),  # the shell completes a path
    ],
)
def test_words_are_completed(words: str, expected: list[str], tmp_path: Path) -> None:
    assert complete(words, tmp_path) == expected


def test_runs_are_completed_from_the_folder_that_is_named(tmp_path: Path) -> None:
    for folder, name in (("logs", "20261120T180000Z-here"), ("other", "20261121T180000Z-there")):
        (tmp_path / folder / name).mkdir(parents=True)
        (tmp_path / folder / name / "events.jsonl").touch()
    assert complete("membrane-ctrl report ", tmp_path) == ["last", "20261120T180000Z-here"]
    named = "membrane-ctrl runs --logs other show 2026"
    assert complete(named, tmp_path) == ["20261121T180000Z-there"]
    assert complete("membrane-ctrl runs show --logs absent 2026", tmp_path) == []


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_is_installed_for_the_shell_in_use(
    shell: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr("typer._completion_shared._get_shell_name", lambda: shell)
    with pytest.raises(SystemExit) as ended:
        cli.run(["--install-completion"])
    assert ended.value.code in (0, None)
    assert f"{shell} completion installed" in capsys.readouterr().out
    written = "".join(path.read_text() for path in tmp_path.rglob("*") if path.is_file())
    assert "_MEMBRANE_CTRL_COMPLETE" in written
