"""A frame that did not come whole, and taking it again."""

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from firmware_iface.roles import Frame, LinkError

# One lost packet spoils a frame; three spoilt in a row are no accident
TRIES = 3


class FrameLostError(LinkError):
    """One exposure gave no whole frame; the camera is there and may be asked again."""


@runtime_checkable
class ExposingCamera(Protocol):
    """A camera whose transfer may overlap with the next pattern."""

    def expose(self, out: NDArray[np.uint8] | NDArray[np.uint16] | None = None) -> None:
        """Trigger, and return when the exposure is over. Raises LinkError."""

    def fetch(self) -> Frame:
        """The frame of the last `expose`. Raises FrameLostError, LinkError."""


def regrab(camera: ExposingCamera, out: NDArray[np.uint8] | NDArray[np.uint16] | None = None) -> Frame:
    """Expose and fetch, up to `TRIES` times. Raises the last FrameLostError, or the first other LinkError."""
    for _ in range(TRIES - 1):
        camera.expose(out)
        try:
            return camera.fetch()
        except FrameLostError:
            continue
    camera.expose(out)
    return camera.fetch()
