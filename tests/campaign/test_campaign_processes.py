"""Faults that need real processes and sockets: stopped, killed, cut off, without disk space, two at
once.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from campaign import write_processes
from campaign_bench import PATIENCE_S, make_plant, running
from process_cases import PROCESS_CASES, ProcessCase
from process_run import ProcessResult, lost_telemetry_s, missing, pump_stood_s, run_process_case

from membrane_ctrl.model.errors import Exit
from membrane_ctrl.run_files.latched_fault import NAME, LatchedFile

CAMERA = """
[twin]
port = 0
[optics.camera]
width_px = 306
height_px = 256
pixel_um = 27.6
[shape]
period_s = 1.0
"""


@pytest.fixture(scope="module")
def results() -> Iterator[list[ProcessResult]]:
    """Filled by the cases; written to the document if none was left out."""
    found: list[ProcessResult] = []
    yield found
    if len(found) == len(PROCESS_CASES):
        write_processes(found)


def start_again(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    arguments = (
        "hold",
        "--config",
        str(folder / "lab.toml"),
        "--logs",
        str(folder / "logs"),
        "--duration",
        "1s",
    )
    return subprocess.run(
        [sys.executable, "-m", "membrane_ctrl", *arguments, *options],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )


@pytest.mark.real_time
async def test_a_stopped_process_stops_the_pump_and_what_was_latched_keeps_the_next_hold_down(
    tmp_path: Path,
) -> None:
    plant = make_plant()
    async with running(tmp_path, plant) as run:
        stopped_s = run.signal(signal.SIGSTOP)
        assert await pump_stood_s(plant, stopped_s) <= 0.5 + 2 * plant.longest_gap_s
        run.signal(signal.SIGCONT)
        assert await run.ended() == Exit.SAFETY_TRIP
        assert not plant.pumping
        latched = LatchedFile(tmp_path / "logs").read()
        assert latched is not None
        assert latched.name == run.faults()[0]
        refused = await asyncio.to_thread(start_again, tmp_path)
        assert refused.returncode == Exit.DEVICE_FAILED
        assert (
            sum(line.startswith("membrane-ctrl: ") for line in refused.stderr.splitlines()) == 1
        )  # after progress
        assert latched.name in refused.stderr
        assert not plant.pumping


@pytest.mark.campaign
@pytest.mark.timeout(180)
@pytest.mark.parametrize("case", PROCESS_CASES, ids=lambda case: case.name.replace(" ", "_"))
async def test_a_fault_of_real_processes(
    case: ProcessCase, tmp_path: Path, results: list[ProcessResult]
) -> None:
    if why := missing(case):
        pytest.skip(why)
    result = await run_process_case(case, tmp_path)
    results.append(result)
    assert not result.violations


@pytest.mark.campaign
async def test_a_latched_hold_starts_again_once_a_person_clears_it(tmp_path: Path) -> None:
    async with running(tmp_path, make_plant()) as run:
        run.board.power_cycle()
        assert await run.ended() == Exit.SAFETY_TRIP
        assert (tmp_path / "logs" / NAME).exists()
        again = await asyncio.to_thread(start_again, tmp_path, "--clear-faults")
        assert again.returncode == Exit.DONE, again.stderr
    assert not (tmp_path / "logs" / NAME).exists()


@pytest.mark.campaign
async def test_after_a_kill_the_next_start_holds_again_only_if_the_resume_rule_allows_it(
    tmp_path: Path,
) -> None:
    plant = make_plant()
    async with running(tmp_path, plant) as run:
        await pump_stood_s(plant, run.signal(signal.SIGKILL))
        await run.process.wait()
        refused = await asyncio.to_thread(start_again, tmp_path)
        assert refused.returncode == Exit.DEVICE_FAILED
        assert "latched" in refused.stderr
        waited = await asyncio.to_thread(start_again, tmp_path, "--standby")
        assert waited.returncode == Exit.DONE, waited.stderr
        lab = tmp_path / "lab.toml"
        lab.write_text(lab.read_text() + '\n[resume]\nfaults = ["watchdog_tripped"]\n')
        again = await asyncio.to_thread(start_again, tmp_path)
        assert again.returncode == Exit.DONE, again.stderr
    newest = max(
        (path for path in (tmp_path / "logs").iterdir() if path.is_dir()),
        key=lambda path: path.name,
    )
    start = json.loads((newest / "events.jsonl").read_text().splitlines()[0])
    assert "cleared" in start["message"]


@pytest.mark.campaign
async def test_the_safe_state_writer_needs_no_hold(tmp_path: Path) -> None:
    plant = make_plant()
    async with running(tmp_path, plant) as run:
        run.signal(signal.SIGKILL)
        await run.process.wait()
        done = await asyncio.to_thread(
            subprocess.run,
            [sys.executable, "-m", "membrane_ctrl", "safe", str(tmp_path / "lab.toml")],
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
        assert done.returncode == Exit.DONE, done.stderr
        assert "pump 0" in done.stderr
        assert not plant.pumping


def events_of(folder: Path) -> list[dict[str, object]]:
    lines = [
        line
        for path in folder.glob("logs/*/events.jsonl")
        for line in path.read_text().splitlines()
    ]
    return [json.loads(line) for line in lines if line.endswith("}")]


def wait_for_event(folder: Path, patience_s: float, **words: object) -> None:
    give_up_s = time.monotonic() + patience_s
    while not any(words.items() <= event.items() for event in events_of(folder)):
        assert time.monotonic() < give_up_s, f"no {words}"
        time.sleep(0.1)


@pytest.mark.campaign
@pytest.mark.timeout(240)
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "stopped"])
def test_the_hold_continues_without_its_camera_until_another_replaces_it(
    tmp_path: Path, number: signal.Signals
) -> None:
    """The process that owns screen and camera dies, or is stopped until its 60 s are over."""
    (tmp_path / "lab.toml").write_text(CAMERA)
    words = ("--twin", "--config", str(tmp_path / "lab.toml"), "--logs", str(tmp_path / "logs"))
    with subprocess.Popen(
        [sys.executable, "-m", "membrane_ctrl", "hold", *words], stderr=subprocess.DEVNULL
    ) as hold:
        try:
            wait_for_event(tmp_path, PATIENCE_S, kind="state", state="hold")
            wait_for_event(tmp_path, PATIENCE_S, kind="acquisition", state="running")
            children = psutil.Process(hold.pid).children()
            os.kill(max(children, key=lambda child: child.nice()).pid, number)
            wait_for_event(tmp_path, 120.0, kind="child_restarted", child="acquisition")
            wait_for_event(tmp_path, PATIENCE_S, kind="acquisition", state="preparing")
            assert hold.poll() is None
            hold.send_signal(signal.SIGINT)
            assert hold.wait(PATIENCE_S) == Exit.INTERRUPTED
        finally:
            hold.kill()
    assert not psutil.wait_procs(children, 20.0)[1]
    kinds = [event["kind"] for event in events_of(tmp_path)]
    assert "fault" not in kinds
    assert ("child_silent" in kinds) == (number == signal.SIGSTOP)
    (run_dir,) = (path for path in (tmp_path / "logs").iterdir() if path.is_dir())
    assert lost_telemetry_s(run_dir) == 0.0
