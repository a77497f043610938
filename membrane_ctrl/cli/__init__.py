"""The command line: one thin function per command; errors end in one line and an exit code
(docs/reference/interfaces.md).

A command's docstring is its help and its manual page. Its parameters are documented once, by the
`help` of their annotations, which `--help`, manual pages and a reader of the code all see; so the
docstrings have no section for them. Every command returns its exit code (`errors.Exit`) and raises
`errors.CommandError` kinds, which `run` prints.
"""

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from membrane_ctrl.cli import calibrating, configuring, ctl, holding, optics, reviewing
from membrane_ctrl.cli.completion import complete_example
from membrane_ctrl.model import errors, program, terminal

# a shell asks for completions with this variable set (Typer)
_COMPLETION_VARIABLE = "_MEMBRANE_CTRL_COMPLETE"

# Markdown, because Rich's own markup takes [devices] in a help text for a style
app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)


def run(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code; print an expected failure on stderr, one line per
    finding.
    """
    # Typer does not end the process itself (`standalone_mode=False`): every way out of a command
    # becomes an exit code here, so that scripts can rely on it.
    with terminal.only_text():
        try:
            if os.environ.get(_COMPLETION_VARIABLE):  # the words are in another variable
                add_all_commands()
            else:
                _add_commands_for(arguments[0] if arguments else "")
            result = app(list(arguments), prog_name="membrane-ctrl", standalone_mode=False)
        except errors.CommandError as error:
            for line in error.lines:
                print(f"membrane-ctrl: {terminal.one_line(line)}", file=sys.stderr)
            return error.exit
        except typer.TyperException as error:
            # a group without a command has printed its help instead
            if message := error.format_message():
                print(f"membrane-ctrl: {terminal.one_line(message)} (see --help)", file=sys.stderr)
            return errors.Exit.BAD_INPUT
        except OSError as error:  # a file error that the command itself should have caught
            print(
                f"membrane-ctrl: {terminal.one_line(_explain_file_error(error))}", file=sys.stderr
            )
            return errors.Exit.DEVICE_FAILED
        except (KeyboardInterrupt, typer.Abort):
            print("membrane-ctrl: interrupted", file=sys.stderr)
            return errors.Exit.INTERRUPTED
        return int(result or 0)


def add_all_commands() -> None:
    """Add the commands that take long to find: for completion and for the manual pages."""
    ctl.add_actions()
    _add_commands_of_packages()


def _add_commands_for(word: str) -> None:
    """Add the commands that take long to find if `word`, the first of the command line, may name
    one of them.
    """
    groups = {group.name for group in app.registered_groups}
    commands = {
        each.name or getattr(each.callback, "__name__", "") for each in app.registered_commands
    }
    if word == "ctl":
        ctl.add_actions()
    elif word not in groups | commands:
        _add_commands_of_packages(word)


def _add_commands_of_packages(word: str = "") -> None:
    """Add the commands of packages that import this one, such as `tune`.

    A package that cannot be imported takes away its own command only. Raises InputError if that is
    `word`.
    """
    from importlib.metadata import entry_points

    groups = {group.name for group in app.registered_groups}
    for entry in entry_points(group="membrane_ctrl.subcommands"):
        if entry.name in groups:
            continue
        try:
            app.add_typer(entry.load(), name=entry.name)
        except ImportError as error:
            if entry.name == word:
                raise errors.InputError(
                    f"{word}: its package cannot be imported ({error}); install it again"
                ) from None


def _explain_file_error(error: OSError) -> str:
    where = error.filename or "a file or connection"
    return (
        f"{where}: {errors.os_reason(error)}; check that it exists, its permissions and the free "
        "disk space"
    )


@app.callback(invoke_without_command=True)
def top(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Hold a pneumatic membrane mirror to the micrometre and measure its figure meanwhile."""
    if version:
        print(program.program_identity())
        raise typer.Exit


@app.command()
def examples(
    name: Annotated[
        str,
        typer.Argument(
            help="File to print; by default, list them.", autocompletion=complete_example
        ),
    ] = "",
) -> None:
    """Print an example configuration or the service's unit: `membrane-ctrl examples
    paper-bench.toml > lab.toml`.
    """
    folder = Path(__file__).parents[1] / "examples"
    files = {path.name: path for path in sorted(folder.iterdir())}
    if not name:
        for path in files.values():
            print(
                f"{path.name:22} "
                f"{path.read_text(encoding='utf-8').partition(chr(10))[0].lstrip('#/ ')}"
            )
    elif name in files:
        print(files[name].read_text(encoding="utf-8"), end="")
    else:
        raise errors.InputError(f"{name}: no such example; known: {', '.join(files)}")


@app.command()
def man(
    folder: Annotated[
        Path | None,
        typer.Argument(
            metavar="FOLDER", help="Folder for the pages; by default, that of this installation."
        ),
    ] = None,
) -> None:
    """Write a manual page of each command: `man membrane-ctrl-hold` then shows that of `hold`."""
    from membrane_ctrl.cli.man_pages import write_man_pages

    add_all_commands()
    folder = folder or Path(sys.prefix) / "share" / "man" / "man1"
    count = write_man_pages(folder, typer.main.get_command(app))
    print(f"{folder}: {count} pages; `man membrane-ctrl` shows the first", file=sys.stderr)


for _family in (holding, configuring, optics, calibrating, reviewing):
    _family.add_commands(app)
