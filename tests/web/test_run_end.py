"""When a run ended: by its record, else by its tables; not while its hold lives."""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path

from membrane_ctrl.model.run_events import Ended
from membrane_ctrl.processes.published_rings import publish_rings
from membrane_ctrl.run_files.run import open_run
from membrane_ctrl.web.run_end import find_end_s
from tests.service.test_ended_run import STARTED, write_run


def test_a_run_ends_when_its_hold_has_gone(tmp_path: Path) -> None:
    folder = write_run(tmp_path, [(20.0, Ended("safety_trip", 5)), (85.0, Ended("terminated"))])
    with ExitStack() as control:
        publish_rings(folder, {}, control)
        assert math.isnan(find_end_s(open_run(folder)))
    assert find_end_s(open_run(folder)) == STARTED.timestamp() + 20.0


def test_a_run_without_a_recorded_end_ends_with_its_tables(tmp_path: Path) -> None:
    """Its machine lost power: nothing of it stands for ever."""
    ended_s = find_end_s(open_run(write_run(tmp_path, [])))
    assert 0.0 <= ended_s - STARTED.timestamp() <= 60.0
