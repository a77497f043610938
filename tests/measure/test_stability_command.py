"""`stability` from the command line: against the film's known motion, with bad sets, and its
errors.
"""

from __future__ import annotations

import csv
import json
import shutil
import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tomli_w
from rerun.chunk import RrdReader

from membrane_ctrl.cli import run
from membrane_ctrl.config.optics import SigmasConfig

pytestmark = pytest.mark.usefixtures("undrawn")  # but for `result`, which is made before
SETS, INTERVAL_S, DRIFT_UM_PER_S = 13, 60.0, 0.02


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run over twelve minutes in which the film sinks by 1.2 µm a minute."""
    folder = tmp_path_factory.mktemp("sets") / "run"
    motion = [
        "--sets",
        str(SETS),
        "--interval-s",
        str(INTERVAL_S),
        "--drift-um-per-s",
        str(DRIFT_UM_PER_S),
    ]
    assert run(["simulate", str(folder), "--shrink", "12", *motion]) == 0
    return folder


@pytest.fixture
def spoiled(made: Path, tmp_path: Path) -> Path:
    """Its first four sets, to be spoiled."""
    for name in ("0000", "0001", "0002", "0003"):
        shutil.copytree(made / name, tmp_path / "run" / name)
    return tmp_path / "run"


@pytest.fixture(scope="module")
def result(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the analysis of all of it leaves."""
    out = tmp_path_factory.mktemp("result") / "deep" / "out"
    points = ["--point", "rim=474,0", "--point", "vertex=0,0"]
    assert (
        run(["stability", str(made), "--out", str(out), "--trials", "20", "--rerun", *points]) == 0
    )
    return out


def table_of(out: Path) -> dict[str, Any]:
    table: dict[str, Any] = json.loads((out / "stability.json").read_text())
    return table


def analysed(folder: Path, out: Path, *options: str) -> tuple[int, dict[str, Any]]:
    """Exit code and stability.json."""
    code = run(["stability", str(folder), "--out", str(out), "--trials", "20", *options])
    return code, table_of(out)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def keep_two(folder: Path) -> None:
    """Fewer sets where two will do."""
    for name in ("0002", "0003"):
        shutil.rmtree(folder / name)


def test_a_sinking_film(made: Path, result: Path) -> None:
    table = table_of(result)
    assert table["schema"] == "membrane-stability/1"
    assert table["sets"] == {"found": 13, "used": 13, "degraded": 0, "bad": 0, "bad_sets": []}
    # the full set's middle is half a second after the start of its clock, the others' 0.35 s
    assert table["duration_s"] == pytest.approx((SETS - 1) * INTERVAL_S, abs=0.5)
    sunk_um = np.array([float(row["displacement_um"]) for row in rows(result / "series.csv")])
    rim_um = np.array([float(row["rim_um"]) for row in rows(result / "series.csv")])
    truth = np.load(made / "0000" / "truth.npz")
    share = truth["h_per_sag"][len(truth["y_mm"]) // 2, np.argmin(np.abs(truth["x_mm"] - 474))]
    assert np.abs(rim_um - rim_um[0] - share * (sunk_um - sunk_um[0])).max() < 0.25
    assert table["points"]["rim"]["sd_um"] == pytest.approx(rim_um.std(ddof=1), rel=1e-6)
    assert table["points"]["rim"]["peak_to_peak_um"] == pytest.approx(np.ptp(rim_um), rel=1e-6)
    assert table["points"]["vertex"]["sd_um"] == pytest.approx(0, abs=1e-9)
    assert table["sd_um"]["max"] == pytest.approx(rim_um.std(ddof=1), rel=0.02)


def test_pairs_of_every_set(result: Path) -> None:
    table = table_of(result)
    minute, ten = table["pairs"]
    assert (minute["lag_s"], minute["count"]) == (60.0, SETS - 1)
    assert (ten["lag_s"], ten["count"]) == (600.0, SETS - 10)
    assert ten["change_rms_um"]["mean"] == pytest.approx(
        10 * minute["change_rms_um"]["mean"], rel=0.05
    )
    # noise of 1/144 of the real sensor's pixels; the geometry's 12 µm cancel
    assert 0.02 < minute["rmse_um"]["mean"] < 0.08
    assert table["rmse_um"]["mean"] > 100 * ten["rmse_um"]["mean"]
    listed = rows(result / "pairs.csv")
    assert len(listed) == minute["count"] + ten["count"]
    assert all(0 < float(row["rmse_mean_um"]) <= float(row["rmse_max_um"]) for row in listed)
    assert (listed[-1]["earlier"], listed[-1]["later"]) == ("0002", "0012")


def test_files_and_pictures(result: Path) -> None:
    table = table_of(result)
    for name in ("stability.png", "zernike.png", "pairs.png"):
        assert cv2.imread(str(result / name)) is not None
    sd = np.load(result / "sd.npz")
    assert np.nanmean(sd["sd_um"]) == pytest.approx(table["sd_um"]["mean"])
    z4_um = np.array([float(row["z4_um"]) for row in rows(result / "series.csv")])
    assert z4_um.std(ddof=1) == pytest.approx(table["zernike"]["sd_um"][3], rel=1e-6)


def test_the_recording_holds_the_series(result: Path) -> None:
    entities = {chunk.entity_path for chunk in RrdReader(result / "stability.rrd").stream()}
    assert {
        "/stability/points_um",
        "/stability/zernike_um",
        "/stability/sd_um",
        "/stability/report",
    } <= entities
    assert {f"/stability/pictures/{name}" for name in ("stability", "zernike", "pairs")} <= entities


def test_a_recording_that_cannot_be_written(
    spoiled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out" / "stability.rrd").mkdir(parents=True)
    keep_two(spoiled)
    assert (
        run(["stability", str(spoiled), "--out", str(tmp_path / "out"), "--trials", "2", "--rerun"])
        == 2
    )
    assert "stability.rrd" in capsys.readouterr().err


def test_a_geometry_of_its_own(
    spoiled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    keep_two(spoiled)
    path = tmp_path / "geometry.toml"
    geometry = tomllib.loads((spoiled / "0000" / "capture.toml").read_text())["geometry"]
    covariance = {"names": ["a_mm"], "matrix": [[0.25]]}
    geometry["sigmas"] = dict.fromkeys(SigmasConfig().model_dump(), 0.0)
    path.write_text(
        tomli_w.dumps({"geometry": {**geometry, "a_mm": 2680.0}, "covariance": covariance})
    )
    _, own = analysed(spoiled, tmp_path / "own")
    code, table = analysed(spoiled, tmp_path / "out", "--geometry", str(path))
    assert code == 0
    assert (table["geometry"]["names"], table["geometry"]["sigmas"]) == (["a_mm"], [0.5])
    assert table["geometry"]["file"] == str(path)
    assert table["rmse_um"]["mean"] < 0.5 * own["rmse_um"]["mean"]
    assert abs(table["zernike"]["mean_um"][3] - own["zernike"]["mean_um"][3]) > 1


def test_runs_repeat_and_do_not_take_their_results_for_sets(
    spoiled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["stability", str(spoiled), "--trials", "20"]) == 0
    printed = capsys.readouterr()
    assert "4 of 4 used" in printed.out
    assert "no pairs" in printed.out  # of ten minutes
    assert (
        "no sigma is stated for any input" in printed.out
    )  # where the geometry's sigmas come from
    code, second = analysed(spoiled, tmp_path / "again", "--json")
    assert code == 0
    assert json.loads(capsys.readouterr().out) == second
    first = table_of(spoiled / "stability")
    assert second["sets"] == first["sets"]
    assert second["rmse_um"] == pytest.approx(first["rmse_um"], rel=1e-9)
    assert second["zernike"]["sd_um"] == pytest.approx(first["zernike"]["sd_um"], rel=1e-6)
    assert list(second["points"]) == ["A", "B", "C"]


def test_bad_sets_are_counted_and_named(
    spoiled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (spoiled / "0001" / "x_sin_1.png").unlink()
    small = cv2.imread(str(spoiled / "0002" / "x_sin_0.png"), cv2.IMREAD_UNCHANGED)[:-1]
    for file in (spoiled / "0002").glob("*.png"):
        cv2.imwrite(str(file), small)
    code, table = analysed(spoiled, tmp_path / "out")
    assert code == 0
    assert (table["sets"]["used"], table["sets"]["bad"]) == (2, 2)
    bad = {item["set"]: item["reason"] for item in table["sets"]["bad_sets"]}
    assert "x_sin_1.png is missing" in bad["0001"]
    assert "204 x 169" in bad["0002"]
    assert [row["verdict"] for row in rows(tmp_path / "out" / "series.csv")] == [
        "ok",
        "rejected",
        "rejected",
        "ok",
    ]
    printed = capsys.readouterr().err
    assert "skipped 0001" in printed
    assert "skipped 0002" in printed


def test_a_set_with_one_bad_frame_is_used_and_counted(spoiled: Path, tmp_path: Path) -> None:
    shutil.copy(spoiled / "0002" / "y_sin_1.png", spoiled / "0002" / "y_sin_2.png")
    code, table = analysed(spoiled, tmp_path / "out")
    assert code == 0
    assert (table["sets"]["used"], table["sets"]["degraded"], table["sets"]["bad"]) == (4, 1, 0)


def test_a_folder_that_is_no_set(spoiled: Path, tmp_path: Path) -> None:
    (spoiled / "0001" / "capture.toml").unlink()
    code, table = analysed(spoiled, tmp_path / "out")
    assert code == 0
    assert [item["set"] for item in table["sets"]["bad_sets"]] == ["0001"]


def test_two_sizes(spoiled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = spoiled / "0002" / "capture.toml"
    table = tomllib.loads(path.read_text())
    table["camera"]["width_px"] = 300
    path.write_text(tomli_w.dumps(table))
    assert run(["stability", str(spoiled), "--out", str(tmp_path / "out")]) == 2
    printed = capsys.readouterr().err.strip().splitlines()
    assert len(printed) == 1
    assert "0002" in printed[0]
    assert "300 x 170" in printed[0]
    assert "204 x 170" in printed[0]
    assert not (tmp_path / "out").exists()


def test_no_set_gives_a_figure(
    spoiled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree(spoiled / "0000")  # the reference of all
    for options in ([], ["--out", str(tmp_path / "out")]):  # what the first leaves behind is no set
        assert run(["stability", str(spoiled), *options]) == 3
        assert "none of the 3 sets" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["nowhere"], "no such run"),
        (["empty"], "holds no capture sets"),
        (["run/0000"], "is itself a capture set"),
        (["run", "--point", "A=1"], "NAME=X,Y"),
        (["run", "--point", "A=400,400"], "within 475 mm"),
        (["run", "--trials", "1"], "--trials"),
    ],
)
def test_bad_usage(
    spoiled: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], text: str
) -> None:
    (spoiled.parent / "empty").mkdir()
    (spoiled / "0000" / "result").mkdir()
    assert run(["stability", str(spoiled.parent / arguments[0]), *arguments[1:]]) == 2
    printed = capsys.readouterr().err.strip().splitlines()
    assert len(printed) == 1
    assert text in printed[0]


def test_a_folder_that_cannot_be_written(
    spoiled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert run(["stability", str(spoiled), "--out", str(tmp_path / "file" / "out")]) == 2
    assert "cannot be written" in capsys.readouterr().err
