"""Values that a shell completes: runs, scenarios, examples."""

from __future__ import annotations

import contextlib
from pathlib import Path

import typer

_LOGS = Path("logs")


def complete_run(context: typer.Context, incomplete: str) -> list[str]:
    """Names of runs for the shell, newest first, after `last`.

    Without a match the shell completes a path.

    Parameters
    ----------
    context : Context
        Of the command line so far; its `--logs` names the folder of the runs, `logs` by default.
    incomplete : str
        What is typed of the name.

    Returns
    -------
    list of str
        Empty if there is no such folder: a completion must not print an error.
    """
    from membrane_ctrl.run_files.run_lookup import is_run

    logs = find_logs(context) or _LOGS
    with contextlib.suppress(OSError):
        folders = sorted((each for each in logs.iterdir() if is_run(each)), reverse=True)
        names = ["last", *(folder.name for folder in folders)]
        return [name for name in names if name.startswith(incomplete)]
    return []


def complete_scenario(incomplete: str) -> list[str]:
    """Names of the scenarios that begin so."""
    from membrane_ctrl.hold.scenarios import list_scenario_files

    names = [path.stem for path in list_scenario_files()]
    return [name for name in names if name.startswith(incomplete)]


def complete_example(incomplete: str) -> list[str]:
    """Names of the examples that begin so."""
    folder = Path(__file__).parents[1] / "examples"
    return [path.name for path in sorted(folder.iterdir()) if path.name.startswith(incomplete)]


def find_logs(context: typer.Context) -> Path | None:
    """The folder of `--logs`, given to a command or in front of it; None without one."""
    for each in (context, context.parent):
        given = None if each is None else each.params.get("logs")
        if given:
            return Path(given[-1] if isinstance(given, (list, tuple)) else given)
    return None
