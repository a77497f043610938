"""Clients get the children's reports besides the ticks' decisions."""

from __future__ import annotations

from pathlib import Path

from membrane_ctrl.model.acquisition_events import GeometryInUse
from membrane_ctrl.model.events import Maintenance, MaintenanceOver, StateEntered, Why
from membrane_ctrl.model.reason import WhyCode
from membrane_ctrl.model.recorder_events import DiskLow, RecorderError, RecorderRecovered
from tests.worlds.port_run import port_run


async def test_a_report_of_a_child_stands_in_the_status(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run:
        run.port.note_report(GeometryInUse("12ab", None, None, ""))
        run.port.note_report(Maintenance("calibrate", "calibrate again"))
        status = run.port.status()
        assert status["notices"] == [
            {
                "topic": "maintenance",
                "subject": "calibrate",
                "severity": "warning",
                "text": "Maintenance calibrate: calibrate again",
            }
        ]
        assert status["geometry"]["hash"] == "12ab"
        run.port.note_report(MaintenanceOver("calibrate", "fits again"))
        assert run.port.status()["notices"] == []


async def test_trouble_with_the_recording_stands_in_the_status_until_it_is_over(
    tmp_path: Path,
) -> None:
    async with port_run(tmp_path) as run:
        run.port.note_report(DiskLow("disk", "less than 500 MB free"))
        run.port.note_report(RecorderError("state file", "state file: x"))
        run.port.note_report(RecorderRecovered("state file", "state file works again"))
        status = run.port.status()
        assert [notice["subject"] for notice in status["notices"]] == ["disk"]
        assert status["recording_ok"] is False
        run.port.note_report(RecorderRecovered("disk", "disk works again"))
        status = run.port.status()
        assert status["notices"] == []
        assert status["recording_ok"] is True


async def test_a_pause_stands_in_the_status_until_the_reason_or_the_state_changes(
    tmp_path: Path,
) -> None:
    async with port_run(tmp_path) as run:
        assert run.port.status()["paused"] is False
        for over in (
            Why("holding", "holding"),
            StateEntered("manual", "hold", "ann took over the pump"),
        ):
            run.tick(events=(Why("whatever the text says", WhyCode.PAUSED),))
            assert run.port.status()["paused"] is True
            run.tick(events=(over,))
            assert run.port.status()["paused"] is False
