"""A camera and a screen of another vendor cost no place in ours: a package is installed, a
configuration names it.

The package is built and installed as a stranger would; the commands run in processes of their own.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from patient_instruments import INSTRUMENTS

from tests.support.studio_package import SOURCE

pytestmark = [pytest.mark.campaign, pytest.mark.real_time, pytest.mark.timeout(1800)]

ROOT = Path(__file__).parents[3]
PATIENCE_S = 900.0  # of a busy machine that compiles the kernels
OPTICS = """
[devices.camera]
driver = "external"
name = "studio_cam"
exposure_ms = 5.0
{camera}
[devices.screen]
driver = "external"
name = "studio_wall"
width_px = 1300
height_px = 1100
pixel_mm = 0.4
{screen}
"""
QUICK_SCREEN = "settle_ms = 10.0\nlinearise = false\nself_test = false\n"
CAMERA = """
[optics.camera]
width_px = 306
height_px = 256
pixel_um = 27.6
"""
# in the room the camera's pixels are 10 x 10 of the screen's
IN_THE_ROOM = """
[optics.camera]
width_px = 130
height_px = 110
pixel_um = 65.0

[devices]
board = "tcp://127.0.0.1:1"
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder into which pip has installed the package."""
    project = tmp_path_factory.mktemp("studio") / "project"
    shutil.copytree(SOURCE, project, ignore=shutil.ignore_patterns("__pycache__"))
    target = tmp_path_factory.mktemp("site")
    words = [
        "install",
        "--quiet",
        "--no-deps",
        "--no-index",
        "--no-build-isolation",
        "--target",
        target,
        project,
    ]
    subprocess.run([sys.executable, "-m", "pip", *map(str, words)], check=True, capture_output=True)
    return target


def started(site: Path, *words: object, **pipes: Any) -> subprocess.Popen[str]:
    """A command that finds the package."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(ROOT), str(site)))}
    command = [sys.executable, "-m", "membrane_ctrl", *map(str, words)]
    return subprocess.Popen(command, env=environment, cwd=site.parent, text=True, **pipes)


def output(site: Path, *words: object, code: int = 0) -> str:
    process = started(site, *words, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    printed, wrong = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == code, printed + wrong
    return printed


def test_no_module_of_the_product_names_them() -> None:
    names = ("studio_cam", "studio_wall", "studio_optics")
    texts = [
        path
        for top in ("membrane_ctrl", "firmware_iface", "tuning", "docs")
        for path in (ROOT / top).rglob("*")
    ]
    suffixes = {".py", ".toml", ".md", ".txt"}
    found = [
        path
        for path in texts
        if path.suffix in suffixes and any(name in path.read_text() for name in names)
    ]
    assert found == []


def test_they_are_listed_and_explained(site: Path) -> None:
    listed = json.loads(output(site, "devices", "--json"))["devices"]
    kinds = {device["name"].partition(",")[0]: device["kind"] for device in listed}
    assert kinds["studio_cam"] == "camera driver"
    assert kinds["studio_wall"] == "screen driver"
    assert '[devices.screen] driver = "external"' in output(
        site, "config", "explain", "studio_wall"
    )


def test_check_measures_the_screen_with_the_camera(site: Path, tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(IN_THE_ROOM + OPTICS.format(camera="", screen=""))
    report = json.loads(output(site, "check", path, "--json", code=4))  # there is no board
    (probe,) = (each for each in report["devices"] if each["role"] == "camera")
    assert probe["problem"] == ""
    assert probe["identity"].startswith("Studio camera S1")
    assert probe["device"] == "studio camera, studio wall"
    assert "screen settles in" in probe["notes"]
    assert "gamma 1.0" in probe["notes"]
    path.write_text(IN_THE_ROOM + OPTICS.format(camera="exposure = 3", screen=""))
    output(site, "check", path, "--json", code=2)


class Hold:
    """A hold of the simulated mirror with these instruments and optics."""

    def __init__(self, site: Path, folder: Path, camera: str = "") -> None:
        self._logs = folder / "logs"
        config = folder / "lab.toml"
        config.write_text(INSTRUMENTS + CAMERA + OPTICS.format(camera=camera, screen=QUICK_SCREEN))
        words = ["hold", "--twin", "--devices", config, "--logs", self._logs, "--json"]
        self._console = folder / "console.txt"
        with self._console.open("w") as console:
            self._process = started(site, *words, stdout=subprocess.PIPE, stderr=console)

    def until(self, happened: Callable[[list[dict[str, Any]]], bool]) -> None:
        give_up_s = time.monotonic() + PATIENCE_S
        while not happened(self.events()):
            assert time.monotonic() < give_up_s, self.events()[-5:]
            assert self._process.poll() is None, self._console.read_text()
            time.sleep(0.2)

    def events(self) -> list[dict[str, Any]]:
        paths = list(self._logs.glob("*/events.jsonl"))
        lines = paths[0].read_text().splitlines() if paths else []
        return [json.loads(line) for line in lines if line.endswith("}")]

    def end(self) -> dict[str, Any]:
        """Stop it; returns the summary."""
        self._process.send_signal(signal.SIGINT)
        printed, _ = self._process.communicate(timeout=PATIENCE_S)
        summary: dict[str, Any] = json.loads(printed)
        return summary

    def kill(self) -> None:
        self._process.kill()
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._process.wait()


def has_reported(events: list[dict[str, Any]], words: str) -> bool:
    """Whether the acquisition has reported this."""
    return any(
        words in str(event.get("message", "")) for event in events if event["kind"] == "acquisition"
    )


def measured(events: list[dict[str, Any]]) -> int:
    """Number of reports of a good cycle: one each time that cycles become good."""
    return sum(event["kind"] == "acquisition" and event["message"] == "ok" for event in events)


def test_the_simulated_mirror_is_measured_through_them(site: Path, tmp_path: Path) -> None:
    hold = Hold(site, tmp_path)
    try:
        hold.until(lambda events: has_reported(events, "camera: Studio camera S1"))
        hold.until(lambda events: measured(events) > 0)
        hold.until(lambda events: any(event.get("state") == "hold" for event in events))
        (identity,) = (
            event["message"] for event in hold.events() if has_reported([event], "Studio camera")
        )
        assert str(os.getpid()) not in identity
        summary = hold.end()
    finally:
        hold.kill()
    assert summary["exit"] == "interrupted"
    assert summary["faults"] == []
    assert summary["cycles"] > 0


def test_a_camera_that_fails_and_hangs_is_named_and_replaced_while_the_hold_continues(
    site: Path, tmp_path: Path
) -> None:
    faults = 'faults = ["raise", "exit", "size", "hang"]\nfault_every = 20'
    hold = Hold(site, tmp_path, faults)
    try:
        for words in ("RuntimeError: bus error 5", "SystemExit: 3", "gave 306 x 255 uint8"):
            hold.until(lambda events, words=words: has_reported(events, words))  # type: ignore[misc]
        hold.until(lambda events: any(event["kind"] == "child_silent" for event in events))
        restarted = "child_restarted"
        hold.until(lambda events: any(event["kind"] == restarted for event in events))
        before = [event["kind"] for event in hold.events()].index(restarted)
        hold.until(lambda events: measured(events[before:]) > 0)
        summary = hold.end()
    finally:
        hold.kill()
    assert summary["exit"] == "interrupted"
    assert summary["faults"] == []
    assert summary["ticks"] > 0
