"""The order of test files: those that take longest come first, so that none is left alone with one
worker at the end of a run.
"""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
# Files of more than 15 s (`pytest --durations=0`); an order that is out of date costs only time.
LONGEST_FIRST = (
    # real time
    "end_to_end/test_hold.py",
    "bridges/test_mqtt_bridge.py",
    "end_to_end/test_save_and_restart.py",
    "web/test_reverse_proxy.py",
    "end_to_end/test_tune.py",
    "test_tutorial.py",
    "web/test_gains_panel.py",
    "end_to_end/test_lab_serial.py",
    "web/test_page_under_attack.py",
    "web/test_page.py",
    "acquisition/test_acquisition_real_bench.py",
    "end_to_end/test_recorder_killed.py",
    "firmware_iface/test_camera_aravis.py",
    "web/test_roles.py",
    "acquisition/test_example_optics.py",
    "end_to_end/test_locked_bench.py",
    "hold/test_page_service.py",
    "end_to_end/test_ctl.py",
    "service/test_connections.py",
    # the others
    "measure/test_measure_command.py",
    "controller/test_protections.py",
    "campaign/test_campaign.py",
    "metrology/cycle/test_live_cycle.py",
    "metrology/calibration/test_calibrate_turned.py",
    "controller/test_states.py",
    "tuning/test_session_on_twin.py",
    "commissioning/test_guided_session.py",
    "calibration/test_calibrate_command.py",
    "metrology/frame_checks/test_frame_integrity.py",
    "controller/test_actuator_response.py",
    "hold/test_scenarios.py",
    "measure/test_track_moving_bench.py",
    "metrology/calibration/test_calibrate_verdict.py",
    "controller/test_without_laser.py",
    "review/test_runs_export_review.py",
    "fuzz/test_strangers_folders.py",
    "metrology/calibration/test_calibrate_elsewhere.py",
    "measure/test_track_second_world.py",
    "metrology/film/test_film_fit.py",
    "controller/test_snapshots.py",
    "bridges/test_opcua_bridge.py",
    "metrology/figure/test_full_result.py",
    "tuning/test_actuator_kind.py",
    "measure/test_uncertainty_command.py",
    "controller/test_tune_state.py",
    "review/test_report.py",
    "metrology/calibration/test_calibrate_solve.py",
    "calibration/test_calibrate_live.py",
    "acquisition/test_vibrations_recorded.py",
    "test_platforms.py",
)
_PLACES = {ROOT / "tests" / name: place for place, name in enumerate(LONGEST_FIRST)}


def sort_items(items: list[pytest.Item]) -> None:
    """Sort tests in place by their files; within a file, and of other files, the order stays."""
    items.sort(key=lambda item: _PLACES.get(item.path, len(_PLACES)))
