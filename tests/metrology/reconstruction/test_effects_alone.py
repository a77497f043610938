"""One effect at a time that `measure` has no statement of, rendered by a ray tracer that shares no
code with it.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.model.errors import Exit
from tests.studies.effects_alone import EFFECTS, Effect, answer
from tests.studies.tracked_errors import CLEAN, SIZE
from tests.worlds.crossed_fringes import CrossedWorld

BY_NAME = {effect.description: effect for effect in EFFECTS}


def assert_held(effect: Effect, doubt: str) -> None:
    """The errors are as large as their bars at most, and the verdict says why they are wide."""
    found = answer(effect, seed=3)
    assert not isinstance(found, str)
    errors_um, sigmas_um, verdict, doubts = found
    assert np.all(np.abs(errors_um) < 3 * sigmas_um)
    assert verdict == ("degraded" if doubt else "ok")
    assert doubt in " ".join(doubts)


@pytest.mark.parametrize("moved_um", [100, 500])
def test_a_film_that_moved_without_a_laser_is_in_the_bar_of_its_sag(moved_um: int) -> None:
    """The mean of the frames is half the motion away from the first: the sag was 6 sigma off."""
    assert_held(BY_NAME[f"film {moved_um} µm deeper in y, no laser"], "from the x to the y frames")


@pytest.mark.parametrize(
    ("name", "doubt"),
    [
        ("nothing", ""),
        ("camera turned by 0.1 degrees", ""),  # 1 sigma of what is stated: no contradiction
        ("blur of 8 px", "focus the camera"),
    ],
)
def test_failed_consistency_checks_of_a_set_are_in_its_verdict(name: str, doubt: str) -> None:
    assert_held(BY_NAME[name], doubt)


def test_a_resting_film_with_a_figure_of_its_own_has_not_moved(tmp_path: Path) -> None:
    """Its ripple is no term of the fit, and no motion: it counted as 26 +- 6 µm of it."""
    world = CrossedWorld(seed=1, **(SIZE | CLEAN), bits=16, noise_adu=0.05)  # type: ignore[arg-type]
    world.write_reference(tmp_path / "full")
    assert run(["measure", str(tmp_path / "full"), "--no-pictures"]) == Exit.DONE
    result = json.loads((tmp_path / "full" / "result" / "result.json").read_text())
    assert "the film moved" not in result["quality"]["reason"]
