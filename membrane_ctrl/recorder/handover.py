"""What a recorder hands to its successor: its progress, and the statistics so far.

A state tree (`model/state_tree.py`) as JSON, written and read by the same program and removed at
the run's end. Of the event lines in it, NaN becomes null, as in `summary.json`.
"""

import base64
import contextlib
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from pydantic import PlainSerializer, PlainValidator

from membrane_ctrl.model import files
from membrane_ctrl.model.shape_estimate import ShapeEstimate, pack_estimate, unpack_estimate
from membrane_ctrl.model.state_tree import (
    Count,
    StateError,
    StateNode,
    decode_state,
    encode_state,
)
from membrane_ctrl.run_files.levels import OpenWindows
from membrane_ctrl.run_files.summary import Summary

_NAME = ".recorder-state"
# usually 0.1 MB; 0.5 MB with all the transitions and faults that a summary lists
_BYTES_MAX = 16_000_000


def _encode_estimate(estimate: ShapeEstimate) -> str:
    return base64.b64encode(pack_estimate(estimate)).decode()


def _decode_estimate(data: object) -> ShapeEstimate:
    if not isinstance(data, str):
        raise ValueError("a shape estimate is a text in base64")
    return unpack_estimate(base64.b64decode(data, validate=True))


_StoredEstimate = Annotated[
    ShapeEstimate,
    PlainValidator(_decode_estimate),
    PlainSerializer(_encode_estimate, return_type=str, when_used="json"),
]


@dataclass(slots=True)
class RecorderState(StateNode):
    """The state of a recorder that is not in the run's files."""

    summary: Summary
    positions: dict[str, Count] = field(default_factory=dict)  # per ring: messages recorded or lost
    dropped: dict[str, Count] = field(default_factory=dict)  # per ring: messages lost
    reference: _StoredEstimate | None = None  # reference for changes of the figure
    state: float = math.nan  # of the controller, in the last row
    windows: OpenWindows = field(default_factory=OpenWindows)
    errors: Count = 0
    rows_lost: Count = 0
    events_lost: Count = 0
    input_ticks_lost: Count = 0
    folder_replaced_s: float | None = None  # when the folder was found removed


def save_state(run_dir: Path, state: RecorderState) -> None:
    """Write the state atomically.

    Not synced: it serves after a killed recorder, not after a power cut, which also loses the
    rings.

    Parameters
    ----------
    run_dir : path
        Folder of the run.
    state : RecorderState
        After a whole second was written: positions in the rings, open windows, counts of losses.

    Raises
    ------
    OSError
        The disk is full, or the folder is gone; the former state stays.
    """
    part = run_dir / f"{_NAME}.part"
    with files.fresh_file(part) as file:
        file.write(encode_state(state))
    files.move_file(part, run_dir / _NAME)


def load_state(run_dir: Path) -> RecorderState | None:
    """Read the state left behind; None if there is none or it is unreadable."""
    try:
        data = files.read_bytes(run_dir / _NAME, _BYTES_MAX)
        return decode_state(data, RecorderState, _BYTES_MAX)
    except (OSError, StateError):  # the recorder starts without it and reports that
        return None


def remove_state(run_dir: Path) -> None:
    """Remove the state file of a finished run."""
    with contextlib.suppress(OSError):
        (run_dir / _NAME).unlink(missing_ok=True)
