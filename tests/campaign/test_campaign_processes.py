"""What can only go wrong with real processes and sockets: stopped, killed, cut off, two things at once."""

from __future__ import annotations

import asyncio
import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from campaign_bench import PATIENCE_S, WATCHDOG_S, Run, WatchedPlant, make_plant, running

from membrane_ctrl.errors import Exit
from membrane_ctrl.latched import NAME, LatchedFile

pytestmark = pytest.mark.real_time


def start_again(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    arguments = ("hold", "--config", str(folder / "lab.toml"), "--logs", str(folder / "logs"), "--duration", "1s")
    return subprocess.run(
        [sys.executable, "-m", "membrane_ctrl", *arguments, *options],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )


def exit_of(folder: Path) -> str:
    (summary,) = folder.glob("logs/*/summary.json")
    return str(json.loads(summary.read_text())["exit"])


async def assert_pump_stopped_in_time(run: Run, plant: WatchedPlant, since_s: float) -> None:
    """Within a watchdog period of the last feed, and of the board's own longest pause."""
    give_up = asyncio.get_running_loop().time() + PATIENCE_S
    while plant.pumping:
        assert asyncio.get_running_loop().time() < give_up
        await asyncio.sleep(0.02)
    assert plant.pump_ran_on_s(since_s) <= WATCHDOG_S + 2 * plant.longest_gap_s


async def test_a_stopped_process_stops_the_pump_and_what_was_latched_keeps_the_next_hold_down(tmp_path: Path) -> None:
    plant = make_plant()
    async with running(tmp_path, plant) as run:
        stopped_s = run.signal(signal.SIGSTOP)
        await assert_pump_stopped_in_time(run, plant, stopped_s)
        run.signal(signal.SIGCONT)
        assert await run.ended() == Exit.SAFETY_TRIP
        assert not plant.pumping
        assert run.faults()[0] in {"watchdog_tripped", "board_fault", "device_silent", "displacement_frozen", "late"}
        latched = LatchedFile(tmp_path / "logs").read()
        assert latched is not None
        assert latched.name == run.faults()[0]
        refused = await asyncio.to_thread(start_again, tmp_path)
        assert refused.returncode == Exit.DEVICE_FAILED
        assert len(refused.stderr.strip().splitlines()) == 1
        assert latched.name in refused.stderr
        assert not plant.pumping
        again = await asyncio.to_thread(start_again, tmp_path, "--clear-faults")
        assert again.returncode == Exit.DONE, again.stderr
    assert not (tmp_path / "logs" / NAME).exists()


@pytest.mark.campaign
async def test_a_killed_process_stops_the_pump_and_leaves_a_readable_run(tmp_path: Path) -> None:
    plant = make_plant()
    async with running(tmp_path, plant) as run:
        killed_s = run.signal(signal.SIGKILL)
        await assert_pump_stopped_in_time(run, plant, killed_s)
    assert exit_of(tmp_path) == "killed"


@pytest.mark.campaign
async def test_the_hold_goes_on_without_its_recorder_and_says_so(tmp_path: Path) -> None:
    plant = make_plant()
    async with running(tmp_path, plant) as run:
        run.recorder().kill()
        await run.until(lambda: any(event["kind"] == "child_restarted" for event in run.events))
        assert plant.pumping
        assert run.process.returncode is None
        run.signal(signal.SIGINT)
        assert await run.ended() == Exit.INTERRUPTED
    assert not plant.pumping


@pytest.mark.campaign
async def test_a_board_that_restarts_is_not_used_further(tmp_path: Path) -> None:
    plant = make_plant()
    async with running(tmp_path, plant) as run:
        run.board.power_cycle()
        assert not plant.pumping
        assert await run.ended() == Exit.SAFETY_TRIP
        assert run.faults() == ["link_lost"]
    assert not plant.pumping


@pytest.mark.campaign
async def test_a_network_that_is_cut_stops_the_pump(tmp_path: Path) -> None:
    plant = make_plant()
    async with running(tmp_path, plant) as run:
        run.board.faults.hang_up = True
        await run.until(lambda: not plant.pumping)
        run.board.faults.hang_up = False
        await run.ended()
        assert run.faults()[0] == "link_lost"
    assert not plant.pumping


@pytest.mark.campaign
async def test_a_board_that_answers_no_more_stops_the_pump(tmp_path: Path) -> None:
    plant = make_plant()
    async with running(tmp_path, plant) as run:
        run.board.faults.silent = True
        await run.until(lambda: not plant.pumping)
        run.board.faults.silent = False
        await run.ended()
        assert run.faults()[0] in {"device_silent", "link_lost"}


@pytest.mark.campaign
async def test_recorder_dead_and_network_cut_at_once(tmp_path: Path) -> None:
    plant = make_plant()
    async with running(tmp_path, plant) as run:
        run.recorder().kill()
        run.board.faults.hang_up = True
        await run.until(lambda: not plant.pumping)
        run.board.faults.hang_up = False
        await run.ended()
    latched = LatchedFile(tmp_path / "logs").read()
    assert latched is not None
    assert latched.name == "link_lost"


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
