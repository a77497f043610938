"""The mirror held through a serial laser, a Bronkhorst flow controller and a barometer, all in
bytes on ptys.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.real_time

EXAMPLE = Path(__file__).parents[2] / "membrane_ctrl" / "examples" / "all-serial.toml"
HOLD = [sys.executable, "-m", "membrane_ctrl", "hold", "--devices", str(EXAMPLE)]


def test_the_mirror_is_held_through_serial_instruments(tmp_path: Path) -> None:
    near = tmp_path / "near.toml"
    patient = {
        "[devices.displacement]\n": "[devices]\nwatchdog_s = 2.0\n[devices.displacement]\ntimeout_s = 1.9\n",  # noqa: E501
        # the waits of the two on one line add up
        "unit_id = 3\n": "unit_id = 3\ntimeout_s = 0.9\n",
        "unit_id = 5\n": "unit_id = 5\ntimeout_s = 0.9\n",
    }
    text = EXAMPLE.read_text() + "\n[limits]\nstale_s = 2.0\nlateness_max_ms = 1900.0\n"
    for words, slow in patient.items():
        assert words in text
        text = text.replace(words, slow)
    near.write_text(text + "[twin]\nstart_error_um = -2.0\n")
    done = subprocess.run(
        [
            *HOLD[:-1],
            str(near),
            "--twin",
            "--duration",
            "30s",
            "--logs",
            str(tmp_path / "logs"),
            "--json",
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert "hold" in [state["state"] for state in summary["states"]]
    assert 0 < summary["true_std_um"] < 1.0  # the twin's truth, not the laser's reading
    assert "Traceback" not in done.stderr


def test_devices_without_twin_is_a_usage_error(tmp_path: Path) -> None:
    done = subprocess.run(
        [*HOLD, "--logs", str(tmp_path / "logs")],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert "--devices needs --twin" in done.stderr
    assert not (tmp_path / "logs").exists()
