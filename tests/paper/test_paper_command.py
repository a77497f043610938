"""`paper` from the command line: simulated and recorded, ended and continued, and its errors."""

from __future__ import annotations

import html
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.measure.matplotlib_sheet import new_sheet
from membrane_ctrl.paper import paper_command, parts, pictures

BLANK = pictures.to_png(new_sheet(3.0, 3.0)[0])
SMALL = replace(paper_command.QUICK, shrink=12, sets=18, trials=4)


@pytest.fixture(autouse=True)
def _undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures are blank: drawing takes most of the time here."""
    monkeypatch.setattr(pictures, "to_png", lambda _: BLANK)
    monkeypatch.setattr(paper_command, "QUICK", SMALL)


def read_table(folder: Path) -> dict[str, Any]:
    table: dict[str, Any] = json.loads((folder / "paper.json").read_text())
    return table


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A document of all parts."""
    out = tmp_path_factory.mktemp("paper") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper_command, "QUICK", SMALL)
        patch.setattr(pictures, "to_png", lambda _: BLANK)
        assert run(["paper", "--quick", "--out", str(out)]) == 0
    return out


def test_every_part_is_in_page_pdf_and_table(whole: Path) -> None:
    page = (whole / "paper.html").read_text()
    table = read_table(whole)
    for part in parts.PARTS:
        assert part.title in page
        assert f"membrane-ctrl paper --quick --only {part.name}" in page
        assert table["comparisons"][part.name]
    assert (whole / "paper.pdf").read_bytes().startswith(b"%PDF")
    assert "Program membrane" in page


def test_statements_of_the_paper_are_reproduced(whole: Path) -> None:
    numbers = read_table(whole)["numbers"]
    assert numbers["phases"]["wrong_share"] == {"x": 0.0, "y": 0.0}
    assert numbers["gray"]["displayed_as_table"] is True
    assert numbers["convergence"]["iterations_to_threshold"] == 5
    assert numbers["starts"]["same_to_rounding"] is True
    assert 2.5 < abs(numbers["profile"]["edge_from_hencky_mm"]) < 3.0
    assert numbers["profile"]["error_rms_um"] < 2.0
    assert numbers["stability"]["rejected"] == 0
    # the centre wanders by 1 µm, and the edge follows it
    assert 0.1 < numbers["stability"]["sd_mean_um"] < 1.5


def test_a_finished_part_is_not_computed_again(
    whole: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = read_table(whole)
    (whole / "parts" / "gray.json").unlink()
    (whole / "parts" / "profile.json").write_text('{"comparisons": [')  # ended while it was written
    assert run(["paper", "--quick", "--out", str(whole)]) == 0
    shown = capsys.readouterr().err
    assert "Gray-code table ..." in shown
    assert "Surface and radial profile ..." in shown
    assert "Patterns" not in shown
    assert read_table(whole) == before


def test_another_seed_is_another_document(whole: Path, tmp_path: Path) -> None:
    assert run(["paper", "--quick", "--only", "profile", "--out", str(tmp_path)]) == 0
    again = read_table(tmp_path)["numbers"]["profile"]
    assert again == pytest.approx(read_table(whole)["numbers"]["profile"], rel=1e-6)
    assert (
        run(["paper", "--quick", "--only", "profile", "--seed", "2", "--out", str(tmp_path)]) == 0
    )
    other = read_table(tmp_path)["numbers"]["profile"]
    assert other["left_by_prestrain_um"] != pytest.approx(again["left_by_prestrain_um"], rel=1e-3)


def test_recorded_sets_have_a_document_of_their_own(tmp_path: Path) -> None:
    sets = tmp_path / "sets"
    motion = ["--sets", "5", "--drift-um-per-s", "0.5", "--interval-s", "60"]
    assert run(["simulate", str(sets), "--shrink", "12", *motion]) == 0
    out = tmp_path / "out"
    small = ["--only", "stability", "--only", "convergence", "--only", "profile"]
    assert run(["paper", "--sets", str(sets), *small, "--out", str(out)]) == 0
    table = read_table(out)
    assert table["numbers"]["stability"]["sets"] == 5
    # 30 µm of sag a set: the rim moves as far, the mean over the mirror half of it
    assert 10.0 < table["numbers"]["stability"]["pairs_60_s"]["mean_um"] < 25.0
    assert "error_rms_um" not in table["numbers"]["profile"]
    assert "phases" not in table["comparisons"]


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", str(tmp_path / "out")]
    for arguments, line in (
        (["--only", "figures"], "--only figures: one of patterns, phases,"),
        (["--quick", "--full-size"], "give one of them"),
        (["--sets", str(tmp_path / "nothing")], "no sets; each is a folder with a capture.toml"),
    ):
        assert run(["paper", *arguments, *out]) == 2
        shown = capsys.readouterr().err
        assert line in shown
        assert "Traceback" not in shown
    assert not (tmp_path / "out").exists()


def test_general_poses_have_no_angle(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sets = tmp_path / "sets"
    assert run(["simulate", str(sets / "0000"), "--shrink", "12"]) == 0
    capture = sets / "0000" / "capture.toml"
    lines = capture.read_text().splitlines()
    begin = lines.index("[geometry]")
    kept = [
        line for line in lines if not line.startswith(("a_mm", "b_mm", "alpha_deg", "a_s", "b_s"))
    ]
    assert begin
    poses = """
[geometry.camera]
position_mm = [422.6, 0.0, 2638.4]
rotation = [[0.987414, 0.0, -0.158158], [0.0, -1.0, 0.0], [-0.158158, 0.0, -0.987414]]
[geometry.screen]
origin_mm = [-454.1, 0.0, 2834.9]
s_x = [-0.987414, 0.0, -0.158158]
s_y = [0.0, 1.0, 0.0]
"""
    capture.write_text("\n".join(kept) + poses)
    out = tmp_path / "out"
    assert run(["paper", "--sets", str(sets), "--only", "convergence", "--out", str(out)]) == 2
    assert "need a_mm, b_mm and alpha_deg" in capsys.readouterr().err
    only = ["--only", "gray", "--only", "stability"]
    assert run(["paper", "--sets", str(sets), *only, "--out", str(out)]) == 0
    assert "left out: convergence, starts, monte_carlo" in capsys.readouterr().err
    # and one set has no SD
    assert "1 of 1 sets gave a figure" in (out / "paper.html").read_text()


def test_other_sets_in_the_same_folder_are_computed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sets = tmp_path / "sets of é"
    assert run(["simulate", str(sets / "0000"), "--shrink", "12"]) == 0
    command = ["paper", "--sets", str(sets), "--only", "gray", "--seed", "3"]
    command += ["--out", str(tmp_path / "missing" / "out")]
    assert run(command) == 0
    page = html.unescape((tmp_path / "missing" / "out" / "paper.html").read_text())
    assert "sets of é' --seed 3 --only gray" in page
    capsys.readouterr()
    assert run(command) == 0
    assert "Gray-code table ..." not in capsys.readouterr().err
    assert run(["simulate", str(sets / "0001"), "--shrink", "12"]) == 0
    capsys.readouterr()
    assert run(command) == 0
    assert "Gray-code table ..." in capsys.readouterr().err


def test_a_set_that_cannot_be_read_is_named_before_anything_is_computed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sets = tmp_path / "sets"
    assert run(["simulate", str(sets), "--shrink", "12", "--sets", "3"]) == 0
    broken = sets / "0002" / "capture.toml"
    kept = broken.read_text()
    command = ["paper", "--sets", str(sets), "--only", "gray", "--out", str(tmp_path / "out")]
    for content, line in (
        ("[[[", f"{broken}: not valid TOML"),
        (kept.replace("radius_mm = 500.0", "radius_mm = 510.0", 1), "not that of the first set"),
    ):
        broken.write_text(content)
        capsys.readouterr()
        assert run(command) == 2
        shown = capsys.readouterr().err
        assert line in shown
        assert "..." not in shown


def test_a_set_with_a_broken_picture_is_counted_as_rejected(tmp_path: Path) -> None:
    sets = tmp_path / "sets"
    assert run(["simulate", str(sets), "--shrink", "12", "--sets", "4"]) == 0
    picture = sets / "0002" / "x_sin_2.png"
    picture.write_bytes(picture.read_bytes()[:100])
    out = tmp_path / "out"
    assert run(["paper", "--sets", str(sets), "--only", "stability", "--out", str(out)]) == 0
    stability = read_table(out)["numbers"]["stability"]
    assert stability["sets"] == 4
    assert stability["rejected"] == 1
