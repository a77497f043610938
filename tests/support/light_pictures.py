"""Pictures of planted errors for docs/how-to/what-is-wrong.md.

`python -m tests.support.light_pictures` draws them from the second optical world, without noise, so
that they stay small. Each has a frame of the bad bench on the left, and on the right how it differs
from the sound one, ten times as strong (grey: no difference).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.worlds.second_optics import Bench, Effects, Ghost, Mirror, Panel, Sensor, World
from tests.worlds.second_optics.patterns import full_set

IMAGES = Path(__file__).parents[2] / "docs" / "images" / "what-is-wrong"
RESOLUTION = 0.125
GAIN = 10.0
QUIET = Sensor(read_adu=0.0, full_well=0.0)
SOUND = Effects(sensor=QUIET)

# name of the picture: effects, and the frame that shows them best
PLANTED: dict[str, tuple[Effects, str]] = {
    "overexposed": (Effects(sensor=replace(QUIET, exposure=1.6)), "x_sin_0"),
    "black": (Effects(sensor=replace(QUIET, black_clip=0.1)), "x_sin_0"),
    "response": (Effects(sensor=replace(QUIET, response_gamma=1.8)), "x_sin_0"),
    "slow-panel": (Effects(sensor=QUIET, panel=Panel(previous_share=0.05)), "y_sin_0"),
    "second-image": (
        Effects(sensor=QUIET, panel=Panel(ghost=Ghost(0.04, (25.0, -10.0)))),
        "x_gray_3",
    ),
    "viewing-angle": (Effects(sensor=QUIET, panel=Panel(falloff=0.15)), "white_0"),
    "blur": (Effects(sensor=QUIET, psf_px=2.5), "x_gray_4"),
}


def draw_planted_error(effects: Effects, frame: str) -> NDArray[np.uint8]:
    """A frame of the bad bench beside its difference from the sound one."""
    pictures = full_set()
    place = [picture.name for picture in pictures].index(frame)
    frames = [
        World(Mirror(), Bench.paper(RESOLUTION), each).frames(pictures[: place + 1])[0][place]
        for each in (effects, SOUND)
    ]
    bad, sound = (each.astype(float) for each in frames)
    difference = np.clip(128 + GAIN * (bad - sound), 0, 255)
    gap = np.full((bad.shape[0], 6), 255.0)
    return np.concatenate([bad, gap, difference], axis=1).astype(np.uint8)


def main() -> None:
    """Draw all pictures."""
    IMAGES.mkdir(parents=True, exist_ok=True)
    for name, (effects, frame) in PLANTED.items():
        picture = draw_planted_error(effects, frame)
        cv2.imwrite(str(IMAGES / f"{name}.png"), picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
