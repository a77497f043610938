"""Runs every kernel of the cycle once, on a small sensor.

A fresh machine compiles them here, for many seconds.
"""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.acquisition import cycle, cycle_plan, exposures
from membrane_ctrl.config.schema import OpticsConfig, TwinConfig
from membrane_ctrl.sim.optics.camera import FilmPosition, TwinOptics

_SMALL_PX = 300  # still enough points for the fit of the terms, at a hundredth of the work


@dataclass(frozen=True, slots=True)
class FilmAtRest:
    """A film at its usual sag: that of a metre of film at the usual pressure. That of the real film
    is unknown before the measurement.
    """

    displacement_um: float = 0.0
    sag_mm: float = 37.1


def coarse_optics(optics: OpticsConfig) -> OpticsConfig:
    """The same view on a sensor with larger pixels."""
    camera = optics.camera
    larger = max(1, min(camera.width_px, camera.height_px) // _SMALL_PX)
    # Pixel centres are at integers.
    column_px, row_px = ((place + 0.5) / larger - 0.5 for place in camera.principal)
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
    reconstructor: cycle.Reconstructor,
    optics: OpticsConfig,
    plan: cycle_plan.CyclePlan,
    position: FilmPosition,
    clock: exposures.CycleClock,
) -> None:
    """Run a full cycle and two fringes-only cycles, with and without known motion.

    Parameters
    ----------
    reconstructor : Reconstructor
        One for this call alone, of the bench `optics`.
    optics : OpticsConfig
        The bench of `coarse_optics`.
    plan : CyclePlan
        Patterns of the cycles.
    position : FilmPosition
        Sag and displacement of the film.
    clock : CycleClock
        Of the simulated exposures.
    """
    bench = TwinOptics(optics, TwinConfig(), lambda: position, clock)
    # Displacements that differ by more than noise trigger the kernels that correct the film's
    # motion.
    still = np.zeros(1)
    moving = np.array([-10.0, 10.0])
    for full, reconstruct, motion_um in (
        (True, reconstructor.measure_full, moving),
        (False, reconstructor.measure_fringes, moving),
        (False, reconstructor.measure_fringes, still),
    ):
        taken = []
        for pattern in plan.list_patterns(full):
            bench.screen.show(pattern)
            taken.append(bench.camera.grab().pixels)
        displacement_um = position.displacement_um + np.resize(motion_um, len(taken))
        reconstruct(taken, 0.1 * np.arange(len(taken), dtype=np.float64), displacement_um)
