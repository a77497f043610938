"""The calibrate-camera and calibrate-board commands, from pictures to
a prior that calibrate takes.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.config.schema import CameraConfig, OpticsConfig
from membrane_ctrl.geometry.prior_file import read_prior
from membrane_ctrl.metrology.calibration.board import Board
from membrane_ctrl.metrology.calibration.board_size import find_other_board
from membrane_ctrl.model.errors import InputError
from tests.support.board_photograph import Photographer, photographs

CONFIG = """
[optics.camera]
width_px = 408
height_px = 342
pixel_um = 20.7
focal_mm = 16.0
"""
TRUE = Photographer(408, 342, 781.3, (206.9, 167.4), (-0.12, 0.08, 4e-4, -6e-4))
SQUARE_PX = 48


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A configuration, and photographs of the board as `calibrate-board` draws it."""
    root = tmp_path_factory.mktemp("camera")
    (root / "lab.toml").write_text(CONFIG)
    size = [
        "--width-px",
        str(11 * SQUARE_PX),
        "--height-px",
        str(9 * SQUARE_PX),
        "--square-px",
        str(SQUARE_PX),
    ]
    assert run(["calibrate-board", str(root / "board.png"), *size, "--board", "charuco:11x9"]) == 0
    picture = np.asarray(cv2.imread(str(root / "board.png"), cv2.IMREAD_UNCHANGED), np.uint8)
    (root / "photographs").mkdir()
    for k, image in enumerate(photographs(TRUE, picture, SQUARE_PX, 6, 3)):
        deep = (
            image.astype(np.uint16) * 16 if k == 2 else image
        )  # a 12-bit camera's picture among the others
        cv2.imwrite(str(root / "photographs" / f"{k}.png"), deep)
    cv2.imwrite(str(root / "photographs" / "wall.png"), np.full((342, 408), 77, np.uint8))
    return root


def words(bench: Path, out: Path, board: str = "charuco:11x9") -> list[str]:
    names = ["--config", str(bench / "lab.toml"), "--board", board, "--out", str(out)]
    return ["calibrate-camera", str(bench / "photographs"), *names]


def test_from_photographs_to_a_prior(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "camera.toml"
    assert run([*words(bench, out), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["left_out"] == ["wall.png"]
    prior = read_prior(out)
    assert prior.content.sigmas == report["sigmas"]
    camera = CameraConfig(width_px=408, height_px=342, pixel_um=20.7, noise_adu=0.7)
    found = prior.apply_to_optics(OpticsConfig(camera=camera)).camera
    assert found.noise_adu == 0.7
    focal_px = found.focal_mm / 20.7e-3
    assert abs(focal_px - TRUE.focal_px) < 5 * focal_px * report["sigmas"]["focal_relative"]
    with pytest.raises(InputError, match="a calibrated lens is valid only for its own camera"):
        prior.apply_to_optics(OpticsConfig())


def test_the_gain_in_accuracy_is_printed(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(words(bench, tmp_path / "camera.toml")) == 0
    output = capsys.readouterr().out
    assert "known before" in output
    assert "omitted, without a board or with a bad fit: wall.png" in output
    assert f"calibrate --prior {tmp_path / 'camera.toml'}" in output


def test_mirrored_photographs_are_reported(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "mirrored"
    folder.mkdir()
    for path in sorted((bench / "photographs").glob("[0-5].png")):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(folder / path.name), image[:, ::-1] if path.stem in "13" else image)
    arguments = words(bench, tmp_path / "camera.toml")
    assert run([arguments[0], str(folder), *arguments[2:]]) == 3
    assert "mirrored photographs: 1.png, 3.png; take them" in capsys.readouterr().err


def test_bad_input_is_one_line(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "camera.toml"
    empty = tmp_path / "empty"
    empty.mkdir()
    cases = (
        (["calibrate-camera", str(empty)], 2, "holds no photographs"),
        (["calibrate-camera", str(tmp_path / "none")], 2, "no such folder"),
        (
            ["calibrate-camera", str(bench / "photographs")],
            2,
            "408 x 342 pixels, but the configuration's optics.camera",
        ),
        (words(bench, out, "charuco:9x11"), 3, "at least 4 are needed"),
        (words(bench, out, "circles:9x11"), 2, "circles:9x11 is not a board"),
        (
            [
                "calibrate-board",
                str(tmp_path / "b.png"),
                "--width-px",
                "90",
                "--height-px",
                "90",
                "--square-px",
                "9",
            ],
            2,
            "a multiple of 8",
        ),
        (
            [
                "calibrate-board",
                str(tmp_path / "b"),
                "--width-px",
                "1920",
                "--height-px",
                "1080",
                "--square-px",
                "72",
            ],
            2,
            "cannot be written",
        ),
    )
    for arguments, code, message in cases:
        assert run(arguments) == code, arguments
        error = capsys.readouterr().err
        assert message in error
        assert len(error.splitlines()) == 1, error
    assert not out.exists()


def test_invalid_prior_files_are_refused(tmp_path: Path) -> None:
    for text, message in (
        ('schema = "membrane-geometry/1"', "pass a geometry with --geometry"),
        ('schema = "membrane-prior/1"\n[sigmas]\nb_m = 1.0', "sigmas.b_m: not a parameter"),
        ('schema = "membrane-prior/1"\n[sigmas]\nb_mm = 0.0', "sigmas.b_mm"),
    ):
        (tmp_path / "p.toml").write_text(text)
        with pytest.raises(InputError, match=message):
            read_prior(tmp_path / "p.toml")


@pytest.mark.fast_cases(
    "chessboard:10x7-chessboard:9x6---board chessboard:10x7",
    "charuco:10x7-charuco:9x6---board charuco:10x7",
)
@pytest.mark.parametrize(
    ("shown", "stated", "named"),
    [
        ("chessboard:10x7", "chessboard:9x6", "--board chessboard:10x7"),  # corners for squares
        ("chessboard:8x5", "chessboard:12x9", "--board chessboard:8x5"),
        ("charuco:10x7", "charuco:9x6", "--board charuco:10x7"),
        ("charuco:10x7", "charuco:7x10", "--board charuco:10x7"),
    ],
)
def test_a_board_of_another_size_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], shown: str, stated: str, named: str
) -> None:
    (tmp_path / "lab.toml").write_text(CONFIG)
    (tmp_path / "photographs").mkdir()
    board = Board.parse(shown)
    margin = SQUARE_PX
    picture = cv2.copyMakeBorder(
        board.draw(SQUARE_PX), *[margin] * 4, cv2.BORDER_CONSTANT, value=255
    )
    for k, image in enumerate(photographs(TRUE, np.asarray(picture, np.uint8), SQUARE_PX, 5, 3)):
        cv2.imwrite(str(tmp_path / "photographs" / f"{k}.png"), image)
    assert run(words(tmp_path, tmp_path / "prior.toml", stated)) == 3
    assert named in capsys.readouterr().err


def test_photographs_of_no_board_name_none() -> None:
    wall = np.random.default_rng(2).integers(90, 110, (171, 204), np.uint8)
    for stated in ("chessboard:10x7", "charuco:10x7"):
        assert find_other_board(Board.parse(stated), [wall, wall]) is None
