"""The manual pages: one for each command, with its options, and without errors of roff."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import typer

from membrane_ctrl import cli
from membrane_ctrl.cli import man_pages


@pytest.fixture(scope="module")
def root() -> Any:
    cli.add_all_commands()
    return typer.main.get_command(cli.app)


def list_commands(command: Any, words: tuple[str, ...] = ("membrane-ctrl",)) -> dict[str, Any]:
    found = {"-".join(words): command}
    for name, sub in getattr(command, "commands", {}).items():
        if not sub.hidden:
            found |= list_commands(sub, (*words, name))
    return found


def test_every_command_has_a_page_with_every_option(root: Any) -> None:
    pages, commands = dict(man_pages.make_man_pages(root)), list_commands(root)
    assert pages.keys() == commands.keys()
    assert {"membrane-ctrl-runs-show", "membrane-ctrl-ctl-setpoint"} < pages.keys()
    for name, command in commands.items():
        plain = pages[name].replace("\\-", "-")
        for parameter in command.params:
            if parameter.param_type_name == "option" and not parameter.hidden:
                assert parameter.opts[0] in plain, f"{name}: {parameter.opts[0]}"
            if parameter.hidden:
                assert parameter.opts[0] not in plain


def test_a_text_that_looks_like_a_request_stays_text() -> None:
    made = man_pages._format_help(".TH is `a-b` with a \\")
    assert made == "\\&.TH is \\fBa\\-b\\fP with a \\e"


@pytest.mark.skipif(shutil.which("groff") is None, reason="groff is not installed")
def test_groff_finds_no_fault_in_the_pages(tmp_path: Path) -> None:
    assert cli.run(["man", str(tmp_path)]) == 0
    pages = sorted(tmp_path.glob("*.1"))
    done = subprocess.run(
        ["groff", "-man", "-Tutf8", "-k", "-ww", *map(str, pages)],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == ""
    assert "Stop after this long, e.g. 90s, 3m, 2h30m." in done.stdout


def test_a_folder_that_cannot_be_written_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    assert cli.run(["man", str(tmp_path / "file" / "man1")]) == 2
    assert "cannot be written (not a directory); name another folder" in capsys.readouterr().err


def test_every_parameter_of_every_command_is_documented(root: Any) -> None:
    undocumented = [
        f"{name}: {parameter.name}"
        for name, command in list_commands(root).items()
        for parameter in command.params
        if not parameter.hidden and parameter.name != "help" and not parameter.help
    ]
    assert not undocumented
