"""What a recorder hands on to the one that takes its place: how far it got, and the statistics so far.

Plain JSON (`object_codec`), written and read by the same program and removed at the run's end.
"""

from __future__ import annotations

import contextlib
import json
import math
from dataclasses import dataclass, field
from pathlib import Path

from membrane_ctrl.config import Config
from membrane_ctrl.estimate import ShapeEstimate
from membrane_ctrl.object_codec import ESTIMATE, Decoder, Specials, encode
from membrane_ctrl.recording.atomic import fresh_file, move, read_bytes
from membrane_ctrl.recording.column_tables import OpenWindows
from membrane_ctrl.recording.summary import Summary

_NAME = ".recorder-state"
_BYTES_MAX = 16_000_000  # it takes 0.2 MB, and 0.5 MB with all the transitions and faults that a summary lists
_SPECIALS: Specials = {ShapeEstimate: ESTIMATE}


@dataclass(slots=True)
class RecorderState:
    """Everything of a recorder that is not in the run's files.

    Attributes
    ----------
    summary : Summary
    positions, dropped : dict
        Of each ring: messages recorded, messages lost.
    reference : ShapeEstimate or None
        What changes of the figure are told against.
    state : float
        The controller's state in the last row.
    windows : OpenWindows
        Of the overview tables.
    errors, rows_lost, events_lost, input_ticks_lost : int
        The recorder's own account.
    folder_anew_s : float or None
        When the folder was last begun anew, because somebody had taken it away.
    """

    summary: Summary
    positions: dict[str, int] = field(default_factory=dict)
    dropped: dict[str, int] = field(default_factory=dict)
    reference: ShapeEstimate | None = None
    state: float = math.nan
    windows: OpenWindows = field(default_factory=OpenWindows)
    errors: int = 0
    rows_lost: int = 0
    events_lost: int = 0
    input_ticks_lost: int = 0
    folder_anew_s: float | None = None


def save_state(run_dir: Path, state: RecorderState) -> None:
    """Write the state in one step. Raises OSError.

    Not synced: it is of use after a killed recorder, not after a power cut, when the rings are gone as well.
    """
    part = run_dir / f"{_NAME}.part"
    with fresh_file(part) as file:
        file.write(json.dumps(encode(state, _SPECIALS)).encode())
    move(part, run_dir / _NAME)


def load_state(run_dir: Path) -> RecorderState | None:
    """The state left behind; None if there is none that can be read."""
    decoder = Decoder((RecorderState(Summary(Config())),), _SPECIALS)
    try:
        state = decoder.decode(json.loads(read_bytes(run_dir / _NAME, _BYTES_MAX)), RecorderState)
    except (OSError, ValueError, RecursionError):  # the recorder begins anew and says so
        return None
    assert isinstance(state, RecorderState)
    return state


def remove_state(run_dir: Path) -> None:
    """The run is over: nobody goes on."""
    with contextlib.suppress(OSError):
        (run_dir / _NAME).unlink(missing_ok=True)
