"""All processes of a hold are killed at once: the service sends one alarm."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from patience import slow_machine

from tests.web.test_page import served

# in place of Apprise: a service that writes the titles of its messages into a file
APPRISE = """
import os

class Target:
    def __init__(self, path):
        self.path = path

    def notify(self, title, body, notify_type):
        with open(self.path, "a") as file:
            file.write(title + "\\n")
        return True

class Apprise:
    @staticmethod
    def instantiate(url):
        return Target(url.removeprefix("file://"))
"""


def kill_all(pid: int) -> None:
    """Kill a hold and its children, but for Python's process that frees shared memory."""
    hold = psutil.Process(pid)
    for process in (hold, *hold.children(recursive=True)):  # without the twin it would trip
        with contextlib.suppress(psutil.NoSuchProcess):
            if not any("resource_tracker" in word for word in process.cmdline()):
                process.kill()


async def until(true: Callable[[], object]) -> None:
    async with asyncio.timeout(120.0):
        while not true():  # noqa: ASYNC110
            await asyncio.sleep(0.2)


@pytest.mark.real_time
async def test_a_hold_that_vanishes_with_all_its_processes_is_reported_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stub = tmp_path / "stub"
    stub.mkdir()
    (stub / "apprise.py").write_text(APPRISE)
    monkeypatch.setenv("PYTHONPATH", f"{stub}:{os.environ.get('PYTHONPATH', '')}")
    phone, logs = tmp_path / "phone.txt", tmp_path / "logs"
    (tmp_path / "urls.txt").write_text(f"file://{phone}\n")
    (tmp_path / "lab.toml").write_text(
        f"{slow_machine()}[twin]\nport = 0\n[shape]\nenabled = false\n"
        '[alarms]\nurls_file = "urls.txt"\n'
    )
    words = ["hold", "--twin", "--no-service", "--config", tmp_path / "lab.toml", "--logs", logs]
    async with served(logs):
        hold = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "membrane_ctrl",
            *map(str, words),
            stdin=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            # the service sends for this run once its line is there
            sent = "*/alarms.jsonl"
            await until(lambda: any('"service"' in f.read_text() for f in logs.glob(sent)))
            await until(lambda: any(f.stat().st_size for f in logs.glob("*/events.jsonl")))
        finally:
            kill_all(hold.pid)
            await hold.wait()
        await until(phone.exists)
        await asyncio.sleep(3.0)  # a second message would come within this time
    titles = phone.read_text().splitlines()
    # a busy machine may have made the hold itself raise others before
    assert titles.count("membrane-ctrl critical raised: control_gone") == 1
    assert not any("run_ended" in title for title in titles)
