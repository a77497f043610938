"""What the children report reaches those who ask, beside what the ticks decide."""

from __future__ import annotations

from pathlib import Path

from port_run import port_run


async def test_a_report_of_a_child_stands_in_the_status(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run:
        run.port.told({"kind": "geometry", "hash": "12ab", "file": None, "calibrated_utc": None, "message": ""})
        run.port.told({"kind": "maintenance", "name": "calibrate", "message": "calibrate again"})
        status = run.port.status()
        assert status["maintenance"] == {"calibrate": "calibrate again"}
        assert status["geometry"]["hash"] == "12ab"
        run.port.told({"kind": "maintenance_over", "name": "calibrate", "message": "fits again"})
        assert run.port.status()["maintenance"] == {}


async def test_trouble_with_the_recording_stands_in_status_and_metrics_until_it_is_over(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run:
        run.port.told({"kind": "disk_low", "what": "disk", "message": "less than 500 MB free"})
        run.port.told({"kind": "recorder_error", "what": "state file", "message": "state file: x"})
        run.port.told({"kind": "recorder_recovered", "what": "state file", "message": "state file works again"})
        assert run.port.status()["recording"] == {"disk": "less than 500 MB free"}
        assert "membrane_recording_ok 0.0" in run.port.metrics()
        run.port.told({"kind": "recorder_recovered", "what": "disk", "message": "disk works again"})
        assert run.port.status()["recording"] == {}
        assert "membrane_recording_ok 1.0" in run.port.metrics()
