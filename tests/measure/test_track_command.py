"""`track` and `simulate --track`: files, exit codes, and sets that are refused in one line."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

FRAMES = 8


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tracking") / "demo"
    wanted = [
        "--track",
        str(FRAMES),
        "--shrink",
        "10",
        "--drift-um-per-s",
        "10",
        "--laser-noise-um",
        "1",
    ]
    assert run(["simulate", str(folder), *wanted]) == 0
    return folder


def test_every_frame_has_a_figure(demo: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["track", str(demo / "track"), "--json"]) == 0
    table = json.loads(capsys.readouterr().out)
    assert table["verdicts"] == {"ok": FRAMES, "degraded": 0, "rejected": 0}, table["reasons"]
    assert table["stepped"]
    with np.load(demo / "track/result/track.npz", allow_pickle=False) as found:
        assert json.loads(str(found["origin"]))["schema"] == "membrane-track/1"
        assert set(found) == {
            "origin",
            "time_s",
            "coeffs_um",
            "sigma_um",
            "change_sigma_um",
            "hencky_um",
            "sag_um",
            "sag_sigma_um",
            "sag_change_sigma_um",
            "verdict",
            "reason",
        }
        assert found["coeffs_um"].shape == found["sigma_um"].shape == (FRAMES, ZERNIKE_TERMS)
        truth = np.load(demo / "track/truth.npz")
        assert np.array_equal(found["time_s"], np.round(truth["time_s"], 9))
        moved = found["sag_um"] - truth["sag_um"]
        assert np.abs(moved - moved.mean()).max() < 4 * found["sag_change_sigma_um"].max()
    for name in ("track.png", "track.rrd"):
        assert (demo / "track/result" / name).stat().st_size > 10_000


def edited(demo: Path, tmp_path: Path, change: Callable[[str], str]) -> Path:
    """A copy of the set with another `capture.toml`, beside the same reference."""
    folder = tmp_path / "track"
    shutil.copytree(demo / "track", folder, ignore=shutil.ignore_patterns("result"))
    (tmp_path / "full").symlink_to(demo / "full")
    path = folder / "capture.toml"
    path.write_text(change(path.read_text()))
    return folder


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('file = "t_00001.png"', 'file = "../full/white.png"', "outside the set's folder"),
        ('file = "t_00001.png"', 'file = "t_00000.png"', "is given for 2 frames"),
        ('reference = "../full"', 'reference = "../nowhere"', "no such capture set"),
        ('reference = "../full"', 'reference = "../track"', "kind"),
        ('reference = "../full"\n', "", "reference: missing"),
        ('reference = "../full"', 'reference = "a\\u0000b"', "leads to no folder"),
        ('reference = "../full"', 'reference = "."', "kind"),
        ('reference = "../full"', 'reference = ["../full"]', "reference"),
        ("periods = 32", f"periods = 1{'0' * 40}", "pattern.crossed.periods"),
        ("periods = 32", "periods = 32\ncontrast = nan", "pattern.crossed.contrast"),
        ("shift_x_rad = 0.0", "shift_x_rad = 1e300", "shift_x_rad"),
        ("time_s = 1.85", "time_s = 1e308", "not after"),
        ("time_s = 1.85", "time_s = [1.85", "not valid TOML"),
        ('file = "t_00001.png"', 'file = "a\\u0000b"', "outside the set's folder"),
        ("periods = 32", "periods = 16", "covers the reference's region"),
        ("period_mm = 49.82", "period_mm = 50.0", "the reference has 49.82"),
        ("time_s = 1.85", "time_s = nan", "time_s"),
        ("time_s = 1.85", "time_s = 1.8", "not after"),
        ("shift_x_rad = 0.0", "shift_x_rad = inf", "shift_x_rad"),
        ('kind = "track"', 'kind = "full"', "membrane-ctrl measure"),
        ('role = "crossed"', 'role = "sin"', "role"),
    ],
)
def test_an_invalid_set_is_refused_in_one_line(
    demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, message: str
) -> None:
    def change(text: str) -> str:
        assert old in text, text[:800]
        return text.replace(old, new, 1)

    assert run(["track", str(edited(demo, tmp_path, change))]) == 2
    shown = capsys.readouterr().err.strip().splitlines()
    assert message in shown[-1], shown
    assert len(shown) <= 2
    assert not (tmp_path / "track/result").exists()


def test_frames_of_another_size_are_refused_and_missing_ones_rejected(
    demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = edited(demo, tmp_path, str)
    (folder / "t_00005.png").unlink()
    os.mkfifo(folder / "t_00005.png")
    (folder / "t_00006.png").unlink()
    (folder / "t_00007.png").write_bytes(b"\x89PNG\r\n\x1a\n and no more")
    assert run(["track", str(folder), "--json", "--no-pictures"]) == 0
    table = json.loads(capsys.readouterr().out)
    assert table["verdicts"] == {"ok": 5, "degraded": 0, "rejected": 3}
    assert all(
        any(why in reason for reason in table["reasons"])
        for why in ("missing", "pipe", "unreadable")
    )
    large = folder.parent / "large"
    assert run(["simulate", str(large), "--shrink", "8"]) == 0
    shutil.copy(large / "white.png", folder / "t_00006.png")
    assert run(["track", str(folder)]) == 2
    assert "t_00006.png has 306 x 256 pixels, the reference 244 x 204" in capsys.readouterr().err


def test_no_usable_frame_is_exit_3(
    demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = edited(demo, tmp_path, str)
    for path in folder.glob("t_*.png"):
        shutil.copy(demo / "full/black.png", path)
    assert run(["track", str(folder), "--no-pictures"]) == 3
    assert "rejected: dark" in capsys.readouterr().out
