"""The command line: one thin function per command; errors end in one line and an exit code
(docs/reference/interfaces.md).
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from membrane_ctrl.cli import calibrating, ctl, holding, optics, reviewing
from membrane_ctrl.model import errors, program, terminal

# Markdown, because Rich's own markup takes [devices] in a help text for a style
app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)


def run(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code; print an expected failure on stderr, one line per
    finding.
    """
    with terminal.only_text():
        try:
            _complete(arguments[0] if arguments else "")
            result = app(list(arguments), prog_name="membrane-ctrl", standalone_mode=False)
        except errors.CommandError as error:
            for line in error.lines:
                print(f"membrane-ctrl: {terminal.one_line(line)}", file=sys.stderr)
            return error.exit
        except typer.TyperException as error:
            if (
                message := error.format_message()
            ):  # a group without a command has printed its help instead
                print(f"membrane-ctrl: {terminal.one_line(message)} (see --help)", file=sys.stderr)
            return errors.Exit.BAD_INPUT
        except OSError as error:  # a file error that the command itself should have caught
            print(f"membrane-ctrl: {terminal.one_line(_file_trouble(error))}", file=sys.stderr)
            return errors.Exit.DEVICE_FAILED
        except (KeyboardInterrupt, typer.Abort):
            print("membrane-ctrl: interrupted", file=sys.stderr)
            return errors.Exit.INTERRUPTED
        return int(result or 0)


def _complete(word: str) -> None:
    """Add what takes long to find, if `word` may mean it: the actions of `ctl`, the commands of
    other packages.
    """
    names = {group.name for group in app.registered_groups}
    if word == "ctl":
        ctl.add_actions()
    elif word not in names | {
        each.name or getattr(each.callback, "__name__", "") for each in app.registered_commands
    }:
        from importlib.metadata import entry_points

        for entry in entry_points(
            group="membrane_ctrl.subcommands"
        ):  # tuning imports this package, not the reverse
            if entry.name not in names:
                app.add_typer(entry.load(), name=entry.name)


def _file_trouble(error: OSError) -> str:
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
    name: Annotated[str, typer.Argument(help="File to print; by default, list them.")] = "",
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
                f"{path.read_text(encoding='utf-8').partition(chr(10))[0].lstrip('# ')}"
            )
    elif name in files:
        print(files[name].read_text(encoding="utf-8"), end="")
    else:
        raise errors.InputError(f"{name}: no such example; known: {', '.join(files)}")


for _family in (holding, optics, calibrating, reviewing):
    _family.add_commands(app)
