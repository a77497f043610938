"""Reasons of the controller: a code that decides, and a text for people that may be improved at any
time.
"""

from dataclasses import dataclass
from enum import StrEnum

from membrane_ctrl.model.state_tree import StateNode


class WhyCode(StrEnum):
    """Why the pump is as it is, and the mirror not held; more words may follow after a point."""

    STANDBY = "standby"
    OBSERVING = "observing"
    LOCKED = "locked"
    INTERLOCK_OPEN = "interlock_open"
    FAULT_LATCHED = "fault_latched"
    HOLD_REQUESTED = "hold_requested"
    NO_ANSWER = "no_answer"
    NO_READING = "no_reading"
    NO_GAUGE = "no_gauge"
    BOARD_FAULTS = "board_faults"
    CHECKING = "checking"
    TESTING_ACTUATORS = "testing_actuators"
    FILM_NOT_RESPONDING = "film_not_responding"
    CHECKED = "checked"
    INFLATING = "inflating"
    SETTLING = "settling"
    SETTLED = "settled"
    HOLDING = "holding"
    HOLDING_FLOW = "holding_flow"
    PAUSED = "paused"
    MANUAL = "manual"
    MANUAL_REQUESTED = "manual_requested"
    MANUAL_OVER = "manual_over"
    EXPERIMENT = "experiment"
    EXPERIMENT_REQUESTED = "experiment_requested"
    EXPERIMENT_ENDED = "experiment_ended"
    GOING_DOWN = "going_down"
    VENTING = "venting"
    FAULT = "fault"
    ACKNOWLEDGED = "acknowledged"
    RESUMING = "resuming"


@dataclass(frozen=True, slots=True)
class Reason(StateNode):
    """A reason.

    Attributes
    ----------
    code : str
        What decides whether it is another reason: a code, and what else distinguishes it, after
        points.
    text : str
        For people, with numbers; may be empty.
    """

    code: str = ""
    text: str = ""

    def __bool__(self) -> bool:
        """Whether there is a reason."""
        return bool(self.code)


def make_reason(code: str, text: str, *details: object) -> Reason:
    """Return a reason whose code has details.

    Parameters
    ----------
    code : str
        What decides, such as the name of a refusal.
    text : str
        For people, with numbers.
    *details : object
        What makes it another reason although the code is the same, such as who asked: joined to
        the code by points.
    """
    return Reason(".".join(map(str, (code, *details))), text)


NO_REASON = Reason()
