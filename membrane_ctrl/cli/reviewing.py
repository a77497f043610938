"""The commands that work on finished runs."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from membrane_ctrl.cli.completion import complete_run, find_logs
from membrane_ctrl.cli.options import FromOption, JsonOption, RunArgument, ToOption
from membrane_ctrl.model import durations, errors

LogsOption = Annotated[Path, typer.Option("--logs", help="Folder of the runs.")]

OneLogsOption = Annotated[
    Path | None, typer.Option("--logs", help="Folder of the runs; `logs` by default.")
]
DEFAULT_LOGS = Path("logs")

runs_app = typer.Typer(
    invoke_without_command=True, rich_markup_mode="markdown", help="List, show and prune runs."
)


def add_commands(app: typer.Typer) -> None:
    """Add `review`, `report`, `export`, `runs`, `replay` and `repair`."""
    app.command()(review)
    app.command()(report)
    app.command("export")(export_run)
    app.add_typer(runs_app, name="runs")
    app.command()(replay)
    app.command()(repair)


def review(
    runs: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="RUN...", help="One run, or several to overlay.", autocompletion=complete_run
        ),
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="All runs of a folder, as a table.")] = False,
    logs: LogsOption = Path("logs"),
    at: Annotated[
        str | None, typer.Option(help="Open at this time: 03:12 (UTC) or +90m from the start.")
    ] = None,
    around: Annotated[
        str | None, typer.Option(help="Open at the first event of this name, e.g. a fault.")
    ] = None,
    start: FromOption = None,
    end: ToOption = None,
    tab: Annotated[
        str, typer.Option(help="Tab to open: overview, loop, shape, faults or tuning.")
    ] = "overview",
    align: Annotated[
        str, typer.Option(help="Several runs: align them by hold, start or utc.")
    ] = "hold",
    live: Annotated[bool, typer.Option("--live", help="Follow a run in progress.")] = False,
    web: Annotated[bool, typer.Option("--web", help="Serve it to a browser.")] = False,
    bind: Annotated[str, typer.Option(help="With --web: address to listen on.")] = "127.0.0.1",
    port: Annotated[
        int,
        typer.Option(min=0, max=65535, help="With --web: port of the page; 0 for any free one."),
    ] = 0,
    save: Annotated[
        Path | None, typer.Option(help="Write the review's recording instead of showing it.")
    ] = None,
    screenshot: Annotated[
        Path | None, typer.Option(help="Write a picture instead of showing it.")
    ] = None,
) -> int:
    """Open the timeline of one run, or of several overlaid, in the Rerun viewer.

    `review mark RUN TEXT --at 03:12` adds a mark to the timeline and the report.
    """
    runs = runs or []
    if runs[:1] == ["mark"]:  # what follows is text, too, and a path would lose its double slashes
        from membrane_ctrl.review.mark import mark_command

        return mark_command(runs[1:], at)
    from membrane_ctrl.review.viewer.command import ReviewOptions, review_command

    return review_command(
        ReviewOptions(
            [Path(run) for run in runs],
            every,
            logs,
            at,
            around,
            start,
            end,
            tab,
            align,
            live,
            web,
            bind,
            port,
            save,
            screenshot,
        )
    )


def report(
    runs: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN...",
            help="Run folder, its name or part of the name, or `last`.",
            autocompletion=complete_run,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Output folder for report.html and report.json; RUN/report, or `fleet`, by "
            "default."
        ),
    ] = None,
    fleet: Annotated[
        bool,
        typer.Option(
            "--fleet", help="Several runs, or folders of runs: one page with a line for each."
        ),
    ] = False,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="With --fleet: worker processes; one per core by default."),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="With --fleet: run on this Dask scheduler, e.g. tcp://host:8786.",
        ),
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option(
            "--compare",
            help="Another run to compare with: the same part if --from is +.., else all of it.",
        ),
    ] = None,
    start: FromOption = None,
    end: ToOption = None,
    json: JsonOption = False,
) -> int:
    """Write the stability report of a run, or of many: one HTML page and its figures as JSON."""
    if fleet:
        if compare is not None:
            raise errors.InputError("--compare: compares two runs; leave out --fleet")
        from membrane_ctrl.review.report.fleet import FleetOptions, fleet_command

        return fleet_command(
            FleetOptions(runs, out or Path("fleet"), start, end, workers, scheduler, json)
        )
    if len(runs) > 1:
        raise errors.InputError(f"{runs[1]}: one run at a time; --fleet makes one page of several")
    if workers is not None or scheduler is not None:
        raise errors.InputError("--workers and --scheduler are for --fleet")
    from membrane_ctrl.review.report.command import report_command

    return report_command(runs[0], out, compare, start, end, json)


def export_run(
    run: RunArgument,
    form: Annotated[
        str, typer.Option("--format", help="Format: parquet, csv or hdf5.")
    ] = "parquet",
    out: Annotated[Path | None, typer.Option(help="Output folder; RUN/export by default.")] = None,
    streams: Annotated[
        list[str] | None,
        typer.Option(
            "--streams", help="Stream to write: a path, a field, shapes or events; repeatable."
        ),
    ] = None,
    start: FromOption = None,
    end: Annotated[
        str | None, typer.Option("--to", help="End of the part, written as for --from.")
    ] = None,
) -> int:
    """Export a run's columns for other programs."""
    from membrane_ctrl.review.export import export_command

    return export_command(run, form, out, streams or [], start, end)


@runs_app.callback()
def list_runs(
    context: typer.Context,
    logs: Annotated[
        list[Path] | None, typer.Option("--logs", help="Folder of the runs; repeatable.")
    ] = None,
    since: Annotated[
        str | None, typer.Option(help="Only runs started on this day (UTC) or later.")
    ] = None,
    until: Annotated[
        str | None, typer.Option(help="Only runs started before this day (UTC).")
    ] = None,
    longer: Annotated[
        str | None, typer.Option(help="Only runs at least this long, e.g. 2h.")
    ] = None,
    std_um: Annotated[
        float | None, typer.Option(min=0, help="Largest standard deviation, µm.")
    ] = None,
    faults: Annotated[
        bool | None, typer.Option("--faults/--no-faults", help="Only runs with or without faults.")
    ] = None,
    configuration: Annotated[
        str | None, typer.Option(help="First characters of the configuration's hash.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="Part of the run's name.")] = None,
    json: JsonOption = False,
) -> int:
    """List the runs of one folder or more, oldest first."""
    from membrane_ctrl.review.catalogue import Filter
    from membrane_ctrl.review.runs import list_command

    if context.invoked_subcommand is not None:
        _require_only_logs(context)
        return 0
    least_s = None
    if longer is not None:
        least_s = durations.parse_duration_s(longer)
    wanted = Filter(
        least_s=least_s,
        most_std_um=std_um,
        with_faults=faults,
        configuration=configuration,
        text=name,
    )
    return list_command(logs or [Path("logs")], wanted, since, until, json)


def _require_only_logs(context: typer.Context) -> None:
    """Refuse filters in front of a subcommand, which would not apply to it; it takes `--logs` from
    there.
    """
    sources = {name: context.get_parameter_source(name) for name in context.params}
    given = [
        name
        for name, source in sources.items()
        if source is not None and source.name == "COMMANDLINE" and name != "logs"
    ]
    if given:
        named = ", ".join(f"--{name.replace('_', '-')}" for name in given)
        raise errors.InputError(
            f"{named}: filters the list of runs; leave it out with `{context.invoked_subcommand}`"
        )
    if len(context.params["logs"] or ()) > 1:
        raise errors.InputError(f"--logs: one folder for `{context.invoked_subcommand}`")


@runs_app.command("show")
def show_run(
    context: typer.Context, run: RunArgument, logs: OneLogsOption = None, json: JsonOption = False
) -> int:
    """Show one run: figures, states, faults, marks, what is missing."""
    from membrane_ctrl.review.runs import show_command

    return show_command(run, find_logs(context) or DEFAULT_LOGS, json)


@runs_app.command("prune")
def prune_runs(
    context: typer.Context,
    logs: OneLogsOption = None,
    keep_days: Annotated[
        float | None,
        typer.Option(
            min=0, max=1e5, help="Delete runs older than this many days; by default no age counts."
        ),
    ] = None,
    keep_gb: Annotated[
        float | None,
        typer.Option(
            min=0,
            max=1e6,
            help="Then delete the oldest until the rest take at most this, GB; by default no size "
            "counts.",
        ),
    ] = None,
    delete: Annotated[
        bool, typer.Option("--delete", help="Delete them; by default only list them.")
    ] = False,
    json: JsonOption = False,
) -> int:
    """Delete old runs; --keep-days spares the newest three, and a run with a file `.keep` always
    stays.
    """
    from membrane_ctrl.review.runs import prune_command

    return prune_command(find_logs(context) or DEFAULT_LOGS, keep_days, keep_gb, delete, json)


def replay(
    run_dir: RunArgument,
    start: FromOption = None,
    end: ToOption = None,
    to_test: Annotated[
        str | None, typer.Option(help="Write a regression test to tests/incidents/NAME.")
    ] = None,
    state: Annotated[
        bool,
        typer.Option("--state", help="Print what the controller remembers at the end of the part."),
    ] = False,
    json: JsonOption = False,
) -> int:
    """Replay a run's inputs through today's control code and report differences (exit 3)."""
    from membrane_ctrl.replay.command import replay_command
    from membrane_ctrl.review import catalogue, run_times
    from membrane_ctrl.run_files.run import open_run

    with _files_of_the_run():
        folder = catalogue.resolve_run(run_dir)
        from_s, to_s = run_times.part_s(open_run(folder).origin_utc, start, end)
        return replay_command(folder, max(0.0, from_s), to_s, to_test, json, state)


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
        return repair_command(catalogue.resolve_run(run_dir), in_place, json)


@contextlib.contextmanager
def _files_of_the_run() -> Iterator[None]:
    """Name a file that cannot be read or written, in one line."""
    try:
        yield
    except OSError as error:
        raise errors.InputError(f"{error.filename or 'files'}: {errors.os_reason(error)}") from None
