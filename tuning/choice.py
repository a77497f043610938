"""What a person decides: which candidate is applied, and whether kept gains become those of the configuration."""

import sys

from membrane_ctrl.model import terminal
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.sessions.folder import SessionFolder
from membrane_ctrl.sessions.live_hold import Progress
from tuning import session
from tuning.proposal import design, trade
from tuning.rig import HoldRig


def require_an_answer(yes: bool, name: str, known: bool) -> None:
    """Raises InputError before anything moves if nobody could choose the gains.

    If the names are `known`, i.e. the session is not from an earlier version, it refuses an unknown one too.
    """
    if not (yes or name or sys.stdin.isatty()):
        raise InputError(
            "the gains to apply are chosen on a terminal; elsewhere add --yes (the proposal) or --choose NAME"
        )
    if name and known and name not in design.NAMES:
        raise InputError(f"--choose {name}: not a candidate; known: {', '.join(design.NAMES)}")


def chosen(folder: SessionFolder, rig: HoldRig, yes: bool, name: str, progress: Progress) -> bool:
    """Show what each candidate gives and costs, and ask; false if a person wants none of them."""
    rows, now = session.offered(folder)
    model = session.found_of(folder).identified.model
    shown = terminal.table_console(stderr=True, width=None if sys.stderr.isatty() else 170)
    shown.print(trade.rich_table(rows, f"{now.name} is proposed", model.leak_um_per_s))
    if name:
        session.choose(folder, name)
    while not (name or yes):
        answer = progress.ask("apply which candidate? (Enter: none)")
        if not answer:
            return False
        try:
            session.choose(folder, answer)
            break
        except InputError as error:
            progress.say(str(error))
    rig.catch_up()
    return True
