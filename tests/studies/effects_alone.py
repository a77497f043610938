"""One effect at a time that `measure` does not know: true error, error bar and verdict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.metrology.frame_checks.checked_set import RejectedSetError
from membrane_ctrl.sim.optics.film_shape import Ripple, typical_film
from membrane_ctrl.sim.optics.pattern_levels import Light
from tests.studies.measured_sets import measured, quantities, truth_of
from tests.worlds.misstated_bench import BentRays, Room, bench_off_by, stated_bench

FloatArray = NDArray[np.float64]

STEADY = Room(1.0, 0.0, 0.0, 0.0, laser=True, moves_um=0.0, dust=False, stale=False)
POINTS = 200  # of the map


@dataclass(frozen=True)
class Effect:
    """What is wrong, and nothing else."""

    description: str
    off: Mapping[str, float] = field(default_factory=dict)  # by how much the bench is stated wrong
    room: Mapping[str, Any] = field(default_factory=dict)  # what differs from `STEADY`
    between_um: float = 0.0  # by how much the film is deeper in the y frames than in the x frames
    prestrain: float = 0.0
    poisson: float = 0.3
    ripple: tuple[Ripple, ...] = ()

    @property
    def of_geometry(self) -> bool:
        """Whether the bench itself is stated wrong: then its sigmas are those of rulers and data
        sheets.
        """
        return bool(self.off)


EFFECTS = (
    Effect("nothing"),
    Effect("principal point 20 px off", {"principal_x_px": 20.0 / 8}),
    Effect("camera turned by 0.1 degrees", {"camera_yaw_deg": 0.1}),
    Effect("focal length 1 % off", {"focal_relative": 0.01}),
    Effect("focal length 0.1 % off", {"focal_relative": 0.001}),
    Effect("pixel pitch 0.1 % off", {"pitch_relative": 0.001}),
    Effect("screen turned by 0.5 degrees", {"screen_turn_x_deg": 0.5}),
    Effect("screen shifted by 1 mm", {"screen_x_mm": 1.0}),
    Effect("flicker of 2 %", room={"flicker": 0.02}),
    Effect("ambient light grows by 5 %", room={"ambient": 0.05}),
    Effect("gamma 2.2, 4 steps", room={"gamma": 2.2}),
    Effect("blur of 3 px", room={"blur_px": 3.0}),
    Effect("blur of 8 px", room={"blur_px": 8.0}),
    Effect("film 100 µm deeper in y, no laser", room={"laser": False}, between_um=100.0),
    Effect("film 500 µm deeper in y, no laser", room={"laser": False}, between_um=500.0),
    Effect("ripple of 0.2 µm at 40 mm", ripple=(Ripple(0.2, 40.0, 30.0),)),
    Effect("Poisson ratio 0.4", poisson=0.4),
    Effect("pre-strain 1e-3", prestrain=1e-3),
)


def answer(effect: Effect, seed: int) -> tuple[FloatArray, FloatArray, str, tuple[str, ...]] | str:
    """Errors and sigmas (n,) in µm of sag, Z4..Z11 and heights, verdict and its reasons; why, if
    rejected.
    """
    rng, room = np.random.default_rng((19, seed)), replace(STEADY, **effect.room)
    stated = stated_bench(calibrated=not effect.of_geometry)
    film = replace(
        typical_film(37.1, 500.0, seed, effect.prestrain, effect.poisson), ripples=effect.ripple
    )
    renderer = BentRays(bench_off_by(stated, effect.off), film, Light(gamma=room.gamma), seed=seed)

    def render(pattern: Any, displacement_um: float, gain: float) -> FloatArray:
        place_um = displacement_um + effect.between_um * (pattern.axis == "y")
        return renderer.render_picture(pattern, place_um, gain=gain).astype(float)

    radius, angle = 475 * np.sqrt(rng.random(POINTS)), 2 * np.pi * rng.random(POINTS)
    points_mm = np.stack([radius * np.cos(angle), radius * np.sin(angle)])
    rows = quantities(points_mm)
    stack = room.stack(render, rng, stated.camera)
    truth_mm = truth_of(film, room.mean_um + effect.between_um / 2, points_mm)
    try:
        full, examined, verdict = measured(stack, stated)
    except RejectedSetError as error:
        return str(error)
    if verdict == "rejected":
        return "quality"
    covariance = examined.budget.covariance(True) + examined.budget.covariance(False)
    sigma_mm = np.sqrt(np.einsum("ij,jk,ik->i", rows, covariance, rows))
    return (
        1e3 * (rows @ full.surface.parameters - truth_mm),
        1e3 * sigma_mm,
        verdict,
        tuple(examined.doubts),
    )
