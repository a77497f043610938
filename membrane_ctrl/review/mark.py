"""`membrane-ctrl review mark`: adds a remark to the timeline of a run."""

from collections.abc import Sequence
from pathlib import Path

from membrane_ctrl.model import errors
from membrane_ctrl.review import catalogue
from membrane_ctrl.review.run_span import end_s, make_outside_error
from membrane_ctrl.review.run_times import moment_s
from membrane_ctrl.run_files.annotations import add_mark
from membrane_ctrl.run_files.run import open_run


def mark_command(words: Sequence[str], at: str | None) -> int:
    """Add a mark to a run's timeline.

    Parameters
    ----------
    words : sequence of str
        Of the command line: the run (its folder, its name or a part of it, or `last`) and the text.
    at : str or None
        Time as a person writes it (`run_times.moment_s`), within the run.

    Returns
    -------
    int
        0, the exit code.

    Raises
    ------
    InputError
        Words or time are missing, the text is empty, or the time is outside the run.
    """
    if len(words) != 2 or at is None:
        raise errors.InputError(
            "review mark: write `review mark RUN TEXT --at 03:12` (TEXT in quotes)"
        )
    if not words[1].strip():
        raise errors.InputError(
            "review mark: TEXT is empty: write `review mark RUN TEXT --at 03:12`"
        )
    opened = open_run(catalogue.resolve_run(Path(words[0])))
    at_s = moment_s(at, opened.origin_utc)
    if not 0 <= at_s <= end_s(opened):
        raise make_outside_error(opened, f"--at {at}")
    mark = add_mark(opened.folder, opened.origin_utc, at_s, words[1])
    print(f"marked {mark['time_utc']} in {opened.name}")
    return 0
