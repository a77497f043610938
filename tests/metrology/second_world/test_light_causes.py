"""Causes planted in the light of the second world: each is named, and none of the others.

A diagnosis is printed only if its own signature beats the alternatives. The error of the figure
that a cause leaves is inside the stated bar.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from tests.studies.second_world_errors import MeasuredErrors, measured_errors
from tests.worlds.second_optics import Effects, Ghost, Mirror, Panel, Sensor, Stated, World

# heights at these points show a tilt, which the terms that are compared do not
POINTS_MM = np.array([[200.0, -300.0, 0.0, 400.0], [100.0, 200.0, -400.0, 0.0]])
# words by which each cause is known
WORDS = {
    "focus": "focus the camera",
    "saturated": "shorten the exposure",
    "black": "clipped at black",
    "slow panel": "wait longer",
    "second image": "a second image of the screen",
    "response": "response is not linear",
    "frames": "flagged",
    "geometry": "the rim is",
    "laser": "laser",
}


@dataclass(frozen=True)
class Cause:
    """A planted effect, and the cause that must be named; empty: none, and the verdict is ok."""

    effects: Effects
    named: str = ""


CAUSES = {
    "nothing": Cause(Effects()),
    "panel darker at an angle": Cause(Effects(panel=Panel(falloff=0.15))),
    "panel darker to one side": Cause(Effects(panel=Panel(falloff_slope=0.15))),
    "panel of less contrast at an angle": Cause(Effects(panel=Panel(contrast_falloff=0.1))),
    "gamma 2.2": Cause(Effects(panel=Panel(gamma=2.2))),
    "gamma by angle": Cause(Effects(panel=Panel(gamma=1.6, gamma_by_angle=0.3))),
    "blur": Cause(Effects(psf_px=2.5), "focus"),
    "blur that crosses the edges of Gray bits": Cause(Effects(psf_px=1.4), "focus"),
    "blur behind a dark edge": Cause(Effects(psf_px=2.5, panel=Panel(falloff=0.15)), "focus"),
    "overexposed": Cause(Effects(sensor=Sensor(exposure=1.6)), "saturated"),
    "overexposed, 12 of 16 bits": Cause(
        Effects(sensor=Sensor(bits=12, container="left-aligned", exposure=1.6)), "saturated"
    ),
    "video range": Cause(
        Effects(sensor=Sensor(container="video range", exposure=1.3)), "saturated"
    ),
    "cut at black": Cause(Effects(sensor=Sensor(black_clip=0.06)), "black"),
    "camera gamma": Cause(Effects(sensor=Sensor(response_gamma=1.8)), "response"),
    "camera gamma and panel gamma": Cause(
        Effects(sensor=Sensor(response_gamma=2.2), panel=Panel(gamma=2.4))
    ),
    "slow panel, 1 %": Cause(Effects(panel=Panel(previous_share=0.01))),
    "slow panel, 3 %": Cause(Effects(panel=Panel(previous_share=0.03))),
    "slow panel, 10 %": Cause(Effects(panel=Panel(previous_share=0.1)), "slow panel"),
    "second image, 1 %": Cause(Effects(panel=Panel(ghost=Ghost(0.01))), "second image"),
    "second image, 4 %": Cause(Effects(panel=Panel(ghost=Ghost(0.04))), "second image"),
    "second image and slow panel": Cause(
        Effects(panel=Panel(ghost=Ghost(0.01), previous_share=0.01)), "second image"
    ),
}


@cache
def mirror() -> Mirror:
    """The film is solved once."""
    return Mirror()


def measured(effects: Effects, folder: Path) -> MeasuredErrors:
    """One set of the quarter bench, whose geometry is known to a hundredth of a hand's measure."""
    world = World(mirror(), effects=effects, stated=Stated(sigma_share=0.01), seed=5)
    truth = world.write_set(folder)
    return measured_errors(folder, world.mirror, truth, POINTS_MM)


@pytest.mark.fast_cases(
    "nothing",
    "panel darker to one side",
    "blur behind a dark edge",
    "overexposed, 12 of 16 bits",
    "cut at black",
    "camera gamma",
    "camera gamma and panel gamma",
    "slow panel, 3 %",
    "slow panel, 10 %",
    "second image and slow panel",
)
@pytest.mark.parametrize("name", CAUSES)
def test_the_cause_of_wrong_light_is_reported_and_no_other(name: str, tmp_path: Path) -> None:
    cause = CAUSES[name]
    found = measured(cause.effects, tmp_path / "set")
    printed = {word for word, text in WORDS.items() if text in found.reason}
    assert printed == ({cause.named} if cause.named else set()), found.reason
    assert (found.verdict == "ok") == (not cause.named), found.reason
    assert not found.flagged
    if found.verdict != "rejected":
        assert found.error_um is not None
        assert found.sigma_um is not None
        assert np.all(np.abs(found.error_um) < 3 * found.sigma_um + 0.01)


def test_a_second_image_is_placed(tmp_path: Path) -> None:
    """Where it comes from on the screen helps to find the surface."""
    found = measured(Effects(panel=Panel(ghost=Ghost(0.02, (30.0, -18.0)))), tmp_path / "set")
    share, _, place = found.reason.partition("% of the light (")
    assert place.startswith("+30 mm along x and -18 mm along y)")
    assert float(share.rpartition(" ")[2]) == pytest.approx(2.0, abs=0.25)
    assert found.budget is not None
    row = next(row for row in found.budget.rows() if row["name"] == "second_image")
    assert row["height_rms_um"] > 1.0


def test_waves_of_a_gamma_are_no_blur_where_a_frame_is_left_out(tmp_path: Path) -> None:
    """Three steps do not cancel the harmonics, which the contrast then has, too."""
    effects = Effects(panel=Panel(gamma=1.6), stale_frame=2)
    world = World(mirror(), effects=effects, stated=Stated(), seed=5)
    truth = world.write_set(tmp_path)
    found = measured_errors(tmp_path, world.mirror, truth, POINTS_MM)
    assert found.flagged
    assert "focus" not in found.reason
