"""Cameras without GenICam: pictures from a folder, and a fake of OpenCV's capture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from firmware_iface.drivers.camera_opencv import FolderCamera, UvcCamera
from firmware_iface.optical_roles import DriverClock, Pattern, SensorFormat
from firmware_iface.roles import DeviceRefusedError, LinkDownError, LinkError
from firmware_iface.settings import FolderCameraConfig, UvcCameraConfig

CLOCK = DriverClock(lambda: 3.5)


def of_folder(path: Path, width_px: int = 6) -> FolderCamera:
    return FolderCamera(FolderCameraConfig(folder=str(path)), SensorFormat(width_px, 4), CLOCK)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for level, name in enumerate(("black", "white", "x_sin_0")):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((4, 6), level, np.uint8))
    return tmp_path


def test_a_folder_goes_round_in_the_order_of_names(folder: Path) -> None:
    camera = of_folder(folder)
    out = np.zeros((4, 6), np.uint8)
    assert [int(camera.grab(out).pixels[0, 0]) for _ in range(4)] == [0, 1, 2, 0]
    assert camera.grab().time_s == 3.5


def test_a_folder_is_its_own_screen(folder: Path) -> None:
    camera = of_folder(folder)
    camera.show(Pattern("sin", "x", 0))
    assert camera.grab().pixels[0, 0] == 2
    camera.show(Pattern("black"))
    assert camera.grab().pixels[0, 0] == 0


def test_a_folder_with_other_pictures_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(DeviceRefusedError, match=r"6 x 4 pixels.*states 7 x 4"):
        of_folder(folder, 7).open()
    with pytest.raises(LinkError, match="no pictures"):
        of_folder(tmp_path / "nothing").open()
    with pytest.raises(LinkError, match="uint16"):
        of_folder(folder).grab(np.zeros((4, 6), np.uint16))
    (folder / "black.png").write_bytes(b"no picture")
    with pytest.raises(LinkError, match="cannot be read"):
        of_folder(folder).open()


class FakeCapture:
    def __init__(self, port: int | str) -> None:
        self.port, self.there, self.released = port, True, False
        self.properties: dict[int, float] = {}
        self.largest = {cv2.CAP_PROP_FRAME_WIDTH: 8.0, cv2.CAP_PROP_FRAME_HEIGHT: 4.0}
        self.frames = 0

    def isOpened(self) -> bool:  # noqa: N802
        return self.there

    def read(self) -> tuple[bool, Any]:
        self.frames += 1
        image = np.zeros((4, 6, 3), np.uint8)
        image[:, :, 1] = self.frames
        return self.there, image if self.there else None

    def set(self, prop: int, value: float) -> bool:
        self.properties[prop] = min(value, self.largest.get(prop, value))
        return True

    def get(self, prop: int) -> float:
        return self.properties[prop]

    def release(self) -> None:
        self.released = True


def uvc(config: UvcCameraConfig, width_px: int = 6) -> tuple[UvcCamera, list[FakeCapture]]:
    made: list[FakeCapture] = []

    def make(port: int | str) -> FakeCapture:
        made.append(FakeCapture(port))
        return made[-1]

    return UvcCamera(config, SensorFormat(width_px, 4), CLOCK, make), made


def test_uvc_throws_away_what_was_begun_before() -> None:
    camera, made = uvc(UvcCameraConfig(port="2", exposure=50.0))
    assert camera.grab().pixels[0, 0] == 3
    out = np.zeros((4, 6), np.uint8)
    assert camera.grab(out).pixels is out
    assert out[0, 0] == 6
    assert made[0].port == 2
    assert made[0].properties[cv2.CAP_PROP_AUTO_EXPOSURE] == 1.0
    assert made[0].properties[cv2.CAP_PROP_EXPOSURE] == 50.0


def test_uvc_unplugged_is_opened_again() -> None:
    camera, made = uvc(UvcCameraConfig(port="/dev/video0"))
    camera.grab()
    made[0].there = False
    with pytest.raises(LinkDownError, match="unplugged"):
        camera.grab()
    assert made[0].released
    camera.grab()
    assert [capture.port for capture in made] == ["/dev/video0"] * 2


def test_uvc_refuses_another_size() -> None:
    camera, made = uvc(UvcCameraConfig(), 1920)
    with pytest.raises(DeviceRefusedError, match="width_px = 8 after 1920"):
        camera.open()
    assert made[0].released
