"""Asks which candidate to apply."""

import sys

from membrane_ctrl.model import terminal
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.sessions.folder import SessionFolder
from membrane_ctrl.sessions.progress import Progress
from tuning.proposal import candidate, candidate_table
from tuning.steps import design, identify

_COLUMNS_ELSEWHERE = 170  # of the table, if it is not shown on a terminal


def require_answer(yes: bool, name: str) -> None:
    """Refuse a command, before anything moves, that could not choose the gains at its end.

    Parameters
    ----------
    yes : bool
        Apply the proposal without asking.
    name : str
        The candidate to apply without asking; empty to ask.

    Raises
    ------
    InputError
        If no person can choose the gains, or the name is no candidate's.
    """
    if not (yes or name or sys.stdin.isatty()):
        raise InputError(
            "the gains to apply are chosen on a terminal; elsewhere add --yes (the proposal) "
            "or --choose NAME"
        )
    if name and name not in candidate.NAMES:
        raise InputError(f"--choose {name}: not a candidate; known: {', '.join(candidate.NAMES)}")


def choose_candidate(folder: SessionFolder, yes: bool, name: str, progress: Progress) -> str | None:
    """Show what each candidate gives and costs, and return the one to apply.

    Parameters
    ----------
    folder : SessionFolder
        With a finished design.
    yes : bool
        Apply the gains in `gains.toml` without asking, unless they are a proposal that is no better
        than the present gains.
    name : str
        The candidate to apply without asking, with `yes` unless it is no better than the present
        gains; empty to ask.
    progress : Progress
        Asks the person.

    Returns
    -------
    str or None
        Name of the chosen candidate; empty for the gains in `gains.toml` as they are; None if
        nothing is to be applied.

    Raises
    ------
    InputError
        If the named candidate is unknown or must not be applied.
    """
    rows, proposed = design.load_candidates(folder)
    model = identify.load_identified(folder).identified.model
    title = f"proposed: {proposed.name}"
    width = None if sys.stderr.isatty() else _COLUMNS_ELSEWHERE
    screen = terminal.table_console(stderr=True, width=width)
    screen.print(candidate_table.format_terminal(rows, title, model.leak_um_per_s))
    if name:
        chosen = design.find_candidate(folder, name).name
        no_benefit = design.explain_no_benefit_of(folder, name) if yes else ""
        if not no_benefit:
            return chosen
        progress.print_line(no_benefit)
        return None
    if not yes:
        return _ask_for_candidate(folder, progress)
    if no_benefit := design.explain_no_benefit(folder):
        progress.print_line(no_benefit)
        return None
    return ""


def _ask_for_candidate(folder: SessionFolder, progress: Progress) -> str | None:
    """Ask until the answer is a candidate that may be applied, or empty."""
    while True:
        answer = progress.ask_question(
            "apply which candidate? (Enter: none)", design.list_applicable(folder)
        )
        if not answer:
            return None
        try:
            return design.find_candidate(folder, answer).name
        except InputError as error:
            progress.print_line(str(error))
