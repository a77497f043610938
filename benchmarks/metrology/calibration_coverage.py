"""Coverage of the error bars of `calibrate` on random benches with an error in every input of the
budget.

As in `benchmarks.metrology.coverage`, whose rays and rooms these are: poses, lens, screen and laser
drawn from the sigmas that are stated, glass, air, growth, gamma, light, blur, motion, dust, stale
frames, a film of any pre-strain and Poisson ratio. Five sets over 8 mm are calibrated as the
command does; the middle one is then measured with the new geometry. Benches take turns: known by
rulers and data sheets; with a, b, the screen's pitch and the ring better known; by rulers and data
sheets, with a set of a sphere in the mirror's place, whose radius, place and form are drawn as
well; two sets only, both again with the screen on a rail, and two of the screen itself, its pitch
known to 1e-4. `python -m benchmarks.metrology.calibration_coverage 60` adds benches to the file
until there are 60.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.metrology.calibration import errors_um
from membrane_ctrl.calibration.calibrate_options import CalibrateOptions
from membrane_ctrl.calibration.set_points import phases_of, phases_of_screen
from membrane_ctrl.calibration.sets import Bundle, join_moved_screen
from membrane_ctrl.calibration.stated_problem import problem_of
from membrane_ctrl.config.optics import CameraConfig, OpticsConfig, ScreenPoseConfig
from membrane_ctrl.geometry.file import stated_origin
from membrane_ctrl.geometry.set_tables import ScreenMovedTable, move_screen
from membrane_ctrl.measure.capture_set import CaptureHead, CaptureSet
from membrane_ctrl.metrology.calibration import figure_uncertainty, verdict
from membrane_ctrl.metrology.calibration.rim_edges import find_edges
from membrane_ctrl.metrology.calibration.solver import Solution, fit_on, solve_calibration
from membrane_ctrl.metrology.frame_checks.checked_set import Checked, RejectedSetError
from membrane_ctrl.metrology.frame_checks.set_check import check_set
from membrane_ctrl.metrology.phase.frame_stack import FrameStack
from membrane_ctrl.metrology.rays.artefacts import Artefact
from membrane_ctrl.metrology.rays.bench_parameters import NAMES
from membrane_ctrl.metrology.rays.bench_poses import pose_derivatives
from membrane_ctrl.metrology.rays.forward_model import MOTION, linearise_points
from membrane_ctrl.metrology.rays.set_phases import SetPhases
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.sim.optics.bench_poses import camera_pose
from membrane_ctrl.sim.optics.film_shape import FilmShape, typical_film
from membrane_ctrl.sim.optics.pattern_levels import Light
from membrane_ctrl.sim.optics.simulation_spec import make_artefact_shape
from tests.studies.resumable_answers import answers
from tests.support.figures import Figure, at_most
from tests.worlds.misstated_bench import (
    BentRays,
    DirectRays,
    FloatArray,
    Room,
    stated_bench,
    stated_sigmas,
    true_bench,
)

ANSWERS = Path("logs/calibration-coverage.jsonl")
BENCHES = 40
MOVED_UM = (-4000.0, -2000.0, 0.0, 2000.0, 4000.0)
TWO_UM = (-4000.0, 0.0)  # of benches whose screen is seen elsewhere and directly as well
SHRINK, BITS = 8, 16
# large pixels, each with the noise of the mean of the 64 that it stands for
CAMERA = CameraConfig(
    width_px=2448 // SHRINK,
    height_px=2048 // SHRINK,
    pixel_um=3.45 * SHRINK,
    bits=BITS,
    noise_adu=256 * math.hypot(0.4, math.sqrt(1 / 12)) / SHRINK,
)
BETTER = {"a_sigma_mm": 0.3, "b_sigma_mm": 0.3}
RADIUS_SIGMA_MM = 0.2
KINDS = (
    "rulers and data sheets",
    "a, b to 0.3 mm, pitch to 1e-4, radius to 0.1 mm",
    "rulers, data sheets, a sphere",
    "rulers, data sheets, pitch to 1e-4, the screen elsewhere and directly",
)
RAIL = ScreenMovedTable(shift_mm=(0.0, 0.0, -300.0), shift_sigma_mm=0.05, turn_sigma_deg=0.5)
DIRECT_MM, TILT_DEG = 900.0, 25.0
SPHERE = Artefact(1 / 3400.0, 1e-4 / 3400.0, 5e-5, 0.0, 0.05, 250.0)


def _stated(kind: int) -> tuple[OpticsConfig, float]:
    """The bench that the sets state, and the ring's sigma."""
    stated = stated_bench(calibrated=False).model_copy(update={"camera": CAMERA})
    if kind in (0, 2):
        return stated, RADIUS_SIGMA_MM
    better = {"sigmas": stated_sigmas(stated).model_copy(update={"pitch_relative": 1e-4})}
    if kind == 1:
        better |= BETTER
    geometry = stated.geometry.model_copy(update=better)
    return stated.model_copy(update={"geometry": geometry}), RADIUS_SIGMA_MM / (
        2 if kind == 1 else 1
    )


@dataclass(frozen=True)
class DrawnBench:
    """One bench: what its sets state, and what it is."""

    stated: OpticsConfig
    radius_sigma_mm: float
    there: OpticsConfig
    off: dict[str, float]  # by which each input was stated wrong
    film: FilmShape
    room: Room
    bends: dict[str, float]  # air and glass

    @classmethod
    def drawn(cls, seed: int) -> DrawnBench:
        """The bench of a seed."""
        rng = np.random.default_rng((2028, seed))
        stated, radius_sigma_mm = _stated(seed % len(KINDS))
        there, off = true_bench(stated, rng)
        sigmas = stated_sigmas(stated)
        off["laser_relative"] = sigmas.laser_relative * rng.standard_normal()
        slack, poisson = 10 ** rng.uniform(-5, -3) * rng.integers(2), rng.uniform(0.25, 0.45)
        radius_mm = 500.0 + radius_sigma_mm * rng.standard_normal()
        film = typical_film(37.1, radius_mm, seed, slack, poisson)
        mirror = there.mirror.model_copy(update={"radius_mm": radius_mm})
        room = replace(Room.drawn(rng), laser=True, held=seed % len(KINDS) == 3)
        air, glass = rng.standard_normal(2) * (sigmas.air_k_per_m, sigmas.glass_mm)
        bends = {"air_k_per_m": air, "glass_mm": abs(glass)}
        return cls(
            stated,
            radius_sigma_mm,
            there.model_copy(update={"mirror": mirror}),
            off,
            film,
            room,
            bends,
        )

    def render(
        self, renderer: BentRays, moved_um: float, pattern: Any, more_um: float, gain: float
    ) -> FloatArray:
        """A picture of the set at a displacement, as `Room.stack` asks for it."""
        return renderer.render_picture(pattern, moved_um + more_um, gain=gain).astype(float)

    def set_at(
        self, moved_um: float, seed: int, there: OpticsConfig | None = None
    ) -> tuple[FrameStack, float]:
        """The frames of a film set, and the film's true mean displacement; `there` is the bench if
        not its own.
        """
        light = Light(gamma=self.room.gamma)
        renderer = BentRays(there or self.there, self.film, light, seed=seed, **self.bends)
        stack = self.room.stack(
            partial(self.render, renderer, moved_um), np.random.default_rng(seed), CAMERA
        )
        readings_um = (moved_um + stack.displacement_um) / (1 + self.off["laser_relative"])
        return FrameStack(
            stack.frames, stack.patterns, readings_um, {}
        ), moved_um + self.room.mean_um

    def sphere_set(self, seed: int) -> SetPhases:
        """What the camera sees in the sphere, which leans and is not quite as stated."""
        rng, radius_mm = np.random.default_rng(seed), SPHERE.radius_mm
        curvature_mm = 1 / (
            SPHERE.curvature_per_mm + SPHERE.curvature_sigma_per_mm * rng.standard_normal()
        )
        form_um = 1e3 * SPHERE.form_sigma_mm * rng.standard_normal(ZERNIKE_TERMS)
        shape = make_artefact_shape(curvature_mm, radius_mm, *rng.uniform(-2e-3, 2e-3, 2), form_um)
        mirror = self.stated.mirror.model_copy(
            update={"radius_mm": radius_mm, "analysis_radius_mm": 0.95 * radius_mm}
        )
        vertex_mm = SPHERE.vertex_sigma_mm * rng.standard_normal()
        renderer = BentRays(
            self.there.model_copy(update={"mirror": mirror}),
            shape,
            Light(gamma=self.room.gamma),
            1e3 * vertex_mm,
            seed=seed,
            **self.bends,
        )
        room = replace(self.room, moves_um=0.0, laser=False)
        stack = room.stack(partial(self.render, renderer, 0.0), rng, CAMERA)
        stated = self.stated.model_copy(update={"mirror": mirror})
        return replace(phases_of("sphere", check_set(stack, stated), stated), artefact=SPHERE)

    def on_rail(self, seed: int) -> OpticsConfig:
        """The bench with its screen at the rail's other end, about as stated."""
        rng, shift_mm = np.random.default_rng(seed), np.array(RAIL.shift_mm)
        rail, turn = (
            _turn(np.radians(RAIL.turn_sigma_deg) * rng.standard_normal(3)) for _ in range(2)
        )
        x, y, z = (rail @ shift_mm + RAIL.shift_sigma_mm * rng.standard_normal(3)).tolist()
        return self.there.model_copy(
            update={"geometry": move_screen(self.there.geometry, (x, y, z), turn)}
        )

    def screen_set(self, name: str, side_rad: float, seed: int) -> SetPhases:
        """What the camera sees of the screen itself, tilted to a side."""
        rng = np.random.default_rng(seed)
        pose = camera_pose(self.there.geometry)
        pinhole, (right, down, forward) = pose.position_mm, pose.rotation
        turn = _turn(
            np.radians(TILT_DEG) * (math.cos(side_rad) * right + math.sin(side_rad) * down)
        )
        turn = turn @ _turn(rng.uniform(0, 2 * math.pi) * forward)
        place = {
            "origin_mm": pinhole + DIRECT_MM * forward,
            "s_x": turn @ right,
            "s_y": -turn @ down,
        }
        screen = (self.there.geometry.screen or ScreenPoseConfig()).model_copy(
            update={key: tuple(value.tolist()) for key, value in place.items()}
        )
        geometry = self.there.geometry.model_copy(update={"screen": screen})
        there = self.there.model_copy(update={"geometry": geometry})
        renderer = DirectRays(
            there, self.film, Light(gamma=self.room.gamma), seed=seed, **self.bends
        )
        room = replace(self.room, moves_um=0.0, laser=False)
        stack = room.stack(partial(self.render, renderer, 0.0), rng, CAMERA)
        none = np.full(len(stack.patterns), np.nan)
        head = CaptureHead(
            Path(name),
            "full",
            None,
            self.stated,
            True,
            (),
            stack.patterns,
            none,
            none,
            math.nan,
            (),
            stated_origin(self.stated),
        )
        return phases_of_screen(CaptureSet(head, stack.frames, {}))


def _turn(vector: FloatArray) -> FloatArray:
    """Matrix (3, 3) of a turn about a vector by its length."""
    return np.asarray(cv2.Rodrigues(vector)[0], np.float64)


def _edges(checked: Checked, surface: Surface) -> FloatArray | None:
    """As the command finds them."""
    names = [pattern.name for pattern in checked.stack.patterns]
    white, black = (
        checked.stack.frames[names.index(name)].astype(float) for name in ("white", "black")
    )
    return find_edges(
        white - black, checked.tracer.geometry, 500.0, checked.tracer.vertex_z_mm + surface.sag_mm
    )


def _with_more_screens(drawn: DrawnBench, sets: list[SetPhases], seed: int) -> None:
    """Add the films seen with the screen on its rail, and two sets of the screen itself."""
    there = drawn.on_rail(seed)
    geometry = move_screen(drawn.stated.geometry, RAIL.shift_mm)
    stated = drawn.stated.model_copy(update={"geometry": geometry})
    for k, moved_um in enumerate(TWO_UM):
        stack, _ = drawn.set_at(moved_um, seed + k, there)
        join_moved_screen(
            sets, Path(f"far{k}"), phases_of(f"far{k}", check_set(stack, stated), stated), RAIL
        )
    sets += [drawn.screen_set(f"screen{k}", k * math.pi / 2, seed + 5 + k) for k in range(2)]


def calibrated(drawn: DrawnBench, seed: int) -> tuple[Solution, list[float]]:
    """The solution, and the true displacement of each set.
    Raises ValueError or RejectedSetError.
    """
    kind, sets, edges, true_um = seed % len(KINDS), [], [], []
    for k, moved_um in enumerate(TWO_UM if kind == 3 else MOVED_UM):
        stack, mean_um = drawn.set_at(moved_um, 100 * seed + k)
        found = check_set(stack, drawn.stated)
        sets.append(phases_of(f"set{k}", found, drawn.stated))
        if (seen := _edges(found, found.state.surface)) is not None:
            edges.append(seen)
        true_um.append(mean_um)
    if kind == 2:
        sets.append(drawn.sphere_set(100 * seed + len(sets)))
    if kind == 3:
        _with_more_screens(drawn, sets, 100 * seed + 10)
    bundle = Bundle(tuple(sets), drawn.stated, 0.0, edges_px=tuple(edges))
    options = CalibrateOptions(
        (), None, Path(), (), 1.0, False, radius_sigma_mm=drawn.radius_sigma_mm
    )
    return solve_calibration(problem_of(bundle, {}, options)), true_um


def bench(seed: int) -> dict[str, Any]:
    """Errors and claims of one bench."""
    drawn = DrawnBench.drawn(seed)
    answer: dict[str, Any] = {
        "seed": seed,
        "kind": seed % len(KINDS),
        "causes": drawn.room.causes(),
    }
    try:
        solution, true_um = calibrated(drawn, seed)
        findings = verdict.check_solution(solution)
    except (ValueError, RejectedSetError) as error:
        return answer | {"refused": str(error)}
    if fatal := [finding.description for finding in findings if finding.fatal]:
        return answer | {"refused": fatal[0]}
    middle = solution.problem.middle_film_set
    phases = _still(solution, middle)
    surface = fit_on(solution.bench, phases, 500.0, -1e-3 * phases.displacement_um).surface
    claim = figure_uncertainty.propagate_to_figure(solution, middle, 475.0)
    sag_um, figure_um = errors_um(surface, drawn.film, true_um[middle])
    z = [(solution.values[k] - drawn.off.get(name, 0.0)) / s for k, (name, s) in _free(solution)]
    return answer | {
        "sag_um": [sag_um, claim.sag_um],
        "figure_um": [figure_um, claim.figure_rms_um],
        "z": z,
        "notes": [finding.description for finding in findings],
    }


def _still(solution: Solution, index: int) -> SetPhases:
    """A set without what its film moved from x to y, as `measure` corrects it with the new
    geometry.
    """
    phases, state = solution.problem.sets[index], solution.states[index]
    phases, turns = (
        phases.subset(phases.select_screen(0)),
        pose_derivatives(solution.problem.stated, solution.values),
    )
    parts = linearise_points(solution.bench, turns, phases, state.surface, state.vertex_z_mm)
    by_motion = np.concatenate([part.derivatives[:, MOTION] for part in parts], axis=1)
    return replace(phases, screen_mm=phases.screen_mm - state.motion_mm * by_motion)


def _free(solution: Solution) -> list[tuple[int, tuple[str, float]]]:
    named = enumerate(zip(NAMES, solution.sigmas, strict=True))
    return [(k, (name, float(sigma))) for k, (name, sigma) in named if sigma > 0]


def run(count: int = BENCHES) -> list[Figure]:
    """Error over claim, by what is known of the bench."""
    given, figures = answers(ANSWERS, count, bench), []
    for kind, name in enumerate(KINDS):
        some = [one for one in given if one["kind"] == kind]
        good = [one for one in some if "sag_um" in one]
        for what in ("sag_um", "figure_um"):
            error, claim = np.abs([one[what] for one in good]).T
            label = f"{name}: {what[:-3]} error, RMS of {len(good)}"
            figures.append(
                Figure(
                    label, float(np.sqrt(np.mean(error**2))), "um", "claim", float(np.mean(claim))
                )
            )
            worst = f"... over the claim, worst {float(np.max(error / claim)):.1f}"
            figures.append(at_most(worst, float(np.sqrt(np.mean((error / claim) ** 2))), "", 1.3))
        z = np.concatenate([one["z"] for one in good])
        figures.append(
            at_most(
                f"{name}: parameters' errors over sigma, worst", float(np.abs(z).max()), "", 4.0
            )
        )
        figures.append(Figure("... RMS", float(np.sqrt(np.mean(z**2))), ""))
        figures.append(Figure("... refused", 100 * (1 - len(good) / len(some)), "%"))
    return figures


if __name__ == "__main__":
    for figure in run(int(sys.argv[1]) if len(sys.argv) > 1 else BENCHES):
        print(f"{figure.name}: {figure.value:.2f} {figure.unit} {figure.reference_value or ''}")
