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
