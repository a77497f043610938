"""Pictures of the mirror in front of a white and a black screen, for focus and exposure."""

from dataclasses import dataclass

from firmware_iface.guarded_camera import GuardedCamera
from firmware_iface.optical_roles import Pattern, Pixels
from firmware_iface.pattern_screen import PatternScreen
from membrane_ctrl.acquisition.optical_bench import OpticalBench


@dataclass(frozen=True, slots=True)
class MirrorPictures:
    """The mirror lit and dark.

    Attributes
    ----------
    white, black : (H, W) array
        Counts in front of a white and of a black screen.
    """

    white: Pixels
    black: Pixels


def take_mirror_pictures(optics: OpticalBench) -> MirrorPictures:
    """Open camera and screen and take both pictures. Raises LinkError."""
    for device in (optics.camera, optics.screen):
        if isinstance(device, GuardedCamera | PatternScreen):
            device.open()
    pictures = []
    for role in ("white", "black"):
        optics.screen.show(Pattern(role))
        pictures.append(optics.camera.grab().pixels.copy())
    return MirrorPictures(*pictures)
