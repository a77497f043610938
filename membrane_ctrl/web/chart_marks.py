"""A mark at a moment of the past, which a viewer has chosen in the chart."""

from __future__ import annotations

import math
import time
from contextlib import suppress
from pathlib import Path

from membrane_ctrl.control_port.outcome import Outcome
from membrane_ctrl.model import errors
from membrane_ctrl.review import catalogue
from membrane_ctrl.run_files.annotations import add_mark
from membrane_ctrl.run_files.run import Run, open_run
from membrane_ctrl.web.run_end import find_end_s

NOW_S = 3.0  # a later moment is the present: the hold itself records the mark


def is_now(utc_s: float) -> bool:
    """Whether a moment is so near that the running hold should record the mark."""
    return utc_s > time.time() - NOW_S


def mark_past(logs: Path, utc_s: float, text: str, who: str) -> Outcome:
    """Add a mark to the run of that moment; its recording is not changed.

    Parameters
    ----------
    logs : Path
        Folder of the runs.
    utc_s : float
        The moment.
    text : str
        What the viewer has typed; an empty one is refused.
    who : str
        The viewer, whom the mark names.
    """
    if not text.strip():
        return Outcome.failed("mark", "enter a text")
    run = _find_run(logs, utc_s)
    if run is None:
        return Outcome.failed("mark", "no run was recorded at that time")
    try:
        add_mark(run.folder, run.origin_utc, utc_s - run.origin_utc.timestamp(), text.strip(), who)
    except errors.CommandError as error:
        return Outcome.failed("mark", str(error))
    return Outcome.succeeded("mark")


def _find_run(logs: Path, utc_s: float) -> Run | None:
    """The newest run that began before a moment and had not ended; None without one."""
    for folder in reversed(catalogue.list_run_folders(logs)):
        with suppress(OSError, ValueError, errors.CommandError):
            run = open_run(folder)
            if run.origin_utc.timestamp() > utc_s:
                continue
            ended_s = find_end_s(run)
            return run if math.isnan(ended_s) or utc_s <= ended_s else None
    return None
