"""The GenICam driver against an emulated GigE Vision camera on loopback, real protocol and all."""

from __future__ import annotations

import re
import subprocess
import time
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from firmware_iface import camera_conformance
from firmware_iface.drivers.camera_aravis import AravisCamera
from firmware_iface.guarded_camera import GuardedCamera
from firmware_iface.links import aravis
from firmware_iface.optical_roles import DriverClock, FrameLostError, SensorFormat
from firmware_iface.roles import DeviceRefusedError, LinkDownError, LinkError
from firmware_iface.settings import AravisCameraConfig
from tests.support.machine_needs import program_path
from tests.worlds.gige_camera import GigeCameraEmulator, gige_camera

pytestmark = pytest.mark.real_time

WIDTH_PX, HEIGHT_PX = 306, 256
SETTINGS = AravisCameraConfig(camera="127.0.0.1", exposure_ms=2.0, packet_bytes=8000, timeout_s=0.3)


def guarded(config: AravisCameraConfig = SETTINGS, width_px: int = WIDTH_PX) -> GuardedCamera:
    """The driver as the cycle uses it."""
    sensor = SensorFormat(width_px, HEIGHT_PX, config.frame_bits)
    return GuardedCamera(AravisCamera(config, sensor), sensor, time.monotonic, "camera aravis")


class Sight:
    """Every exposure is another picture, or what `view` returns; the last one is kept."""

    def __init__(self) -> None:
        self.view: Any = None
        self.dtype: Any = np.uint8
        self.top = 256
        self.generator = np.random.default_rng(7)
        self.last = np.zeros((HEIGHT_PX, WIDTH_PX), np.uint8)
        self.seen: list[tuple[float, int]] = []

    def expose(self, exposure_ms: float, gain: int) -> Any:
        self.seen.append((exposure_ms, gain))
        if self.view is not None:
            return self.view()
        self.last = self.generator.integers(0, self.top, (HEIGHT_PX, WIDTH_PX)).astype(self.dtype)
        return self.last


@pytest.fixture
def sight() -> Sight:
    return Sight()


@pytest.fixture
def emulator(sight: Sight) -> Iterator[GigeCameraEmulator]:
    with gige_camera(sight.expose, WIDTH_PX, HEIGHT_PX) as emulated:
        yield emulated
    assert emulated.error is None


class Bench(camera_conformance.CameraBench):
    """The emulated camera sees what the conformance checks show it."""

    sensor = SensorFormat(WIDTH_PX, HEIGHT_PX)
    exposure_s = SETTINGS.exposure_ms / 1000.0

    def __init__(self, emulator: GigeCameraEmulator, sight: Sight) -> None:
        super().__init__()
        self.clock = DriverClock()
        self._emulator, self._sight = emulator, sight
        sight.view = self.view

    def make(self, sensor: SensorFormat) -> AravisCamera:
        return AravisCamera(SETTINGS, sensor, self.clock)

    def change_scene(self) -> Any:
        self._emulator.lose_packets(0.0)
        return super().change_scene()

    def lose_frame(self) -> None:
        self._emulator.lose_packets(1.0)

    def unplug(self) -> None:
        self._emulator.unplug()

    def plug_in(self) -> None:
        self._emulator.plug_in()


@pytest.mark.parametrize(
    "check", camera_conformance.list_checks(Bench), ids=lambda check: check.__name__
)
def test_conformance(
    check: camera_conformance.Check, emulator: GigeCameraEmulator, sight: Sight
) -> None:
    check(Bench(emulator, sight))


@pytest.fixture
def camera(emulator: GigeCameraEmulator) -> Iterator[GuardedCamera]:
    opened = guarded()
    opened.open()
    yield opened
    opened.close()


def test_identity_and_pixels(emulator: GigeCameraEmulator, sight: Sight) -> None:
    camera = guarded()
    identity = camera.open()
    assert (identity.kind, identity.serial) == ("Aravis Fake", "EMU1")
    out = np.zeros((HEIGHT_PX, WIDTH_PX), np.uint8)
    for _ in range(5):
        frame = camera.grab(out)
        assert frame.pixels is out
        assert np.array_equal(out, sight.last)
    assert np.array_equal(camera.grab().pixels, sight.last)
    camera.close()
    assert camera.driver.counts.taken == 6
    assert "6 taken" in camera.describe()["frames"]


def test_every_frame_is_triggered_and_dated(
    camera: GuardedCamera, emulator: GigeCameraEmulator
) -> None:
    before = emulator.exposures
    times = [camera.grab().time_s for _ in range(4)]
    assert emulator.exposures == before + 4
    assert all(later - earlier >= 0.002 for earlier, later in pairwise(times))


def test_the_screen_may_change_between_expose_and_fetch(
    camera: GuardedCamera, sight: Sight
) -> None:
    out = np.zeros((HEIGHT_PX, WIDTH_PX), np.uint8)
    camera.expose(out)
    assert not out.any()  # nothing is written before it is fetched
    frame = camera.fetch()
    assert frame.pixels is out
    assert np.array_equal(out, sight.last)
    with pytest.raises(LinkError, match="no exposure to fetch"):
        camera.fetch()


def test_exposure_and_gain_arrive(emulator: GigeCameraEmulator, sight: Sight) -> None:
    camera = guarded(SETTINGS.model_copy(update={"exposure_ms": 3.0, "gain_db": 4.0}))
    camera.grab()
    camera.close()
    assert set(sight.seen) == {(3.0, 4)}


@pytest.mark.parametrize(
    ("pixel_format", "dtype", "top"),
    [
        ("Mono8", np.uint8, 256),
        ("BayerRG8", np.uint8, 256),
        ("Mono12", np.uint16, 4096),
        ("Mono16", np.uint16, 65536),
    ],
)
def test_pixel_formats(
    emulator: GigeCameraEmulator, sight: Sight, pixel_format: str, dtype: Any, top: int
) -> None:
    sight.dtype, sight.top = dtype, top
    camera = guarded(SETTINGS.model_copy(update={"pixel_format": pixel_format}))
    pixels = camera.grab().pixels
    camera.close()
    assert pixels.dtype == dtype
    assert np.array_equal(pixels, sight.last)


def test_incomplete_frames_are_counted_and_taken_again(
    camera: GuardedCamera, emulator: GigeCameraEmulator, sight: Sight
) -> None:
    emulator.lose_packets(0.05)  # of 12 a frame: about half of the frames
    whole = 0
    for _ in range(10):
        try:
            pixels = camera.grab().pixels
        except FrameLostError:  # three times in a row
            continue
        whole += 1
        assert np.array_equal(pixels, sight.last)
    assert whole >= 3
    assert camera.driver.counts.incomplete + camera.driver.counts.missing > 0
    assert camera.driver.counts.taken == whole
    emulator.lose_packets(0.0)
    assert np.array_equal(camera.grab().pixels, sight.last)


def test_a_frame_that_never_comes_is_lost_not_waited_for(
    camera: GuardedCamera, emulator: GigeCameraEmulator, sight: Sight
) -> None:
    emulator.lose_packets(1.0)
    camera.expose()
    with pytest.raises(FrameLostError):
        camera.fetch()
    emulator.lose_packets(0.0)
    assert np.array_equal(camera.grab().pixels, sight.last)  # and not the late one


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"width_px": 2000}, ["306 x 256", "2000 x 256"]),
        ({"gain_db": 40.0}, ["Gain", "maximum"]),
        ({"exposure_ms": 1e9}, ["Exposure", "maximum"]),
        ({"pixel_format": "Mono10"}, []),
    ],
)
def test_what_it_does_not_take_is_refused_in_one_line(
    emulator: GigeCameraEmulator, change: dict[str, Any], words: list[str]
) -> None:
    width_px = change.pop("width_px", WIDTH_PX)
    camera = guarded(SETTINGS.model_copy(update=change), width_px)
    if not words:
        camera.open()
        camera.close()
        return
    with pytest.raises(DeviceRefusedError) as refused:
        camera.open()
    message = str(refused.value)
    assert message.startswith("camera 127.0.0.1: ")
    assert all(word in message for word in words), message
    assert "\n" not in message


def test_in_use_by_another(camera: GuardedCamera) -> None:
    with pytest.raises(LinkError, match=r"in use by another program.*close it"):
        guarded().open()
    camera.grab()  # the first one is not disturbed


def test_a_buffer_of_another_size_is_a_mistake_of_the_caller(camera: GuardedCamera) -> None:
    with pytest.raises(LinkError, match=r"fetch: ValueError: camera gives .* expected"):
        camera.grab(np.zeros((HEIGHT_PX, WIDTH_PX + 1), np.uint8))
    camera.grab()


def test_replug(emulator: GigeCameraEmulator, sight: Sight) -> None:
    camera = guarded()
    camera.grab()
    emulator.unplug()
    with pytest.raises(LinkDownError, match="plugged in"):
        camera.grab()
    emulator.plug_in()
    assert np.array_equal(camera.grab().pixels, sight.last)
    assert camera.driver.counts.reconnects == 1
    camera.close()


def test_discovery_names_it(emulator: GigeCameraEmulator) -> None:
    found = [camera for camera in aravis.find_cameras() if camera.address == "127.0.0.1"]
    assert [(camera.vendor, camera.model, camera.camera_id) for camera in found] == [
        ("Aravis", "Fake", "Aravis-Fake-EMU1")
    ]
    named = guarded(SETTINGS.model_copy(update={"camera": found[0].camera_id}))
    named.grab()
    named.close()


def test_aravis_own_tool_gets_frames(emulator: GigeCameraEmulator) -> None:
    tool = program_path("arv-camera-test-0.8")
    options = (
        f"-n 127.0.0.1 -w {WIDTH_PX} -h {HEIGHT_PX} -i 8000 -e 2000 -o 20 -a --no-packet-socket "
        "--duration=2"
    )
    output = subprocess.run(
        [tool, *options.split()], capture_output=True, text=True, timeout=120, check=True
    ).stdout
    assert "EMU1" in output
    completed = int(re.search(r"n_completed_buffers\s*=\s*(\d+)", output)[1])  # type: ignore[index]
    assert 1 <= completed <= emulator.exposures


def test_without_the_library_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(aravis, "_LIBRARY", "libaravis-not-there.so")
    aravis.load_aravis.cache_clear()
    try:
        with pytest.raises(LinkError, match=r"apt install libaravis-0\.8-0"):
            guarded().open()
    finally:
        aravis.load_aravis.cache_clear()
