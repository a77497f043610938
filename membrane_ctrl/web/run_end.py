"""When a run ended, as far as its files and its hold show."""

from __future__ import annotations

import math
from contextlib import suppress

from membrane_ctrl.model.run_events import Ended
from membrane_ctrl.processes.published_rings import is_control_alive
from membrane_ctrl.review import run_span
from membrane_ctrl.run_files.run import Run


def find_end_s(run: Run) -> float:
    """UTC seconds of the end of a run; NaN while its hold lives.

    A run without a recorded end, as after a power cut, ends with its tables.
    """
    with suppress(OSError):  # a run that was played has no hold
        if is_control_alive(run.folder):
            return math.nan
    began_s = run.origin_utc.timestamp()
    ends_s = [each.mono_s for each in run.log if isinstance(each.event, Ended)]
    return began_s + (ends_s[0] if ends_s else run_span.end_s(run))
