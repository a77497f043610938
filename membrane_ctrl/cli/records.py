"""The commands that work on recorded inputs: replay and repair."""

import contextlib
from collections.abc import Iterator
from typing import Annotated

import typer

from membrane_ctrl.cli.options import JsonOption, RunArgument
from membrane_ctrl.model import clock, errors


def add_commands(app: typer.Typer) -> None:
    """Add `replay`, `repair`."""
    app.command()(replay)
    app.command()(repair)


def replay(
    run_dir: RunArgument,
    start: Annotated[str | None, typer.Option("--from", help="Compare from this time of the run, e.g. 3m.")] = None,
    end: Annotated[str | None, typer.Option("--to", help="Compare up to this time of the run.")] = None,
    to_test: Annotated[str | None, typer.Option(help="Write a regression test to tests/incidents/NAME.")] = None,
    json: JsonOption = False,
) -> int:
    """Replay a run's inputs through today's control code and report differences (exit 3)."""
    import math

    from membrane_ctrl.replay.command import replay_command

    from_s = 0.0 if start is None else clock.parse_duration_s(start)
    to_s = math.inf if end is None else clock.parse_duration_s(end)
    with _files_of_the_run():
        return replay_command(run_dir, from_s, to_s, to_test, json)


def repair(
    run_dir: RunArgument,
    in_place: Annotated[
        bool, typer.Option("--in-place", help="Replace the torn files by the repaired ones.")
    ] = False,
    json: JsonOption = False,
) -> int:
    """Repair a run after a crash: torn segments, a torn event log, a missing summary."""
    from membrane_ctrl.replay.repair import repair_command

    with _files_of_the_run():
        return repair_command(run_dir, in_place, json)


@contextlib.contextmanager
def _files_of_the_run() -> Iterator[None]:
    """Name a file that cannot be read or written, in one line."""
    try:
        yield
    except OSError as error:
        raise errors.InputError(f"{error.filename or 'files'}: {errors.os_reason(error)}") from None
