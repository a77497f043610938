"""`uncertainty` from the command line: sets and pairs, seeds and workers, a cluster, and one line
for bad input.
"""

from __future__ import annotations

import importlib
import json
import shutil
import sys
import types
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.config.optics import SigmasConfig
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

FEW = ("--trials", "40")
POSES = """
[geometry.camera]
position_mm = [422.5, 0.0, 2638.4]
rotation = [[0.98741, 0.0, -0.15816], [0.0, -1.0, 0.0], [-0.15816, 0.0, -0.98741]]
[geometry.screen]
origin_mm = [-454.1, 0.0, 2834.9]
s_x = [-0.98741, 0.0, -0.15816]
s_y = [0.0, 1.0, 0.0]
"""
SHORT = "[geometry]\na_mm = 2672.0\nb_mm = 2871.0\nalpha_deg = 80.9\n"

EXACT = "[geometry.sigmas]\n" + "".join(
    f"{name} = 0.0\n" for name in SigmasConfig().model_dump()
)  # but a, b, alpha


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One full set and a fringes set a minute and 6 µm later."""
    folder = tmp_path_factory.mktemp("sets") / "run"
    motion = ["--sets", "2", "--interval-s", "60", "--drift-um-per-s", "0.1"]
    assert run(["simulate", str(folder), "--shrink", "12", *motion]) == 0
    return folder


@pytest.fixture
def analysed(made: Path, tmp_path: Path) -> Callable[..., dict[str, Any]]:
    """Runs the command on the full set; uncertainty.json."""

    def analyse(*options: str, folder: str = "0000") -> dict[str, Any]:
        out = tmp_path / "out"
        assert run(["uncertainty", str(made / folder), "--out", str(out), *FEW, *options]) == 0
        table: dict[str, Any] = json.loads((out / "uncertainty.json").read_text())
        return table

    return analyse


def test_a_set(
    analysed: Callable[..., dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = analysed("--json", "--trials", "400")
    printed = capsys.readouterr()
    assert json.loads(printed.out) == table
    assert "no sigma is stated for any input" in printed.err  # the set does not state its sigmas
    assert table["schema"] == "membrane-uncertainty/1"
    assert table["rmse_um"]["mean"] == pytest.approx(
        262, rel=0.15
    )  # of a principal point by data sheet
    assert table["linear_um"]["mean"] == pytest.approx(table["rmse_um"]["mean"], rel=0.1)
    assert 0.01 < table["noise_um"]["mean"] < 0.05
    assert len(table["coeffs_sigma_um"]) == ZERNIKE_TERMS
    saved = np.load(tmp_path / "out" / "rmse.npz")
    assert np.nanmean(saved["rmse_um"]) == pytest.approx(table["rmse_um"]["mean"])
    assert np.nanmax(saved["rmse_um"]) == pytest.approx(table["rmse_um"]["max"])
    assert cv2.imread(str(tmp_path / "out" / "uncertainty.png")) is not None


@pytest.mark.usefixtures("undrawn")
def test_a_pair_shares_its_geometry(
    made: Path, analysed: Callable[..., dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    pair = analysed("--against", str(made / "0000"), folder="0001")
    assert pair["rmse_um"]["mean"] < 0.5  # of 262: a bench that is off by a thousandth
    assert "change of height" in capsys.readouterr().out


@pytest.mark.usefixtures("undrawn")
def test_seeds(analysed: Callable[..., dict[str, Any]]) -> None:
    first, again, other = analysed("--seed", "7"), analysed("--seed", "7"), analysed("--seed", "8")
    assert again["rmse_um"] == pytest.approx(first["rmse_um"], rel=1e-9)
    assert other["rmse_um"]["mean"] != pytest.approx(first["rmse_um"]["mean"], rel=1e-6)


@pytest.mark.usefixtures("undrawn")
def test_workers_change_nothing(analysed: Callable[..., dict[str, Any]]) -> None:
    options = ("--trials", "110")  # two batches
    alone, together = analysed(*options, "--workers", "1"), analysed(*options, "--workers", "2")
    assert together["rmse_um"] == pytest.approx(alone["rmse_um"], rel=1e-9)


@pytest.mark.usefixtures("undrawn")
def test_stated_sigmas_and_a_covariance(
    analysed: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    geometry = tmp_path / "geometry.toml"
    geometry.write_text(SHORT + "alpha_sigma_deg = 0.03\n" + EXACT)
    tenth = analysed("--geometry", str(geometry))
    assert tenth["geometry"]["sigmas"] == [0.0, 0.0, 0.03]
    assert tenth["rmse_um"]["mean"] == pytest.approx(0.93, rel=0.3)
    # a and b that err together by as much in opposite directions nearly cancel
    geometry.write_text(
        SHORT
        + '[covariance]\nnames = ["a_mm", "b_mm"]\nmatrix = [[4.0, -3.9], [-3.9, 4.0]]\n'
        + EXACT
    )
    opposite = analysed("--geometry", str(geometry))
    geometry.write_text(
        SHORT
        + '[covariance]\nnames = ["a_mm", "b_mm"]\nmatrix = [[4.0, 3.9], [3.9, 4.0]]\n'
        + EXACT
    )
    common = analysed("--geometry", str(geometry))
    assert opposite["rmse_um"]["mean"] < 0.5 * common["rmse_um"]["mean"]


@pytest.mark.usefixtures("undrawn")
def test_general_poses(analysed: Callable[..., dict[str, Any]], tmp_path: Path) -> None:
    geometry = tmp_path / "geometry.toml"
    geometry.write_text(POSES)
    assert (
        analysed("--geometry", str(geometry))["rmse_um"]["mean"] > 100
    )  # nobody is exact who does not say so
    means = []
    for variance in (1e-12, 1.0):
        covariance = f'[covariance]\nnames = ["screen_shift_x_mm"]\nmatrix = [[{variance}]]\n'
        geometry.write_text(covariance + POSES + EXACT)
        means.append(analysed("--geometry", str(geometry))["rmse_um"]["mean"])
    assert means[0] < 0.05
    assert means[1] > 100 * means[0]


class _Future:
    def __init__(self, value: Any) -> None:
        self._value = value

    def result(self) -> Any:
        return self._value


class _Client:
    """Stands in for distributed.Client: runs the jobs in the order that a cluster would not."""

    addresses: ClassVar[list[str]] = []

    def __init__(self, address: str, timeout: float) -> None:
        if address == "tcp://nobody:1":
            raise OSError("timed out after 10 s")
        if ":" not in address:
            raise ValueError("missing port number in address")
        self.addresses.append(address)

    def __enter__(self) -> _Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.addresses.append("closed")

    def map(self, job: Callable[..., Any], batches: Iterable[Any], pure: bool) -> list[_Future]:
        assert not pure
        return [_Future(job(batch)) for batch in list(batches)[::-1]][::-1]


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.setitem(sys.modules, "distributed", types.SimpleNamespace(Client=_Client))
    monkeypatch.setattr(_Client, "addresses", [])
    return _Client.addresses


@pytest.mark.campaign
def test_on_a_cluster(analysed: Callable[..., dict[str, Any]], cluster: list[str]) -> None:
    here = analysed("--trials", "110")
    there = analysed("--trials", "110", "--scheduler", "tcp://host:8786")
    assert there["rmse_um"] == pytest.approx(here["rmse_um"], rel=1e-9)
    assert _Client.addresses == ["tcp://host:8786", "closed"]


@pytest.mark.usefixtures("cluster")
@pytest.mark.parametrize(
    ("address", "code", "text"),
    [("tcp://nobody:1", 4, "does not answer"), ("nonsense", 2, "missing port")],
)
def test_no_such_scheduler(
    made: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    address: str,
    code: int,
    text: str,
) -> None:
    options = ["--out", str(tmp_path / "out"), "--scheduler", address]
    assert run(["uncertainty", str(made / "0000"), *options]) == code
    assert text in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_dask_is_not_installed(
    made: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    original = importlib.import_module

    def missing(name: str, package: str | None = None) -> types.ModuleType:
        if name == "distributed":
            raise ImportError(name)
        return original(name, package)

    monkeypatch.setattr(importlib, "import_module", missing)
    assert run(["uncertainty", str(made / "0000"), "--scheduler", "tcp://host:8786"]) == 2
    assert "membrane-ctrl[dask]" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "printed"),
    [
        (
            SHORT + '[covariance]\nnames = ["a_mm"]\nmatrix = [[1.0, 2.0]]\n',
            "needs 1 rows and columns",
        ),
        (SHORT + '[covariance]\nnames = ["a_mm"]\nmatrix = [[-1.0]]\n', "variance is negative"),
        (SHORT + '[covariance]\nnames = ["a_m"]\nmatrix = [[1.0]]\n', "all from"),
        (
            SHORT + '[covariance]\nnames = ["camera_shift_x_mm"]\nmatrix = [[1.0]]\n',
            "a, b and alpha",
        ),
        (SHORT + '[covariance]\nnames = ["alpha_deg"]\nmatrix = [[2500.0]]\n', "too wide"),
        (SHORT + "[covariance]\nmatrix = [[1.0]]\n", "names"),
        ("[geometry]\na_mm = 2.672\nb_mm = 2871.0\nalpha_deg = 80.9\n", "a_mm"),
    ],
)
def test_bad_geometry(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, printed: str
) -> None:
    geometry = tmp_path / "geometry.toml"
    geometry.write_text(text)
    options = ["--geometry", str(geometry), "--out", str(tmp_path / "out")]
    assert run(["uncertainty", str(made / "0000"), *options]) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert printed in line
    assert not (tmp_path / "out").exists()


def test_a_rejected_set(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(made, tmp_path / "run")
    for file in (tmp_path / "run" / "0000").glob("*.png"):
        cv2.imwrite(str(file), np.zeros((170, 204), np.uint8))
    assert run(["uncertainty", str(tmp_path / "run" / "0000")]) == 3
    assert "rejected" in capsys.readouterr().err
    assert run(["uncertainty", str(tmp_path / "nowhere")]) == 2


def test_a_pair_of_two_benches(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(made / "0000", tmp_path / "other")
    path = tmp_path / "other" / "capture.toml"
    path.write_text(path.read_text().replace("a_mm = 2672.0", "a_mm = 2670.0"))
    assert run(["uncertainty", str(made / "0000"), "--against", str(tmp_path / "other")]) == 2
    assert "one bench" in capsys.readouterr().err
