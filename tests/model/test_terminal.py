"""Control bytes of foreign texts do not reach a terminal, and JSON stays JSON."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import pytest
from rich.table import Table
from rich.text import Text

from membrane_ctrl.cli import run
from membrane_ctrl.model.terminal import (
    Plain,
    escape_controls,
    live_line,
    one_line,
    only_text,
    table_console,
    track_progress,
)

# title, bell, carriage return, backspace, C1 of one byte, a line drawn backwards, an invisible tag,
# half a pair, NUL
HOSTILE = "a\x1b]0;owned\x07\r\b\x9b2J\u202ebad\u2066\U000e0041\ud800\u2028\x00\x7fz"
ESCAPED = "a\\u001b]0;owned\\u0007\\u000d\\u0008\\u009b2J\\u202ebad\\u2066\\udb40\\udc41\\ud800\\u2028\\u0000\\u007fz"  # noqa: E501


class Terminal(io.StringIO):
    """A terminal that keeps what it is sent."""

    encoding = "utf-8"

    def isatty(self) -> bool:
        return True


def test_control_characters_become_their_escapes_and_text_stays_text() -> None:
    assert escape_controls(HOSTILE) == ESCAPED
    assert escape_controls("µm, 3 °C\n\tänd – ok\n") == "µm, 3 °C\n\tänd – ok\n"
    assert one_line("a\nb") == "a b"


def test_json_that_is_printed_keeps_its_meaning(capsys: pytest.CaptureFixture[str]) -> None:
    with only_text():
        print(json.dumps({"text": HOSTILE}, ensure_ascii=False))
    printed = capsys.readouterr().out
    assert json.loads(printed) == {"text": HOSTILE}
    assert printed.removesuffix("\n").isprintable()


def test_both_streams_are_wrapped_and_restored(capsys: pytest.CaptureFixture[str]) -> None:
    before = sys.stdout, sys.stderr
    with only_text():
        print(HOSTILE, end="")
        print(HOSTILE, end="", file=sys.stderr)
        sys.stdout.writelines([HOSTILE])
    assert (sys.stdout, sys.stderr) == before
    assert capsys.readouterr() == (ESCAPED * 2, ESCAPED)


def test_a_table_keeps_its_colours_and_escapes_its_cells(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stdout", terminal)
    monkeypatch.setenv("TERM", "xterm")
    table = Table("name", header_style="bold", box=None)
    table.add_row(Text(HOSTILE))
    with only_text():
        table_console(width=200).print(table)
    sent = terminal.getvalue()
    assert "\x1b[1mname" in sent
    for letter in ("\x1b]", "\x9b", "\x07", "\r", "\b", "\u202e"):
        assert letter not in sent
    assert "\\u001b]0;owned" in sent


def test_a_bar_is_drawn_while_items_are_taken_and_lines_beside_it_stay_text(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with only_text():
        for number in track_progress(iter(range(3)), "sets", 3):
            print(one_line(f"{number}{HOSTILE}"), file=sys.stderr)
    sent = terminal.getvalue()
    assert "\x1b[2K" in sent  # the bar moves the cursor
    assert "\\u001b[2K" not in sent
    for letter in ("\x1b]", "\x9b", "\x07", "\b", "\u202e"):
        assert letter not in sent


def test_a_live_line_replaces_itself_and_its_text_moves_no_cursor(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with only_text():
        live_line(f"1 of 2{HOSTILE}")
        live_line("done", "\n")
    assert terminal.getvalue() == f"\r\x1b[K1 of 2{one_line(HOSTILE)}\r\x1b[Kdone\n"


def test_without_a_terminal_there_is_no_bar(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(track_progress([1, 2], "sets")) == [1, 2]
    assert capsys.readouterr() == ("", "")


def test_the_output_of_a_live_screen_is_filtered_too() -> None:
    console = table_console(width=200)
    drawn = "".join(
        segment.text for segment in console.render(Plain(Text(HOSTILE))) if not segment.control
    )
    assert "\x1b" not in drawn
    assert "\\u001b]0;owned" in drawn


def test_an_error_is_one_line_without_control_bytes(capsys: pytest.CaptureFixture[str]) -> None:
    name = "no\x1b[31msuch\nrun\u202e"
    assert run(["report", name]) == 2
    output = capsys.readouterr().err
    assert output.count("\n") == 1
    assert output.removesuffix("\n").isprintable()
    assert "no\\u001b[31msuch run" in output


def test_the_help_text_is_unchanged(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["repair", "--help"]) == 0
    assert "--in-place" in capsys.readouterr().out


def test_no_other_module_creates_a_console() -> None:
    """Rich writes past the edge: every console has to be of `table_console`, or draw no text of
    others.
    """
    root = Path(__file__).parents[2] / "membrane_ctrl"
    makers = {
        str(path.relative_to(root))
        for path in root.rglob("*.py")
        if " Console(" in path.read_text("utf-8")
    }
    # two bars that count, and the screen, whose text goes through `Plain`
    allowed = {
        "model/terminal.py",
        "measure/uncertainty.py",
        "measure/stability.py",
        "console/process.py",
    }
    assert makers <= allowed
