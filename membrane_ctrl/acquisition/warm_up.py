"""Every kernel of the cycle once, on a small sensor: on a fresh machine they are compiled here, for many seconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from firmware_iface.roles import Pattern
from membrane_ctrl.acquisition.cycle import CycleClock, CyclePlan, Reconstructor
from membrane_ctrl.acquisition.frames import Pixels
from membrane_ctrl.config import OpticsConfig, TwinConfig
from membrane_ctrl.twin.camera import FilmPosition, TwinOptics


@dataclass(frozen=True, slots=True)
class _StandingFilm:
    """A film at its usual sag."""

    displacement_um: float
    sag_mm: float


# A real film's sag is not known before it was measured; a meter of film at the usual pressure has this one
TYPICAL_FILM: FilmPosition = _StandingFilm(0.0, 37.1)

_SMALL_PX = 300  # this side still gives 36 terms enough points, in a hundredth of the work


def small(optics: OpticsConfig) -> OpticsConfig:
    """The same view on a sensor with larger pixels."""
    camera = optics.camera
    larger = max(1, min(camera.width_px, camera.height_px) // _SMALL_PX)
    column_px, row_px = ((p + 0.5) / larger - 0.5 for p in camera.principal)  # pixel centres are at integers
    coarse = camera.model_copy(
        update={
            "width_px": camera.width_px // larger,
            "height_px": camera.height_px // larger,
            "pixel_um": camera.pixel_um * larger,
            "principal_px": (column_px, row_px),
        }
    )
    return optics.model_copy(update={"camera": coarse})


def warm_up(
    reconstructor: Reconstructor, optics: OpticsConfig, plan: CyclePlan, position: FilmPosition, clock: CycleClock
) -> None:
    """A full cycle and two of fringes only, with and without known motion, of a film that stands still.

    Parameters
    ----------
    reconstructor : Reconstructor
        One to be thrown away, for `small(optics)`.
    optics : OpticsConfig
        The small ones.
    plan : CyclePlan
        The patterns.
    position : FilmPosition
        Where the film stands.
    clock : CycleClock
        The run's clock.
    """
    bench = TwinOptics(optics, TwinConfig(), lambda: position, clock)

    def exposures(patterns: Sequence[Pattern]) -> list[Pixels]:
        taken: list[Pixels] = []
        for pattern in patterns:
            bench.screen.show(pattern)
            taken.append(bench.camera.grab().pixels)
        return taken

    # displacements that differ by more than noise let the kernels run that take the film's motion out
    still, moving = np.zeros(1), np.array([-10.0, 10.0])
    for patterns, reconstruct, motion_um in (
        (plan.full, reconstructor.full, moving),
        (plan.fringes, reconstructor.fringes, moving),
        (plan.fringes, reconstructor.fringes, still),
    ):
        frames = exposures(patterns)
        displacement_um = position.displacement_um + np.resize(motion_um, len(frames))
        reconstruct(frames, 0.1 * np.arange(len(frames), dtype=np.float64), displacement_um)
