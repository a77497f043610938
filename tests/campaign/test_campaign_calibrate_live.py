"""`calibrate --live` beside a hold with real processes whose bench
differs from its configuration.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from membrane_ctrl.geometry.file import read_geometry

pytestmark = [pytest.mark.campaign, pytest.mark.real_time, pytest.mark.timeout(1800)]

COMMAND = [sys.executable, "-m", "membrane_ctrl"]
PATIENCE_S = 600.0
# A mirror that loses and gains gas twenty times as fast as a real one, and frames of an eighth
CONFIG = """
[twin]
port = 0
scenario = "quiet"
start_error_um = -3.0
leak_time_constant_s = 500.0
[twin.geometry]
a_mm = 2674.0
b_mm = 2869.0
alpha_deg = 81.2
[pump]
flow_full_um_per_s = 60.0
[loop]
flow_max_um_per_s = 60.0
setpoint_ramp_um_per_s = 40.0
[shape]
frame_interval_s = 0.02
[optics]
geometry_file = "bench.toml"
[optics.camera]
width_px = 306
height_px = 256
pixel_um = 27.6
bits = 16
noise_adu = 15.8
"""


def wait_for(what: Callable[[], bool]) -> None:
    give_up_s = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < give_up_s, "waited in vain"
        time.sleep(0.2)


def read_events(logs: Path) -> list[dict[str, object]]:
    """Events of the one run."""
    found = list(logs.glob("*-hold/events.jsonl"))
    return (
        [json.loads(line) for line in found[0].read_text().splitlines() if line.endswith("}")]
        if found
        else []
    )


@pytest.fixture
def logs(tmp_path: Path) -> Iterator[Path]:
    """Logs of a hold that holds and tracks its shape."""
    (tmp_path / "lab.toml").write_text(CONFIG)
    words = [
        "hold",
        "--twin",
        "--config",
        str(tmp_path / "lab.toml"),
        "--logs",
        str(tmp_path / "logs"),
    ]
    process = subprocess.Popen([*COMMAND, *words], stderr=subprocess.DEVNULL)
    try:
        wait_for(
            lambda: any(
                e["kind"] == "shape" and e["state"] == "tracking"
                for e in read_events(tmp_path / "logs")
            )
        )
        yield tmp_path / "logs"
    finally:
        process.terminate()
        process.wait(60.0)


def test_aborted_gone_on_with_and_adopted(logs: Path) -> None:
    live = [*COMMAND, "calibrate", "--live", "--logs", str(logs), "--no-pictures", "--yes"]
    first = subprocess.Popen(
        [*live, "--range-um", "1200", "--sets", "3"], stderr=subprocess.PIPE, text=True
    )
    wait_for(lambda: any(event["kind"] == "capture" for event in read_events(logs)))
    wait_for(lambda: any((logs / "calibration").glob("*/sets/set-1")))
    first.send_signal(signal.SIGINT)
    output = first.communicate(timeout=PATIENCE_S)[1]
    assert first.returncode == 130, output
    assert "stopped with 2 sets missing" in output

    (session,) = (logs / "calibration").iterdir()
    done = subprocess.run(
        [*live, "--session", str(session), "--json"],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = {row["name"]: row for row in json.loads(done.stdout)["parameters"]}
    for name, true, known in (("a_mm", 2.0, 2.0), ("b_mm", -2.0, 2.0), ("alpha_deg", 0.3, 0.3)):
        assert abs(found[name]["value"] - true) < 4 * found[name]["sigma"], name
        assert found[name]["sigma"] < 0.8 * known, name
    new = read_geometry(logs.parent / "bench.toml")
    assert new.origin.hash == json.loads(done.stdout)["hash"]
    assert new.geometry.reference_displacement_um == 0.0  # the setpoint of the hold
    events = read_events(logs)
    assert [event["verdict"] for event in events if event["kind"] == "capture"] == ["ok"] * 3
    assert not [event for event in events if event["kind"] in ("fault", "plausibility")]
    assert [event["state"] for event in events if event["kind"] == "shape"][-1] != "off"
    setpoints = [event["value"] for event in events if event.get("command") == "setpoint"]
    assert setpoints[-1] == 0.0
