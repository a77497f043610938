"""The example with camera and screen: `check` measures a real X display through an emulated GigE
camera.
"""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from membrane_ctrl.config.schema import Config, DevicesConfig
from membrane_ctrl.config.toml_file import dump_toml, load_toml
from membrane_ctrl.sim.lab import Lab
from tests.support.virtual_display import screenshot, virtual_display
from tests.worlds.gige_camera import GigeCameraEmulator, gige_camera
from tests.worlds.still_plant import StillPlant

pytestmark = pytest.mark.real_time

# large frames over loopback are tried elsewhere (tests/firmware_iface/test_camera_aravis.py)
SHRINK = 4


def _example() -> Config:
    example = load_toml(
        Path(__file__).parents[2] / "membrane_ctrl" / "examples" / "paper-bench.toml", Config
    )
    camera = example.optics.camera
    size = {"width_px": camera.width_px // SHRINK, "height_px": camera.height_px // SHRINK}
    smaller = camera.model_copy(update={**size, "pixel_um": camera.pixel_um * SHRINK})
    return example.model_copy(
        update={"optics": example.optics.model_copy(update={"camera": smaller})}
    )


EXAMPLE = _example()
GAMMA = 2.2
LIGHT = (np.arange(256) / 255.0) ** GAMMA  # of a level
STRIDE_PX = 5  # odd, so that as many bright as dark pixels of a checkerboard are sampled
BLOCK_PX = 4  # each block of camera pixels sees the mean light of its part of the display


class Sight:
    """A camera that photographs the display; `exposure_ms` 20 is right for it."""

    def __init__(self, framebuffer: Path, width_px: int, height_px: int) -> None:
        self._framebuffer = framebuffer
        self._blocks = (width_px // BLOCK_PX, height_px // BLOCK_PX)

    def expose(self, exposure_ms: float, gain: int) -> Any:
        levels = screenshot(self._framebuffer)[::STRIDE_PX, ::STRIDE_PX, 0]
        seen = cv2.resize(
            LIGHT.astype(np.float32)[levels], self._blocks, interpolation=cv2.INTER_AREA
        )
        counts = np.clip(np.rint(8 + 200 * seen * exposure_ms / 20.0), 0, 255).astype(np.uint8)
        return np.repeat(np.repeat(counts, BLOCK_PX, axis=0), BLOCK_PX, axis=1)


@pytest.fixture
def camera(tmp_path: Path) -> Iterator[GigeCameraEmulator]:
    assert EXAMPLE.devices is not None
    assert EXAMPLE.devices.screen is not None
    optics, screen = EXAMPLE.optics.camera, EXAMPLE.devices.screen
    with virtual_display(tmp_path, screen.width_px, screen.height_px) as framebuffer:
        sight = Sight(framebuffer, optics.width_px, optics.height_px)
        with gige_camera(sight.expose, optics.width_px, optics.height_px) as emulator:
            yield emulator


async def check(config: Config, path: Path) -> tuple[int, dict[str, Any], str]:
    """Exit code, the camera's probe, standard error."""
    path.write_text(dump_toml(config), encoding="utf-8")  # noqa: ASYNC240
    patient = Path(__file__).parents[1] / "patience.py"
    command = [sys.executable, str(patient), "check", str(path), "--json"]
    pipe = asyncio.subprocess.PIPE
    process = await asyncio.create_subprocess_exec(*command, stdout=pipe, stderr=pipe)
    out, err = await process.communicate()
    assert out, err
    probes = {probe["role"]: probe for probe in json.loads(out)["devices"]}
    assert process.returncode is not None
    return process.returncode, probes["camera"], err.decode()


@pytest.fixture
async def devices(camera: GigeCameraEmulator) -> AsyncIterator[DevicesConfig]:
    """The devices of the example, emulated."""
    assert EXAMPLE.devices is not None
    lab = Lab(StillPlant(), EXAMPLE.devices)
    made = await lab.start()
    assert made.camera is not None
    table = made.camera.model_copy(update={"camera": "127.0.0.1", "packet_bytes": 8000})
    yield made.model_copy(update={"camera": table})
    await lab.stop()


async def test_the_example_passes_check_with_camera_and_screen(
    devices: DevicesConfig, tmp_path: Path
) -> None:
    config = EXAMPLE.model_copy(update={"devices": devices})
    code, probe, errors = await check(config, tmp_path / "moved.toml")
    assert (code, probe["problem"]) == (0, ""), errors
    assert "gamma 2.2" in probe["notes"]
    assert "settles in" in probe["notes"]


@pytest.mark.campaign  # test_acquisition_display_test.py tests the findings about a display
async def test_a_picture_that_is_too_bright_is_reported(
    devices: DevicesConfig, tmp_path: Path
) -> None:
    assert devices.camera is not None
    assert devices.screen is not None
    bright = devices.camera.model_copy(update={"exposure_ms": 200.0})
    quick = devices.screen.model_copy(update={"settle_ms": 50.0, "linearise": False})
    changed = devices.model_copy(update={"camera": bright, "screen": quick})
    code, probe, _ = await check(
        EXAMPLE.model_copy(update={"devices": changed}), tmp_path / "bright.toml"
    )
    assert code == 4
    assert "saturated" in probe["problem"]
    assert "lower exposure_ms" in probe["problem"]
