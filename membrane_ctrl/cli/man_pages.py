"""Manual pages (man 7 format) of all commands, made from their help texts."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import typer

from membrane_ctrl import __version__
from membrane_ctrl.model import errors, files

PROGRAM = "membrane-ctrl"
_SECTION = 1
_EXIT_MEANINGS = {
    errors.Exit.DONE: "done",
    errors.Exit.BAD_INPUT: "bad usage, configuration or input",
    errors.Exit.REJECTED: "a measurement that must not be used, or a comparison that failed",
    errors.Exit.DEVICE_FAILED: "a device, port, folder or disk that cannot be used",
    errors.Exit.SAFETY_TRIP: "the safety table stopped the pump",
    errors.Exit.INTERRUPTED: "interrupted",
}
_CODE = re.compile(r"`([^`]+)`")


def write_man_pages(folder: Path, root: Any) -> int:
    """Write a page of each command into a folder; returns the number of pages.

    Parameters
    ----------
    folder : Path
        Made if it is missing; `man` searches folders named `man1` below its path.
    root : Command
        The whole command line (`typer.main.get_command`).

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    pages = dict(make_man_pages(root))
    with errors.convert_write_errors(folder, remedy="; name another folder"):
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in pages.items():
            files.write_text_atomic(folder / f"{name}.{_SECTION}", text)
    return len(pages)


def make_man_pages(root: Any) -> Iterator[tuple[str, str]]:
    """Yield name and text of the page of each command: `membrane-ctrl-runs-show` is that of
    `membrane-ctrl runs show`.
    """
    yield from _make_pages_of(root, (PROGRAM,), None)


def _make_pages_of(command: Any, words: tuple[str, ...], parent: Any) -> Iterator[tuple[str, str]]:
    context = typer.Context(command, info_name=words[-1], parent=parent)
    yield "-".join(words), _make_page(command, words, context)
    for name, sub in _list_commands(command):
        yield from _make_pages_of(sub, (*words, name), context)


def _list_commands(command: Any) -> list[tuple[str, Any]]:
    found = getattr(command, "commands", {})
    return sorted((name, sub) for name, sub in found.items() if not sub.hidden)


def _make_page(command: Any, words: Sequence[str], context: Any) -> str:
    name = "-".join(words)
    # The help text of the command: its first paragraph is the summary.
    paragraphs = [part.replace("\n", " ") for part in (command.help or "").split("\n\n")]
    summary = paragraphs[0].rstrip(".")
    lines = [
        f'.TH {_escape_roff(name.upper())} {_SECTION} "" "{PROGRAM} {__version__}"',
        ".SH NAME",
        f"{_escape_roff(name)} \\- {_format_help(summary)}",
        ".SH SYNOPSIS",
        f".B {_escape_roff(' '.join(words))}",
        _escape_roff(" ".join(command.collect_usage_pieces(context))),
        ".SH DESCRIPTION",
    ]
    for paragraph in paragraphs:
        lines += [".PP", _format_help(paragraph)]
    # Arguments, options and subcommands, as `--help` lists them.
    records: dict[str, list[tuple[str, str]]] = {"argument": [], "option": []}
    for each in command.get_params(context):
        record = each.get_help_record(context)
        if record is not None and not each.hidden:
            records[each.param_type_name].append(record)
    lines += _format_records("ARGUMENTS", records["argument"])
    lines += _format_records("OPTIONS", records["option"])
    subs = _list_commands(command)
    lines += _format_records(
        "COMMANDS",
        [(f"{' '.join(words)} {sub}", each.get_short_help_str(200)) for sub, each in subs],
    )
    # Only the program's own page explains the exit codes.
    if len(words) == 1:
        codes = [(f"{code.value}", meaning) for code, meaning in _EXIT_MEANINGS.items()]
        lines += _format_records("EXIT STATUS", codes)
    # Refer to the subcommands, or from a lowest command to the one above it.
    others = [f"{name}-{sub}" for sub, _ in subs] or ["-".join(words[:-1])]
    references = ", ".join(f"\\fB{_escape_roff(other)}\\fP({_SECTION})" for other in others)
    lines += [".SH SEE ALSO", references]
    return "\n".join(lines) + "\n"


def _format_records(title: str, records: Sequence[tuple[str, str]]) -> list[str]:
    """A section of terms and their meanings; nothing without any."""
    if not records:
        return []
    lines = [f".SH {title}"]
    for term, meaning in records:
        lines += [".TP", f"\\fB{_escape_roff(term)}\\fP", _format_help(meaning)]
    return lines


def _format_help(text: str) -> str:
    """A help text in roff: code of Markdown becomes bold."""
    return _CODE.sub(r"\\fB\1\\fP", _escape_roff(text))


def _escape_roff(text: str) -> str:
    """Text in which roff finds no request and no escape."""
    escaped = text.replace("\\", "\\e").replace("-", "\\-")
    if not escaped.startswith((".", "'")):
        return escaped
    return f"\\&{escaped}"
