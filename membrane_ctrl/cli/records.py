"""The commands that work on recorded inputs: replay and repair."""

import contextlib
from collections.abc import Iterator
from typing import Annotated

import typer

from membrane_ctrl.cli.options import FromOption, JsonOption, RunArgument, ToOption
from membrane_ctrl.model import errors


def add_commands(app: typer.Typer) -> None:
    """Add `replay`, `repair`."""
    app.command()(replay)
    app.command()(repair)


def replay(
    run_dir: RunArgument,
    start: FromOption = None,
    end: ToOption = None,
    to_test: Annotated[str | None, typer.Option(help="Write a regression test to tests/incidents/NAME.")] = None,
    json: JsonOption = False,
) -> int:
    """Replay a run's inputs through today's control code and report differences (exit 3)."""
    from membrane_ctrl.replay.command import replay_command
    from membrane_ctrl.review import catalogue, words
    from membrane_ctrl.run_files.run import open_run

    with _files_of_the_run():
        folder = catalogue.resolve(run_dir)
        from_s, to_s = words.part_s(open_run(folder).origin_utc, start, end)
        return replay_command(folder, max(0.0, from_s), to_s, to_test, json)


def repair(
    run_dir: RunArgument,
    in_place: Annotated[
        bool, typer.Option("--in-place", help="Replace the torn files by the repaired ones.")
    ] = False,
    json: JsonOption = False,
) -> int:
    """Repair a run after a crash: torn segments, a torn event log, a missing summary."""
    from membrane_ctrl.replay.repair import repair_command
    from membrane_ctrl.review import catalogue

    with _files_of_the_run():
        return repair_command(catalogue.resolve(run_dir), in_place, json)


@contextlib.contextmanager
def _files_of_the_run() -> Iterator[None]:
    """Name a file that cannot be read or written, in one line."""
    try:
        yield
    except OSError as error:
        raise errors.InputError(f"{error.filename or 'files'}: {errors.os_reason(error)}") from None
