"""What a recorder hands on to the one that takes its place: how far it got, and the statistics so far.

Pickled, for it never leaves the run: written and read by the same program, removed at the run's end.
"""

from __future__ import annotations

import contextlib
import math
import pickle
from dataclasses import dataclass, field
from pathlib import Path

from membrane_ctrl.estimate import ShapeEstimate
from membrane_ctrl.recording.column_tables import OpenWindows
from membrane_ctrl.recording.summary import Summary

_NAME = ".recorder-state"


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
    part.write_bytes(pickle.dumps(state))
    part.replace(run_dir / _NAME)


def load_state(run_dir: Path) -> RecorderState | None:
    """The state left behind; None if there is none that can be read."""
    try:
        state = pickle.loads((run_dir / _NAME).read_bytes())
    except Exception:  # whatever is wrong with the bytes, the recorder begins anew and says so
        return None
    return state if isinstance(state, RecorderState) else None


def remove_state(run_dir: Path) -> None:
    """The run is over: nobody goes on."""
    with contextlib.suppress(OSError):
        (run_dir / _NAME).unlink(missing_ok=True)
