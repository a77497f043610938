"""Starts a tuning session beside a hold."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from membrane_ctrl.processes import command_process

_NICE = 10  # of the tuning session
_ENDS_S = 10.0


def start_autotune(socket: Path | None, run_dir: Path) -> Callable[[], None]:
    """Start a tuning session, which waits for the hold, on trial.

    It is another program, as if a person had started it: a hold needs no tuner, and outlives it.

    Parameters
    ----------
    socket : path or None
        Control port of the hold.
    run_dir : path
        Gets `autotune.log`.

    Returns
    -------
    callable
        Ends the session.
    """
    words = [
        "--short",
        "--wait",
        "--yes",
        "--choose",
        "same-load",
        "--name",
        "autotune",
        "--reason",
        "hold --autotune",
    ]
    where = ["--socket", str(socket), "--run", str(run_dir), "--logs", str(run_dir.parent)]
    session = command_process.CommandProcess(
        "autotune", ["tune", "run", *words, *where], run_dir / "autotune.log", _NICE
    )
    session.start()
    return partial(session.stop, _ENDS_S)
