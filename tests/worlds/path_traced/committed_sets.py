"""The six small sets that stand in the repository, and how each was rendered.

`python -m benchmarks.metrology.path_traced sets` renders them again (some 20 minutes of two cores).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tests.worlds.path_traced.scene import FrontFilm, RenderedBench, RenderSettings
from tests.worlds.path_traced.sets import AddedLight, write_rendered_set
from tests.worlds.second_optics import (
    Bench,
    Mirror,
    Stated,
    Truth,
    World,
    drawn_errors,
    drawn_mirror,
)

FOLDER = Path("tests/data/path_traced")
RESOLUTION = 0.125  # of the paper's camera: 306 x 256 pixels
LIFTED_UM = 40.0  # displacement of the second set of a pair
FINE_SIGMAS = 0.01  # stated sigmas, of those of a hand measurement


@dataclass(frozen=True)
class CommittedSet:
    """How a set is rendered, and what is stated of its bench."""

    bench: RenderedBench
    displacement_um: float = 0.0
    added: AddedLight = field(default_factory=AddedLight)
    stated: Stated = field(default_factory=lambda: Stated(sigma_share=FINE_SIGMAS))
    samples: int = 64

    def write(self, folder: Path, seed: int, variant: str = "scalar_rgb") -> Truth:
        """Render and write the set. Raises ImportError without Mitsuba."""
        settings = RenderSettings(samples=self.samples, variant=variant)
        return write_rendered_set(
            self.bench, folder, settings, seed, self.displacement_um, self.stated, self.added
        )

    def truth(self) -> Truth:
        """Truth of the set; all of its frames have the same displacement."""
        world = World(self.bench.mirror, self.bench.bench)
        return world.truth([0], np.array([self.displacement_um]))


def committed_sets() -> dict[str, CommittedSet]:
    """The sets by the names of their folders."""
    paper = Bench.paper(RESOLUTION)
    sound = RenderedBench(Mirror(), paper)
    behind_film = RenderedBench(Mirror(), paper, front=FrontFilm())
    woven = RenderedBench(drawn_mirror(np.random.default_rng(31), orthotropic=True), paper)
    # the principal point stays in the middle of the rendered picture
    errors = drawn_errors(np.random.default_rng(32))
    unseen = ("principal", "focal", "k1", "k2", "p1", "p2", "bow", "glass", "air")
    errors = {name: 0.0 if name.startswith(unseen) else off for name, off in errors.items()}
    by_hand = RenderedBench(Mirror(), paper.changed(errors), room=0.03)
    return {
        "sound": CommittedSet(sound),
        "sound-lifted": CommittedSet(sound, LIFTED_UM),
        "orthotropic": CommittedSet(woven, added=AddedLight(falloff=0.1)),
        "by-hand": CommittedSet(by_hand, stated=Stated(sigma_share=1.0)),
        "front-film": CommittedSet(behind_film, samples=144),
        "front-film-lifted": CommittedSet(behind_film, LIFTED_UM, samples=144),
    }
