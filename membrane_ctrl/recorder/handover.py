"""What a recorder hands to its successor: its progress, and the statistics so far.

Plain JSON (`object_codec`), written and read by the same program and removed at the run's end.
"""

import contextlib
import json
import math
from dataclasses import dataclass, field
from pathlib import Path

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import files, object_codec, shape_estimate
from membrane_ctrl.run_files import levels
from membrane_ctrl.run_files.summary import Summary

_NAME = ".recorder-state"
# usually 0.2 MB; 0.5 MB with all the transitions and faults that a summary lists
_BYTES_MAX = 16_000_000
_SPECIALS: object_codec.Specials = {shape_estimate.ShapeEstimate: object_codec.ESTIMATE}


@dataclass(slots=True)
class RecorderState:
    """The state of a recorder that is not in the run's files."""

    summary: Summary
    positions: dict[str, int] = field(default_factory=dict)  # per ring: messages recorded or lost
    dropped: dict[str, int] = field(default_factory=dict)  # per ring: messages lost
    reference: shape_estimate.ShapeEstimate | None = None  # reference for changes of the figure
    state: float = math.nan  # of the controller, in the last row
    windows: levels.OpenWindows = field(default_factory=levels.OpenWindows)
    errors: int = 0
    rows_lost: int = 0
    events_lost: int = 0
    input_ticks_lost: int = 0
    folder_anew_s: float | None = None  # when the folder was found removed


def save_state(run_dir: Path, state: RecorderState) -> None:
    """Write the state atomically. Raises OSError.

    Not synced: it serves after a killed recorder, not after a power cut, which also loses the
    rings.
    """
    part = run_dir / f"{_NAME}.part"
    with files.fresh_file(part) as file:
        file.write(json.dumps(object_codec.encode(state, _SPECIALS)).encode())
    files.move(part, run_dir / _NAME)


def load_state(run_dir: Path) -> RecorderState | None:
    """Read the state left behind; None if there is none or it is unreadable."""
    decoder = object_codec.Decoder((RecorderState(Summary(Config())),), _SPECIALS)
    try:
        state = decoder.decode(
            json.loads(files.read_bytes(run_dir / _NAME, _BYTES_MAX)), RecorderState
        )
    except (OSError, ValueError, RecursionError):  # the recorder starts afresh and reports that
        return None
    assert isinstance(state, RecorderState)
    return state


def remove_state(run_dir: Path) -> None:
    """Remove the state file of a finished run."""
    with contextlib.suppress(OSError):
        (run_dir / _NAME).unlink(missing_ok=True)
