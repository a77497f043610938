"""`hold --twin` as its user runs it: a process, a socket, signals, and what is on the disk
afterwards.
"""

from __future__ import annotations

import io
import json
import signal
import socket
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import numpy as np
import psutil
import pytest
from patience import slow_machine
from pymodbus.client import ModbusTcpClient
from rerun.chunk import RrdReader

from firmware_iface.register_map import load_default_map
from membrane_ctrl.cli import run
from membrane_ctrl.measure.capture_set import read_head

pytestmark = pytest.mark.real_time

COMMAND = [sys.executable, "-m", "membrane_ctrl"]
PATIENCE_S = 60.0
SMALL_CAMERA = "width_px = 306\nheight_px = 256\npixel_um = 27.6\n"


def write_config(folder: Path, text: str = "", port: int = 0) -> Path:
    path = folder / "lab.toml"
    path.write_text(f"{slow_machine()}[twin]\nport = {port}\n{text}")
    return path


def hold(folder: Path, *more: str, config: str = "[shape]\nenabled = false\n") -> list[str]:
    return [
        *COMMAND,
        "hold",
        "--twin",
        "--config",
        str(write_config(folder, config)),
        "--logs",
        str(folder / "logs"),
        "--name",
        "test",
        *more,
    ]


def wait_for(what: Callable[[], bool]) -> None:
    give_up_s = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < give_up_s, "waited in vain"
        time.sleep(0.05)


def run_dirs(folder: Path) -> list[Path]:
    """Folders of runs; beside them is the control port's socket."""
    return [path for path in (folder / "logs").glob("*") if path.is_dir()]


def run_dir(folder: Path) -> Path:
    (found,) = run_dirs(folder)
    return found


def events(folder: Path) -> list[dict[str, object]]:
    path = run_dir(folder) / "events.jsonl" if run_dirs(folder) else None
    if path is None or not path.exists():
        return []
    return [json.loads(line) for line in path.read_text().splitlines() if line.endswith("}")]


def reached(folder: Path, state: str) -> bool:
    return any(e["kind"] == "state" and e["state"] == state for e in events(folder))


def rows_in(folder: Path) -> int:
    return sum(
        chunk.to_record_batch().num_rows
        for path in run_dir(folder).glob("*.rrd")
        for chunk in RrdReader(path)
        .stream()
        .filter(content="/tick/lateness")  # there in every state
    )


def board_of(folder: Path) -> ModbusTcpClient:
    board = tomllib.loads((run_dir(folder) / "config.toml").read_text())["devices"]["board"]
    host, port = board.removeprefix("tcp://").split(":")
    client = ModbusTcpClient(host, port=int(port), timeout=20)
    assert client.connect()
    return client


def read_board(client: ModbusTcpClient) -> dict[str, float]:
    block = load_default_map().block("sensors")
    reply = client.read_holding_registers(block.address, count=block.count, device_id=1)
    assert not reply.isError()
    return block.decode(reply.registers)


@pytest.fixture
def running(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        hold(tmp_path), stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    yield process
    if process.poll() is None:
        process.kill()
    process.communicate()


def test_a_short_hold_with_the_camera_loop_leaves_everything_it_should(tmp_path: Path) -> None:
    camera = f"start_error_um = -2.0\n[optics.camera]\n{SMALL_CAMERA}[shape]\nperiod_s = 1.0\n"
    words = hold(tmp_path, "--duration", "45s", config=camera)  # kernels may have to be compiled
    process = subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        wait_for(lambda: reached(tmp_path, "hold"))
        assert run(["ctl", "capture", "--socket", str(tmp_path / "logs" / "control.sock")]) == 0
        stderr = process.communicate(timeout=240)[1]
    finally:
        process.kill()
    assert process.returncode == 0, stderr
    (captured,) = (event for event in events(tmp_path) if event["kind"] == "capture")
    assert captured["verdict"] == "ok"
    head = read_head(run_dir(tmp_path) / str(captured["set"]))
    assert (head.kind, len(head.patterns)) == ("full", 18)
    assert (
        np.isfinite(head.displacement_um).mean() > 0.5
    )  # none for a frame during which the machine was paused
    assert abs(np.nanmean(head.displacement_um)) < 5.0
    summary = json.loads((run_dir(tmp_path) / "summary.json").read_text())
    assert summary["exit"] == "done"
    assert [s["state"] for s in summary["states"]] == [
        "check",
        "inflate",
        "settle",
        "hold",
        "lower",
    ]
    assert summary["cycles"] >= 3
    assert summary["cycles_rejected"] == 0
    assert 0 < summary["true_std_um"] < 0.5
    assert summary["in_band_1s_fraction"] == 1.0
    for key in (
        "true_bias_um",
        "lateness_ms",
        "ticks",
        "missed_ticks",
        "cycle_latency_ms",
        "sag_error_um",
    ):
        assert summary[key] is not None
    config = tomllib.loads((run_dir(tmp_path) / "config.toml").read_text())
    assert config["optics"]["camera"]["width_px"] == 306
    assert config["loop"]["rate_hz"] == 50.0
    assert str(run_dir(tmp_path)) in stderr
    assert "Traceback" not in stderr
    assert rows_in(tmp_path) > 800


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_the_whole_group_stops_cleanly_with_130(
    tmp_path: Path, running: subprocess.Popen[str], number: signal.Signals
) -> None:
    """Ctrl-C and `timeout` reach the children first; the bench and the recorder must survive it."""
    wait_for(lambda: reached(tmp_path, "inflate"))
    for process in psutil.Process(running.pid).children(recursive=True):
        process.send_signal(number)
    running.send_signal(number)
    _, stderr = running.communicate(timeout=PATIENCE_S)
    assert running.returncode == 130
    summary = json.loads((run_dir(tmp_path) / "summary.json").read_text())
    assert summary["exit"] == "interrupted"
    assert [e["state"] for e in events(tmp_path) if e["kind"] == "state"][-1] == "lower"
    assert not [e for e in events(tmp_path) if e["kind"] in {"fault", "child_ended"}]
    assert "Traceback" not in stderr


def test_another_client_reads_along_and_sigkill_stops_the_pump_and_loses_nothing(
    tmp_path: Path, running: subprocess.Popen[str]
) -> None:
    wait_for(lambda: reached(tmp_path, "inflate"))
    children = psutil.Process(running.pid).children(recursive=True)
    client = board_of(tmp_path)
    wait_for(lambda: read_board(client)["pump_readback_fraction"] > 0.1)
    running.kill()
    running.wait()
    wait_for(lambda: read_board(client)["watchdog_tripped"] == 1)
    assert read_board(client)["pump_readback_fraction"] == 0.0
    client.close()
    psutil.wait_procs(children, timeout=PATIENCE_S)
    assert not [
        child for child in children if child.is_running() and child.status() != psutil.STATUS_ZOMBIE
    ]
    assert json.loads((run_dir(tmp_path) / "summary.json").read_text())["exit"] == "killed"
    assert events(tmp_path)[-1]["kind"] == "end"
    assert rows_in(tmp_path) > 50


def run_refused(arguments: list[str], exit_code: int) -> str:
    """In the test's own process: Python's start takes longer than a refusal."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = run(arguments)
    assert code == exit_code, err.getvalue()
    *progress, line = err.getvalue().strip().splitlines()
    assert line.startswith("membrane-ctrl: "), line
    assert not [other for other in progress if other.startswith("membrane-ctrl: ")]
    assert out.getvalue() == ""
    return line


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ("[loop]\nrate_khz = 1\n", ["loop.rate_khz", "rate_hz"]),
        (
            "[optics.geometry]\na_mm = 2.672\nb_mm = 2871.0\nalpha_deg = 80.9\n",
            ["optics.geometry.a_mm", "100"],
        ),
        ("[loop]\nsetpoint_um = 4000.0\n", ["setpoint_um", "limits"]),
    ],
)
def test_a_bad_configuration_is_one_line_and_leaves_nothing(
    tmp_path: Path, config: str, words: list[str]
) -> None:
    line = run_refused(hold(tmp_path, config=config)[3:], 2)
    assert "lab.toml" in line
    assert all(word in line for word in words)
    assert not (tmp_path / "logs").exists()


def test_hold_without_devices_names_the_missing_key(tmp_path: Path) -> None:
    assert "--twin" in run_refused(["hold", "--logs", str(tmp_path / "logs")], 2)
    assert not (tmp_path / "logs").exists()


def test_unknown_option_and_bad_duration_are_usage_errors(tmp_path: Path) -> None:
    assert "--bogus" in run_refused(["hold", "--bogus"], 2)
    assert "duration" in run_refused(["hold", "--twin", "--duration", "soon"], 2)


def test_a_busy_port_is_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        config = write_config(tmp_path, port=port)
        line = run_refused(
            ["hold", "--twin", "--config", str(config), "--logs", str(tmp_path / "logs")], 4
        )
    assert str(port) in line
    assert not (tmp_path / "logs").exists()


def test_a_run_folder_that_cannot_be_made_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "logs").write_text("in the way")
    line = run_refused(hold(tmp_path)[3:], 4)
    assert "logs" in line
    assert (tmp_path / "logs").read_text() == "in the way"


def test_a_full_disk_is_refused_before_anything_exists(tmp_path: Path) -> None:
    line = run_refused(hold(tmp_path, config="[recording]\nmin_free_mb = 1e9\n")[3:], 4)
    assert "free" in line
    assert not list(tmp_path.glob("logs/*"))


def test_an_address_without_a_device_is_a_device_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("membrane_ctrl.instruments.bench_connection._PATIENCE_S", 0.3)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    config = tmp_path / "lab.toml"
    config.write_text(f'[devices]\nboard = "tcp://127.0.0.1:{port}"\n')
    assert str(port) in run_refused(
        ["hold", "--config", str(config), "--logs", str(tmp_path / "logs")], 4
    )
    assert not (tmp_path / "logs").exists()


def test_the_served_twin_can_be_held_by_another_process(tmp_path: Path) -> None:
    config = write_config(tmp_path)
    twin = subprocess.Popen(
        [*COMMAND, "twin", "--config", str(config)], stderr=subprocess.PIPE, text=True
    )
    try:
        assert twin.stderr is not None
        listens = [twin.stderr.readline() for _ in range(2)][1]
        address = listens.split("listens on ")[1].split(",")[0]
        lab = tmp_path / "devices.toml"
        lab.write_text(slow_machine(address))
        checked = subprocess.run(
            [*COMMAND, "check", str(lab), "--json"],
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=True,
        )
        report = json.loads(checked.stdout)
        assert report["devices"][0]["identity"].startswith("membrane pump board")
        held = subprocess.run(
            [
                *COMMAND,
                "hold",
                "--config",
                str(lab),
                "--logs",
                str(tmp_path / "logs"),
                "--duration",
                "2s",
                "--json",
            ],
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
        assert held.returncode == 3, held.stderr  # two seconds are too short to hold
        assert "NEVER HELD: the duration was over in the state check" in held.stderr
        assert json.loads(held.stdout)["true_std_um"] is None  # no truth from a device
    finally:
        twin.send_signal(signal.SIGINT)
        twin.communicate(timeout=PATIENCE_S)
    assert twin.returncode == 130


def test_a_board_with_another_map_version_is_refused(tmp_path: Path) -> None:
    """A board that we cannot drive is detected before a run folder exists."""
    server = subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("wrong_board.py"))],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert server.stdout is not None
        port = int(server.stdout.readline())
        config = tmp_path / "lab.toml"
        config.write_text(slow_machine(f"tcp://127.0.0.1:{port}"))
        line = run_refused(["hold", "--config", str(config), "--logs", str(tmp_path / "logs")], 4)
        assert "map version" in line
        assert not (tmp_path / "logs").exists()
    finally:
        server.terminate()
        server.communicate(timeout=PATIENCE_S)


def nobodys_shared_memory() -> set[Path]:
    """Another run of the tests may be using some."""
    found = set(Path("/dev/shm").glob("psm_*"))
    for process in psutil.process_iter():
        try:
            found -= {Path(mapped.path) for mapped in process.memory_maps()}
        except psutil.Error:  # it has just ended, or we may not inspect it
            continue
    return found


def test_no_shared_memory_is_left_behind(tmp_path: Path) -> None:
    before = nobodys_shared_memory()
    done = subprocess.run(
        hold(tmp_path, "--duration", "2s"), capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 3, "two seconds are too short to hold"
    assert "NEVER HELD: the duration was over in the state check" in done.stderr
    assert "leaked" not in done.stderr
    wait_for(lambda: not nobodys_shared_memory() - before)


def test_sigterm_while_the_processes_start_cleans_up(running: subprocess.Popen[str]) -> None:
    """The twin is there before the recorder and the others: none of them may be left, nor the
    signal lost.
    """
    wait_for(lambda: len(psutil.Process(running.pid).children()) > 1)
    children = psutil.Process(running.pid).children()
    running.send_signal(signal.SIGTERM)
    _, stderr = running.communicate(timeout=PATIENCE_S)
    assert running.returncode == 130
    assert "Traceback" not in stderr
    assert "leaked" not in stderr
    assert psutil.wait_procs(children, PATIENCE_S)[1] == []
