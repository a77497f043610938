"""Random benches of the second optical world: two sets each, measured, with what was planted.

Every second bench states sigmas of a hundredth (fine geometry), the others those of a hand
measurement (coarse). The true bench is drawn from the stated sigmas. Between the sets camera and
screen move by what the bar of a change allows without any sign, drawn likewise. On top come effects
of light, film, camera and panel, each with some probability and a random size, about three a bench.

With a laser the truth is the film at the mean of the sinusoids. Without one the bar also covers
that the film was elsewhere in the other frames: the truth is the film at the mean of all frames.
"""

from __future__ import annotations

import math
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.model.errors import CommandError
from membrane_ctrl.model.program import program_commit
from tests.studies.second_world_errors import drawn_points_mm, measured_errors
from tests.studies.second_world_tables import FAR
from tests.worlds.second_optics import (
    FRAME_S,
    Bench,
    Effects,
    Ghost,
    Mirror,
    Panel,
    Sensor,
    Stated,
    World,
    Wrinkles,
    drawn_errors,
    drawn_mirror,
)
from tests.worlds.second_optics.effects import ORIENTATIONS, Motion

FloatArray = NDArray[np.float64]

FINE = 0.01  # of the sigmas of a hand measurement
POINTS = 10
FRAMES = 18
BETWEEN_S = 120.0  # from one set to the next
# 1 sigma of each of the six motions of camera and of screen between two sets: mm, rad. Mounts of
# steel in a quarter of a kelvin (docs/explanation/tracking.md, section 7); 10 µm along the axis.
CREEP = np.array([3e-3, 3e-3, 10e-3, 3e-6, 3e-6, 3e-6])
FOLDING_LENS = [-3.0, 0.0, 0.0, 0.0]


@dataclass(frozen=True)
class DrawnBench:
    """A world and what was planted in it: cause -> size in the unit of its name."""

    world: World
    planted: dict[str, float]
    fine: bool


def draw_bench(seed: int, resolution: float = 0.25) -> DrawnBench:
    """The bench of a seed; the same at any resolution."""
    rng = np.random.default_rng((4747, seed))
    fine = bool(seed % 2)
    share = FINE if fine else 1.0
    planted: dict[str, float] = {}

    def sometimes(name: str, probability: float, size: float) -> float:
        """The size with a probability, else 0; what is planted is noted."""
        there = bool(rng.random() < probability)
        if there:
            planted[name] = float(size)
        return float(size) if there else 0.0

    mirror = _draw_film(rng, sometimes)
    errors = drawn_errors(rng, share)
    bench = Bench.paper(resolution).changed(errors)
    bench = replace(
        bench,
        twist_mm=share * rng.normal(0, 0.3),
        wave_mm=share * rng.normal(0, 0.02),
    )
    if not fine:
        planted["geometry by hand"] = 1.0
    effects = _draw_effects(rng, sometimes, resolution)
    effects = replace(effects, laser_scale=1 + errors["laser_relative"])
    stated = Stated(sigma_share=share)
    if sometimes("stated lens folds", 0.01, 1.0):
        stated = replace(stated, camera={"distortion": FOLDING_LENS})
    samples = 2 if resolution < 0.5 else 1
    world = World(mirror, bench, effects, stated, seed, samples)
    return DrawnBench(world, planted, fine)


def _draw_film(rng: np.random.Generator, sometimes: Callable[[str, float, float], float]) -> Mirror:
    orthotropic = sometimes("orthotropic film, E2/E1 below 1", 0.5, rng.uniform(0.02, 0.12))
    mirror = drawn_mirror(rng, orthotropic=False)
    material = replace(mirror.material, ratio=1 - orthotropic)
    if orthotropic:
        stretch = material.prestrain[0]
        uneven = stretch * rng.uniform(-0.3, 0.3)
        material = replace(material, prestrain=(stretch + uneven, stretch - uneven, 0.0))
    wrinkles_um = sometimes("wrinkles at the rim, um", 0.1, rng.uniform(2.0, 20.0))
    wrinkles = Wrinkles(wrinkles_um, int(rng.integers(30, 60))) if wrinkles_um else None
    return replace(mirror, material=material, wrinkles=wrinkles)


def _draw_effects(
    rng: np.random.Generator, sometimes: Callable[[str, float, float], float], resolution: float
) -> Effects:
    gamma = 1 + sometimes("gamma above 1", 0.4, rng.uniform(0.1, 1.2))
    ghost = sometimes("second reflection, share", 0.12, 10 ** rng.uniform(-2.5, -1.4))
    shift_mm = (float(rng.normal(0, 10)), float(rng.normal(0, 10)))
    panel = Panel(
        gamma=gamma,
        gamma_by_angle=sometimes("gamma by angle", 0.1, rng.uniform(-0.3, 0.3)),
        previous_share=sometimes("previous picture, share", 0.15, 10 ** rng.uniform(-2.5, -1)),
        falloff=sometimes("panel falls off", 0.12, rng.uniform(0.03, 0.15)),
        falloff_slope=sometimes("panel falls off sideways", 0.12, rng.uniform(0.03, 0.15)),
        contrast_falloff=sometimes("contrast falls off", 0.1, rng.uniform(0.03, 0.15)),
        ghost=Ghost(ghost, shift_mm) if ghost else None,
    )
    film_um = sometimes("film moves, um RMS", 0.4, rng.uniform(1.0, 30.0)) or 0.3
    noise = rng.standard_normal((2, FRAMES)) * film_um / math.sqrt(FRAMES)
    laser = not sometimes("no laser", 0.35, 1.0)
    yaw_like = sometimes("camera moves within a set, urad", 0.08, 10 ** rng.uniform(0, 1.7))
    creep = sometimes("camera moves between sets, urad", 0.08, 10 ** rng.uniform(0, 1.7))
    direction = rng.standard_normal(6)
    return Effects(
        camera_motion=_camera_motion(direction, yaw_like, creep),
        film_motion_um=_film_motion(noise),
        laser=laser,
        panel=panel,
        sensor=_draw_sensor(rng, sometimes, resolution),
        orientation=_draw_orientation(rng, sometimes),
        screen_exchanged=bool(sometimes("screen's axes exchanged", 0.01, 1.0)),
        psf_px=4
        * resolution
        * (sometimes("blur, px of a quarter", 0.3, rng.uniform(0.5, 2.0)) or 0.35),
        flicker=sometimes("flicker", 0.25, rng.uniform(0.001, 0.015)),
        ambient=sometimes("ambient light grows", 0.25, rng.uniform(0.005, 0.05)),
        dust=int(sometimes("dust, spots", 0.2, rng.integers(5, 25))),
        stale_frame=_draw_stale(rng, sometimes),
    )


def _draw_sensor(
    rng: np.random.Generator, sometimes: Callable[[str, float, float], float], resolution: float
) -> Sensor:
    deep = bool(rng.random() < 0.3)
    usual = float(rng.uniform(0.7, 1.1))
    exposure = sometimes("overexposed", 0.04, rng.uniform(1.3, 2.5)) or usual
    container = "plain"
    if deep and sometimes("12 bits left-aligned", 0.3, 1.0):
        container = "left-aligned"
    if deep and sometimes("bytes exchanged", 0.03, 1.0):
        container = "byte-swapped"
    if deep and sometimes("12 bits packed", 0.03, 1.0):
        container = "packed"
    if not deep and sometimes("video range", 0.04, 1.0):
        container = "video range"
    return Sensor(
        bits=12 if deep else 8,
        exposure=exposure,
        response_gamma=1 + sometimes("camera's response has a gamma", 0.03, rng.uniform(0.1, 1.2)),
        black_clip=sometimes("clipped at black", 0.03, rng.uniform(0.03, 0.12)),
        container=container,
        read_adu=4.0 if deep else 0.4,
        full_well=1e4 / resolution**2,
    )


def _draw_orientation(
    rng: np.random.Generator, sometimes: Callable[[str, float, float], float]
) -> str:
    name = str(rng.choice(ORIENTATIONS[1:]))
    return name if sometimes(f"frames {name}", 0.03, 1.0) else ""


def _draw_stale(
    rng: np.random.Generator, sometimes: Callable[[str, float, float], float]
) -> int | None:
    frame = int(rng.integers(1, 4)) + 8 * int(rng.integers(2))
    return frame if sometimes("stale frame", 0.06, frame) else None


def _film_motion(noise: FloatArray) -> Callable[[float], float]:
    """A random walk from frame to frame, another one in the second set."""
    walks = np.cumsum(noise, axis=1)

    def motion(time_s: float) -> float:
        second = int(time_s >= BETWEEN_S)
        frame = round((time_s - second * BETWEEN_S) / FRAME_S)
        return float(walks[second, min(frame, FRAMES - 1)])

    return motion


def _camera_motion(direction: FloatArray, within_urad: float, between_urad: float) -> Motion | None:
    """A creep during each set and a step between the sets; shifts as at a lever of 1 m."""
    if not (within_urad or between_urad):
        return None
    unit = np.array([1e-3, 1e-3, 1e-3, 1e-6, 1e-6, 1e-6]) * direction

    def motion(time_s: float) -> FloatArray:
        second = int(time_s >= BETWEEN_S)
        part = (time_s - second * BETWEEN_S) / (FRAMES * FRAME_S)
        return np.asarray(unit * (within_urad * part + between_urad * second))

    return motion


def bench_answer(seed: int, resolution: float = 0.25) -> dict[str, Any]:
    """Measure both sets of a bench: errors and sigmas of the first, and of the change."""
    begin_s = time.process_time()
    drawn = draw_bench(seed, resolution)
    creep = CREEP * np.random.default_rng((4749, seed)).standard_normal((2, CREEP.size))
    rng = np.random.default_rng((4748, seed))
    points_mm = drawn_points_mm(rng, POINTS)
    places_um = rng.uniform(-50.0, 50.0, 2)
    answer: dict[str, Any] = {
        "seed": seed,
        "fine": drawn.fine,
        "commit": program_commit(),
        "laser": drawn.world.effects.laser,
        "planted": drawn.planted,
        "sets": [],
    }
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for k, place_um in enumerate(places_um):
            path = Path(folder) / f"set{k}"
            if k == 1:
                drawn.world.move_bench(*creep)
            truth = drawn.world.write_set(path, float(place_um), k * BETWEEN_S)
            if not drawn.world.effects.laser:
                truth = drawn.world.truth(range(FRAMES), truth.displacements_um)
            try:
                one = measured_errors(path, drawn.world.mirror, truth, points_mm)
            except CommandError as error:
                reason = str(error).replace(folder, "")
                answer["sets"].append({"verdict": "refused", "reason": reason, "flagged": []})
                continue
            except Exception:
                last = traceback.format_exc().splitlines()[-1]
                answer["sets"].append({"verdict": "crash", "reason": last, "flagged": []})
                continue
            verdict_row = {
                "verdict": one.verdict,
                "reason": one.reason,
                "flagged": list(one.flagged),
            }
            verdict_row |= {"geometry": one.geometry}
            if one.error_um is not None and one.sigma_um is not None:
                verdict_row |= {
                    "error_um": one.error_um.tolist(),
                    "sigma_um": one.sigma_um.tolist(),
                    "chance_far": one.chance_beyond(FAR),
                }
                found.append(one)
            answer["sets"].append(verdict_row)
    if len(found) == len(places_um):
        first, second = found
        assert first.error_um is not None
        assert second.error_um is not None
        answer["change_error_um"] = (second.error_um - first.error_um).tolist()
        answer["change_sigma_um"] = second.change_sigma_um(first).tolist()
    answer["cpu_s"] = round(time.process_time() - begin_s, 1)
    return answer
