"""The tables `[devices.camera]` and `[devices.screen]` of the configuration."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from membrane_ctrl.section import Section


class AravisCamera(Section):
    """A GenICam camera (USB3 Vision or GigE Vision)."""

    driver: Literal["aravis"]
    camera: str = ""  # as `devices` lists it, or its address; empty: the first that is found
    pixel_format: Literal["Mono8", "Mono10", "Mono12", "Mono16", "BayerRG8", "BayerGR8", "BayerGB8", "BayerBG8"] = (
        "Mono8"
    )
    exposure_ms: Annotated[float, Field(gt=0, le=10_000)] = 20.0
    gain_db: Annotated[float, Field(ge=0, le=48)] = 0.0
    packet_bytes: Annotated[int, Field(ge=0, le=65_000)] = 0  # GigE Vision; 0: as the camera and the network agree
    timeout_s: Annotated[float, Field(gt=0, le=60)] = 1.0

    @property
    def bits(self) -> int:
        """Depth of a pixel."""
        return int(self.pixel_format[-2:]) if self.pixel_format[-2:].isdigit() else 8


class UvcCamera(Section):
    """A USB camera without GenICam."""

    driver: Literal["uvc"]
    port: str = "0"
    exposure: Annotated[float, Field(ge=0)] = 0.0  # in the camera's own unit; 0 leaves it
    gain: Annotated[float, Field(ge=0)] = 0.0
    bits: Literal[8] = 8


class FolderCamera(Section):
    """Pictures from a folder instead of a camera and a screen."""

    driver: Literal["folder"]
    folder: Annotated[str, Field(min_length=1)]


class PygameScreen(Section):
    """The display with the fringes."""

    driver: Literal["pygame"] = "pygame"
    display: Annotated[int, Field(ge=0, le=15)] = 0
    width_px: Annotated[int, Field(ge=16, le=16_384)]
    height_px: Annotated[int, Field(ge=16, le=16_384)]
    pixel_mm: Annotated[float, Field(gt=0.01, le=10)]
    centre_px: tuple[float, float] | None = None  # (column, row) of O'; the screen's middle when absent
    settle_ms: Annotated[float, Field(ge=0, le=5000)] | None = None  # measured at the start when absent
    linearise: bool = True  # measure the display's response at the start and correct it
    self_test: bool = True  # exposure and checkerboard at the start


CameraTable = Annotated[AravisCamera | UvcCamera | FolderCamera, Field(discriminator="driver")]
ScreenTable = PygameScreen
