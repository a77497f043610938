"""The lens from photographs of a board, against a lens that is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from membrane_ctrl.config.schema import CameraConfig
from membrane_ctrl.metrology.calibration import board_lens
from membrane_ctrl.metrology.calibration.board import Board, on_screen
from membrane_ctrl.metrology.calibration.board_lens import LEAST_VIEWS, BoardView, calibrate_lens
from tests.support.board_photograph import Photographer, photographs

STATED = CameraConfig(width_px=408, height_px=342, pixel_um=20.7, focal_mm=16.0)  # 773 px
TRUE = Photographer(408, 342, 781.3, (206.9, 167.4), (-0.12, 0.08, 4e-4, -6e-4))
BOARD = Board.parse("charuco:11x9")
SQUARE_PX = 48


def views_of(board: Board, images: list[np.ndarray]) -> list[BoardView]:
    return [BoardView(f"{k}.png", *board.corners(image)) for k, image in enumerate(images)]


@pytest.fixture(scope="module")
def views() -> list[BoardView]:
    return views_of(BOARD, photographs(TRUE, BOARD.draw(SQUARE_PX), SQUARE_PX, 8, 1))


def test_the_lens_is_found_within_its_sigmas(views: list[BoardView]) -> None:
    lens = calibrate_lens(views, STATED)
    assert lens.left_out == ()
    assert lens.rms_px < 0.3
    assert lens.stated_rms_px > 1.2 * lens.rms_px  # poses take most of a wrong focal length
    true = (TRUE.focal_px, *TRUE.principal_px, *TRUE.lens)
    found = (lens.focal_px, *lens.principal_px, *lens.distortion)
    sigmas = np.array(list(lens.sigmas.values())) * np.array([lens.focal_px, *[1.0] * 6])
    assert np.all(np.abs(np.subtract(found, true)) < 5 * sigmas)
    assert lens.sigmas["focal_relative"] < 2e-3


def test_a_plain_chessboard_gives_the_same_lens() -> None:
    board = Board.parse("chessboard:11x9")
    lens = calibrate_lens(
        views_of(board, photographs(TRUE, board.draw(SQUARE_PX), SQUARE_PX, 5, 2)), STATED
    )
    assert lens.focal_px == pytest.approx(TRUE.focal_px, rel=3e-3)


def test_a_view_that_does_not_fit_is_left_out_and_reported(views: list[BoardView]) -> None:
    rng = np.random.default_rng(0)
    bad = replace(
        views[3],
        name="blurred.png",
        seen_px=views[3].seen_px + rng.normal(0, 3.0, views[3].seen_px.shape),
    )
    lens = calibrate_lens([*views, bad], STATED)
    assert lens.left_out == ("blurred.png",)
    assert lens.rms_px < 0.3


def corner_views(
    count: int, seed: int, focal_px: float = 2400.0, shared_px: float = 0.0, bow: float = 0.0
) -> list[BoardView]:
    """Corners of a board, 11 squares wide; `shared_px` is an error that a view's corners share."""
    rng = np.random.default_rng(seed)
    column, row = (part.ravel() for part in np.meshgrid(np.arange(1, 12.0), np.arange(1, 9.0)))
    place = np.stack([column, row, np.zeros_like(column)], axis=1)
    views = []
    for k in range(count):
        degrees = [*rng.uniform(-35, 35, 2), rng.uniform(-20, 20)]
        turn = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
        bent = place - [6.0, 4.5, 0.0]
        bent[:, 2] += 11 * bow * (1 - np.sum(bent[:, :2] ** 2, axis=1) / 30)
        x, y, z = (bent @ turn.T + [*rng.uniform(-1.5, 1.5, 2), rng.uniform(26, 34)]).T
        seen_px = focal_px * np.stack([x / z, y / z], axis=1) + [605.0, 496.0]
        u, v = ((seen_px - [600.0, 500.0]) / 600).T
        field = np.stack([u, v, u**2, v**2, u * v, u**3])
        seen_px += (shared_px * rng.normal(size=(2, 6)) @ field).T
        seen_px += rng.normal(0, 0.05, seen_px.shape)
        views.append(BoardView(f"{seed}-{k}.png", place, seen_px))
    return views


WIDE = CameraConfig(width_px=1200, height_px=1000, pixel_um=3.45, focal_mm=8.3)


def test_errors_that_the_corners_of_a_view_share_are_in_the_sigmas(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """OpenCV's own sigma of the focal length would be 5 to 10 times too small here."""
    monkeypatch.setattr(board_lens, "FLATNESS", 0.0)
    off = []
    for seed in range(6):
        lens = calibrate_lens(corner_views(8, seed, shared_px=0.3), WIDE)
        off.append(np.log(lens.focal_px / 2400.0) / lens.sigmas["focal_relative"])
    assert 0.3 < np.sqrt(np.mean(np.square(off))) < 2.0


def test_a_board_that_is_not_flat_is_in_the_sigmas() -> None:
    lens = calibrate_lens(corner_views(8, 1, bow=board_lens.FLATNESS), WIDE)
    off = abs(np.log(lens.focal_px / 2400.0))
    assert 0.5 * lens.sigmas["focal_relative"] < off < 1.5 * lens.sigmas["focal_relative"]


def test_photographs_of_two_cameras_are_reported() -> None:
    both = [*corner_views(5, 1), *corner_views(5, 2, focal_px=2450.0)]
    with pytest.raises(ValueError, match="of two cameras, or the focus was changed") as refused:
        calibrate_lens(both, WIDE)
    first, second = str(refused.value).split(" px, ")
    assert all(f"1-{k}.png" in first for k in range(5))
    assert all(f"2-{k}.png" in second for k in range(5))


def test_too_few_views_are_refused(views: list[BoardView]) -> None:
    with pytest.raises(
        ValueError, match=f"seen in {LEAST_VIEWS - 1} photographs; at least {LEAST_VIEWS}"
    ):
        calibrate_lens(views[: LEAST_VIEWS - 1], STATED)


def test_no_board_has_no_corners() -> None:
    assert BOARD.corners(np.full((100, 100), 90, np.uint8))[0].shape == (0, 3)


def test_the_picture_is_exact_to_the_pixel() -> None:
    levels = on_screen(BOARD, SQUARE_PX, 640, 480)
    assert levels.shape == (480, 640)
    assert set(np.unique(levels)) == {0, 255}
    drawn = levels[24:-24, 56:-56]
    assert drawn.shape == (9 * SQUARE_PX, 11 * SQUARE_PX)
    blocks = drawn.reshape(
        9 * 8, SQUARE_PX // 8, 11 * 8, SQUARE_PX // 8
    )  # a module is one level throughout
    assert np.array_equal(blocks.min(axis=(1, 3)), blocks.max(axis=(1, 3)))


@pytest.mark.parametrize(
    ("text", "square_px", "message"),
    [
        ("charuco:11", 48, "not a board"),
        ("charuco:3x9", 48, "at least 4 squares"),
        ("charuco:11x9", 50, "a multiple of 8"),
        ("charuco:11x9", 80, "880 x 720 pixels, the screen 640 x 480"),
    ],
)
def test_impossible_boards_are_refused(text: str, square_px: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        on_screen(Board.parse(text), square_px, 640, 480)


@pytest.mark.parametrize("kind", ["random", "nan", "one point", "two neighbours exchanged"])
def test_corners_that_are_none_are_refused_with_the_cause(kind: str) -> None:
    """Nothing but finite sigmas is a result."""
    rng = np.random.default_rng(11)
    views = []
    for view in corner_views(8, 5):
        seen_px = view.seen_px.copy()
        if kind == "random":
            seen_px = rng.uniform(0, 1000, seen_px.shape)
        elif kind == "nan":
            seen_px[3] = np.nan
        elif kind == "one point":
            seen_px[:] = seen_px[0]
        else:
            seen_px = rng.permutation(seen_px)
        views.append(replace(view, seen_px=seen_px))
    with pytest.raises(ValueError, match="do not lie on a plane board"):
        calibrate_lens(views, WIDE)


def test_photographs_that_do_not_tilt_the_board_do_not_determine_the_lens() -> None:
    """The board always parallel to the sensor: any focal length fits with another distance."""
    column, row = (part.ravel() for part in np.meshgrid(np.arange(1, 12.0), np.arange(1, 9.0)))
    place = np.stack([column, row, np.zeros_like(column)], axis=1)
    rng = np.random.default_rng(12)
    views = [
        BoardView(
            f"{k}.png",
            place,
            70.0 * place[:, :2] + [200.0, 180.0] + rng.normal(0, 0.1, (place.shape[0], 2)),
        )
        for k in range(6)
    ]
    with pytest.raises(ValueError, match=r"do not determine focal_relative|no lens fits"):
        calibrate_lens(views, WIDE)


def test_corners_on_a_wavy_board_are_refused() -> None:
    """A quarter of a square off, as no lens has it."""
    views = []
    for view in corner_views(8, 6):
        wave = 20.0 * np.sin(2.2 * view.place[:, 0]) * np.cos(1.9 * view.place[:, 1])
        views.append(replace(view, seen_px=view.seen_px + wave[:, None]))
    with pytest.raises(ValueError, match="of a square: cause unknown"):
        calibrate_lens(views, WIDE)
