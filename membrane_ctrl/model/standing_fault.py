"""The fault in which a run is, or ends: one rule for the summary, the catalogue and the closing
words.
"""

from __future__ import annotations

from membrane_ctrl.model.errors import Exit
from membrane_ctrl.model.events import Cleared, Event, Fault, StateEntered


def standing_fault_after(fault: Fault | None, event: Event) -> Fault | None:
    """The standing fault after an event.

    Parameters
    ----------
    fault : Fault or None
        The one before.
    event : Event
        The event; most change nothing.

    Returns
    -------
    Fault or None
        None after its cause has gone, or once the fault state was left.
    """
    match event:
        case Fault():
            return event
        case Cleared():
            return None
        case StateEntered(from_="fault"):
            return None
    return fault


def fault_of_end(fault: Fault | None, exit_: str | None) -> Fault | None:
    """The fault in which a run ended: the standing one, unless the run was ended well while its
    cause was there.

    Parameters
    ----------
    fault : Fault or None
        The standing fault after the last event.
    exit_ : str or None
        How the run ended, in lower case as in its end event; None if it has not, or if that is
        unknown.
    """
    ended_well = exit_ in (Exit.DONE.name.lower(), Exit.INTERRUPTED.name.lower())
    return None if ended_well else fault
