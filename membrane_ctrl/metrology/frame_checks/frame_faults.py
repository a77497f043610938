"""The faults that a frame may have, and the flag of a frame that does not belong to its set."""

from dataclasses import dataclass
from enum import Enum, auto

import numpy as np


class FrameDefect(Enum):
    """What is wrong with a frame."""

    UNREADABLE = auto()
    LEFT_OUT = auto()  # without further reason
    DARK = auto()
    SATURATED = auto()
    FLICKER = auto()
    MOVED = auto()  # the film was elsewhere
    STALE = auto()  # shows the picture of another frame
    SWAPPED = auto()  # two frames show each other's pictures
    WRONG_PICTURE = auto()  # stale, or another picture
    DIFFERS = auto()  # from its prediction, without a name
    INCONSISTENT = auto()  # with the other steps of its series

    @property
    def is_found_by_prediction(self) -> bool:
        """Whether the frame was compared with what the geometry predicts: a wrong geometry blames
        many frames with such defects.
        """
        return self in (
            FrameDefect.MOVED,
            FrameDefect.DIFFERS,
            FrameDefect.WRONG_PICTURE,
            FrameDefect.FLICKER,
        )


@dataclass(frozen=True)
class Flag:
    """A frame that does not belong.

    Attributes
    ----------
    frame : int
    defect : FrameDefect
    reason : str
        Sentence for people.
    severity : float
        Deviation in units of its limit.
    swapped_with : int, optional
        The frame that shows this one's pattern, while this one shows the pattern of that one.
    """

    frame: int
    defect: FrameDefect
    reason: str
    severity: float
    swapped_with: int | None = None


def flag_unreadable(frame: int, reason: str) -> Flag:
    """Return the flag of a frame that could not be read.

    Parameters
    ----------
    frame : int
        Its place in the set.
    reason : str
        Why, for people.

    Returns
    -------
    Flag
        Of infinite severity.
    """
    return Flag(frame, FrameDefect.UNREADABLE, reason, np.inf)
