"""The catalogue of all runs, read by Rerun's own client in another process."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from membrane_ctrl.cli import run as command
from membrane_ctrl.review.viewer.command import PROPERTIES
from tests.support.review_runs import set_summary, written

HELD = {
    "std_um": 0.1234567,
    "in_band": 0.98,
    "held_s": 300.0,
    "faults_s": 36.0,
    "paused_s": 0.0,
    "moving_s": 1.0,
}


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    logs = tmp_path_factory.mktemp("catalogue") / "logs"
    for number in (1, 2):
        written(logs, 0.1, None, number, f"2026112{number}T180000Z-night")
    folder = logs / "20261122T180000Z-night"
    set_summary(folder, held=HELD, duration_s=360.0)
    with (folder / "events.jsonl").open("a") as file:
        file.write('{"mono_s": 300.0, "kind": "fault", "name": "laser_lost"}\n')
        file.write('{"mono_s": 1.0, "kind": "geometry", "hash": "ae735b0b", "file": null}\n')
    (logs / "20261123T180000Z-broken").mkdir()
    (logs / "20261123T180000Z-broken" / "events.jsonl").touch()
    return logs


CLIENT = """
import json, sys, time
from rerun.catalog import CatalogClient

runs = CatalogClient(sys.argv[1]).get_dataset("runs")
for _ in range(600):
    table = runs.segment_table().to_arrow_table()
    if sum("timeline" in layers for layers in table["rerun_layer_names"].to_pylist()) == 3:
        break
    time.sleep(0.05)
names = [name for name in table.schema.names if name.startswith("property:run:")]
rows = table.select(["rerun_segment_id", *names]).to_pylist()
night = runs.filter_segments("20261122T180000Z-night")
drawn = night.filter_contents(["/overview/loop/error"]).reader(index="run_time")
print(json.dumps({"rows": rows, "seconds": drawn.to_arrow_table().num_rows}))
"""


@pytest.mark.usefixtures("signals_are_heeded")
def test_other_programs_read_the_catalogue_on_this_machine_until_it_is_ended(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    arguments = [
        sys.executable,
        "-m",
        "membrane_ctrl",
        "review",
        "--all",
        "--web",
        "--logs",
        str(logs),
    ]
    with subprocess.Popen(arguments, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        url = next(line for line in process.stderr if "rerun+http" in line).split()[-1]
        served = json.loads(
            subprocess.check_output([sys.executable, "-c", CLIENT, url], text=True, timeout=60)
        )
        family = [
            psutil.Process(process.pid),
            *psutil.Process(process.pid).children(recursive=True),
        ]
        places = {
            c.laddr.ip
            for p in family
            for c in p.net_connections()
            if c.status == psutil.CONN_LISTEN
        }
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0
    assert places == {"127.0.0.1"}
    assert not list(tmp_path.iterdir())
    assert not any(each.is_running() for each in family)
    assert served["seconds"] == 360
    rows = {row.pop("rerun_segment_id")[:8]: row for row in served["rows"]}
    night = {
        name.removeprefix("property:run:"): cell[0]
        for name, cell in rows["20261122"].items()
        if cell
    }
    assert len(night.pop("configuration")) == 8
    assert night == {
        "started_utc": "2026-11-21 18:00:00",
        "duration_s": 360.0,
        "held_s": 300.0,
        "std_um": 0.1235,
        "in_band": 0.98,
        "faults": 1,
        "faults_share": 0.1,
        "kp_per_s": 0.61,
        "ti_s": 6.5,
        "geometry": "ae735b0b",
        "exit": "done",
        "marks": 0,
    }
    learned = {"pump_scale", "pump_sigma"}  # nothing was
    assert set(rows["20261122"]) == {f"property:run:{name}" for name in PROPERTIES.keys() - learned}
    assert rows["20261121"]["property:run:std_um"] is None  # of a version without it
    assert rows["20261123"]["property:run:exit"] == ["open"]


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        (["--all", "last"], "or give --all"),
        ([], "or give --all"),
        (["--all", "--at", "03:12"], "omit --bind, --at"),
        (["--all", "--web", "--bind", "0.0.0.0"], "this machine only"),
        (["--all"], "no such folder"),
    ],
)
def test_requests_that_contradict_each_other_are_refused(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    asked: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command(["review", *asked]) == 2
    assert message in capsys.readouterr().err
