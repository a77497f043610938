"""Do the error bars hold the truth? Random benches, wrong in every input of the budget at once.

A bench is drawn from the sigmas that `measure` states; the ray tracer of the twin, which shares no
code with the metrology, renders two sets minutes apart, and `measure`'s own steps measure them with
the stated bench. Every second bench has sigmas of a hundredth, so that light, blur and motion
count. The film has any Poisson ratio, and half of the films are stretched. The answers go to a
file, line by line: a run that is stopped goes on where it was. `python -m
benchmarks.metrology.coverage 60` measures up to 60 benches.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.config.optics import (
    CameraConfig,
    CameraPoseConfig,
    GeometryConfig,
    OpticsConfig,
    ScreenPoseConfig,
    SigmasConfig,
)
from membrane_ctrl.geometry.spread_file import spread_of
from membrane_ctrl.metrology.calibrate.parameters import NAMES, bench_at
from membrane_ctrl.metrology.checked import RejectedSetError, check
from membrane_ctrl.metrology.consistency import Examined, examine
from membrane_ctrl.metrology.frames.frame_stack import FrameStack
from membrane_ctrl.metrology.full import (
    LASER_NOISE_UM,
    FullResult,
    measure_pixels,
    reconstruct_full,
)
from membrane_ctrl.metrology.live import LiveReconstructor
from membrane_ctrl.metrology.optics.geometry import Geometry, find_outline
from membrane_ctrl.metrology.optics.surface import parameter_to_coeffs, sag_gradient
from membrane_ctrl.metrology.uncertainty.monte_carlo import height_matrix
from membrane_ctrl.model.shape_estimate import judge
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import FilmShape, typical_film
from membrane_ctrl.sim.optics.shade import Light, pattern_sequence
from membrane_ctrl.sim.optics.trace import Trace
from tests.support.figures import Figure, at_most

FloatArray = NDArray[np.float64]

# bend of a ray per mm and K/m: the air's refractive index falls with temperature
AIR_PER_MM = 0.93e-9
GLASS_INDEX = 1.52
STEEL_PER_K = 12e-6
BENCHES = 100
ANSWERS = Path("logs/coverage.jsonl")
SHRINK = 8  # 64 pixels in one: the noise of the pixels counts eight times
POINTS = 10  # of the map, at random
TERMS = range(3, 11)  # Noll 4..11
LIVE_BIN_PX = 2
CALIBRATED = 0.01  # of the default sigmas
CAMERA = CameraConfig(width_px=2448 // SHRINK, height_px=2048 // SHRINK, pixel_um=3.45 * SHRINK)


@dataclass
class BentRays(OpticsRenderer):
    """The twin's film and screen, seen by rays that the air bends and that end on pixels behind
    glass.

    Temperature that grows upward bends a ray down: it is a parabola. The screen's plane is the
    front of the glass.
    """

    air_k_per_m: float = 0.0
    glass_mm: float = 0.0

    def _trace(self, directions: FloatArray, displacement_um: float) -> Trace:
        found = super()._trace(directions, displacement_um)
        start, bend = (
            self._camera_pose.position_mm,
            np.array([0.0, -AIR_PER_MM * self.air_k_per_m, 0.0]),
        )
        vertex_z_mm = -(displacement_um - self.reference_um) / 1000.0

        def height_mm(x: FloatArray, y: FloatArray) -> FloatArray:
            return self.film.height_mm(x, y, displacement_um)

        seen = np.isfinite(found.s_x_mm) & (
            found.x_mm**2 + found.y_mm**2 < (1.05 * self.film.radius_mm) ** 2
        )
        ray = directions[seen]
        t = ((found.x_mm[seen] - start[0]) / ray[:, 0])[:, None]
        for _ in range(6):  # fixed point: the film is flat beside the rays
            p = start + t * ray + t**2 / 2 * bend
            t = t + ((vertex_z_mm + height_mm(p[:, 0], p[:, 1]) - p[:, 2]) / ray[:, 2])[:, None]
        p = start + t * ray + t**2 / 2 * bend
        x, y, step = p[:, 0], p[:, 1], 0.05
        slopes = [
            height_mm(x + dx, y + dy) - height_mm(x - dx, y - dy)
            for dx, dy in ((step, 0), (0, step))
        ]
        normal = np.stack(
            [-slopes[0] / (2 * step), -slopes[1] / (2 * step), np.ones_like(x)], axis=1
        )
        arriving = ray + t * bend
        away = arriving - 2 * np.sum(arriving * normal, axis=1, keepdims=True) * normal / np.sum(
            normal**2, axis=1, keepdims=True
        )
        found.s_x_mm[seen], found.s_y_mm[seen] = self._behind_glass(p, away, bend).T
        found.x_mm[seen], found.y_mm[seen] = x, y
        return found

    def _behind_glass(self, start_mm: FloatArray, away: FloatArray, bend: FloatArray) -> FloatArray:
        """s_x and s_y (n, 2) of the pixels that rays from `start_mm` (n, 3) show."""
        screen = self._screen_pose
        face = np.stack([screen.s_x, screen.s_y, np.cross(screen.s_x, screen.s_y)])
        q, out, down = (start_mm - screen.origin_mm) @ face.T, away @ face.T, face @ bend
        path = -q[:, 2] / out[:, 2]
        for _ in range(6):
            on = q + path[:, None] * out + path[:, None] ** 2 / 2 * down
            off_mm = screen.bow_per_mm * np.sum(on[:, :2] ** 2, axis=1)
            path = path + (off_mm - on[:, 2]) / out[:, 2]
        on = q + path[:, None] * out + path[:, None] ** 2 / 2 * down
        across = out[:, :2] / np.linalg.norm(out, axis=1, keepdims=True) / GLASS_INDEX  # Snell
        return np.asarray(
            on[:, :2]
            + self.glass_mm * across / np.sqrt(1 - np.sum(across**2, axis=1, keepdims=True))
        )


class DirectRays(BentRays):
    """The screen itself before the camera, behind its glass."""

    def _trace(self, directions: FloatArray, displacement_um: float, film: Any = None) -> Trace:
        bend, none = np.array([0.0, -AIR_PER_MM * self.air_k_per_m, 0.0]), np.zeros(len(directions))
        start_mm = np.tile(self._camera_pose.position_mm, (len(directions), 1))
        return Trace(none, none, *self._behind_glass(start_mm, directions, bend).T)


def stated_bench(calibrated: bool) -> OpticsConfig:
    """The bench that the sets state."""
    share = CALIBRATED if calibrated else 1.0
    sigmas = {name: share * value for name, value in SigmasConfig().model_dump().items()}
    geometry = GeometryConfig(
        a_mm=2672.0,
        b_mm=2871.0,
        alpha_deg=80.9,
        a_sigma_mm=2.0 * share,
        b_sigma_mm=2.0 * share,
        alpha_sigma_deg=0.3 * share,
        sigmas=SigmasConfig(**sigmas),
        reference_displacement_um=0.0,
    )
    return OpticsConfig(geometry=geometry, camera=CAMERA)


def stated_sigmas(stated: OpticsConfig) -> SigmasConfig:
    """Of what is not calibrated."""
    return stated.geometry.sigmas or SigmasConfig()


def true_bench(
    stated: OpticsConfig, rng: np.random.Generator
) -> tuple[OpticsConfig, dict[str, float]]:
    """The bench as it really is, grown since it was measured; and by how much each input was stated
    wrong.
    """
    spread, _ = spread_of(stated, None)
    off = dict(zip(spread.names, spread.draw(rng), strict=True))
    grown = 1 + STEEL_PER_K * stated_sigmas(stated).temperature_k * rng.standard_normal()
    return bench_off_by(stated, off, grown), off


def bench_off_by(
    stated: OpticsConfig, off: Mapping[str, float], grown: float = 1.0
) -> OpticsConfig:
    """The bench that is stated wrong by these amounts, and has grown by this factor since."""
    there = bench_at(Geometry.from_config(stated), np.array([off.get(name, 0.0) for name in NAMES]))
    geometry = there.geometry
    rows = [tuple(row) for row in geometry.rotation]
    camera = CameraPoseConfig(
        position_mm=tuple(grown * geometry.pinhole_mm), rotation=(rows[0], rows[1], rows[2])
    )
    screen = ScreenPoseConfig(
        origin_mm=tuple(grown * geometry.screen_origin_mm),
        s_x=tuple(geometry.screen_s_x),
        s_y=tuple(geometry.screen_s_y),
        bow_mm=off.get("bow_mm", 0.0),
    )
    lens = {
        "focal_mm": geometry.focal_px * stated.camera.pixel_um * 1e-3,
        "principal_px": geometry.principal_px,
    }
    return OpticsConfig(
        geometry=GeometryConfig(camera=camera, screen=screen, reference_displacement_um=0.0),
        camera=stated.camera.model_copy(
            update={
                **lens,
                "distortion": geometry.distortion,
                "bits": 16,
                "noise_adu": 0.0,
            }  # see `Room.stack`
        ),
        pattern=stated.pattern.model_copy(
            update={"period_mm": stated.pattern.period_mm * there.pitch}
        ),
    )


@dataclass
class Room:
    """Light, blur, laser, dust and the film's motion of one bench, the same for all of its sets."""

    gamma: float
    flicker: float
    ambient: float
    blur_px: float
    laser: bool
    moves_um: float
    dust: bool
    stale: bool
    held: bool = False  # the film comes to the same place in each set
    mean_um: float = 0.0  # of the film in the last set

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Room:
        """At random."""
        return cls(
            gamma=float(rng.choice([1.0, rng.uniform(1.0, 2.2)])),
            flicker=float(rng.choice([0.0, rng.uniform(0.0, 0.015)])),
            ambient=float(rng.choice([0.0, rng.uniform(0.0, 0.05)])),
            blur_px=float(rng.choice([0.0, rng.uniform(0.0, 8.0)])),
            laser=bool(rng.random() < 0.6),
            moves_um=float(rng.choice([0.5, rng.uniform(1.0, 30.0)])),
            dust=bool(rng.random() < 0.3),
            stale=bool(rng.random() < 0.1),
        )

    def causes(self) -> list[str]:
        """What is wrong with the sets."""
        named = {
            "gamma": self.gamma > 1,
            "flicker": self.flicker > 0,
            "ambient light": self.ambient > 0,
        }
        named |= {
            "blur": self.blur_px > 0,
            "no laser": not self.laser,
            "film moves": self.moves_um > 0.5,
        }
        named |= {"dust": self.dust, "stale frame": self.stale}
        return [name for name, there in named.items() if there]

    def stack(
        self,
        render: Callable[[Any, float, float], FloatArray],
        rng: np.random.Generator,
        camera: CameraConfig,
    ) -> FrameStack:
        """A set whose film moves by a random walk about its mean. `render` gives 16 bits without
        noise.

        The camera's noise, and its one rounding, come after the blur.
        """
        shown = pattern_sequence("full", OpticsConfig().pattern)
        where_um = (
            self.moves_um * np.cumsum(rng.standard_normal(len(shown))) / math.sqrt(len(shown))
        )
        where_um += rng.uniform(-20.0, 20.0) * (self.moves_um > 0)
        if self.held:
            where_um -= where_um.mean()
        white = render(shown[-2], 0.0, 1.0)
        frames = []
        for k, (pattern, place_um) in enumerate(zip(shown, where_um, strict=True)):
            frame = render(pattern, float(place_um), 1 + self.flicker * rng.standard_normal())
            frame = frame + self.ambient * white / 2 * k / len(shown)
            if self.blur_px:
                frame = cv2.GaussianBlur(frame, (0, 0), self.blur_px / SHRINK)
            full = 2**camera.bits - 1
            frame = frame * (full / (2**16 - 1)) + camera.noise_adu * rng.standard_normal(
                frame.shape
            )
            frames.append(
                np.clip(np.rint(frame), 0, full).astype(np.uint8 if camera.bits == 8 else np.uint16)
            )
        if self.dust:
            for row, column in rng.integers(20, 230, (20, 2)):
                for frame in frames[:: rng.integers(1, 3)]:
                    frame[row : row + 2, column : column + 2] //= 2
        if self.stale:
            late = int(rng.integers(1, 8))
            frames[late] = frames[late - 1]
        readings = (
            where_um + LASER_NOISE_UM * rng.standard_normal(len(shown))
            if self.laser
            else np.full(len(shown), np.nan)
        )
        sinusoids = [k for k, pattern in enumerate(shown) if pattern.role == "sin"]
        self.mean_um = float(where_um[sinusoids].mean())
        return FrameStack(np.stack(frames), tuple(shown), readings, {})


def measured(stack: FrameStack, stated: OpticsConfig) -> tuple[FullResult, Examined, str]:
    """As `measure` does. Raises RejectedSetError."""
    checked = check(stack, stated)
    full = reconstruct_full(stated, checked, measure_pixels(stated, checked))
    used = [k for axis in checked.view.used for k in axis]
    light = checked.binned.means[used].mean(axis=0).astype(float)
    outline = find_outline(
        light, checked.tracer.geometry, 500.0, checked.tracer.vertex_z_mm + full.surface.sag_mm
    )
    examined = examine(stated, checked, full, spread_of(stated, None)[0], 0.5, outline)
    verdict = judge(full.quality)[0]
    if verdict == "ok" and (checked.flags or examined.doubts):
        verdict = "degraded"
    return full, examined, verdict


def live_answer(live: LiveReconstructor, stack: FrameStack, truth: FloatArray) -> FloatArray | None:
    """Error, own sigma and geometry's sigma (3, 9) of sag and terms in µm, as a running hold has
    them.
    """
    found = live.full(list(stack.frames), np.arange(18.0), stack.displacement_um)
    if found.verdict == "rejected":
        return None
    terms = list(TERMS)
    true_um = 1e3 * truth[: 1 + len(terms)]
    own = np.append(found.sag_sigma_um, np.sqrt(np.diag(found.covariance_um2)[terms]))
    common = np.append(
        found.geometry_sag_sigma_um, np.sqrt(np.diag(live.common_covariance_um2)[terms])
    )
    return np.stack([np.append(found.sag_um, found.coeffs_um[terms]) - true_um, own, common])


def quantities(points_mm: FloatArray) -> FloatArray:
    """Rows (n, 36): sag, Noll 4..11, height at points (2, n), of the surface's parameters."""
    return np.vstack(
        [sag_gradient(), parameter_to_coeffs()[list(TERMS)], height_matrix(*points_mm, 500.0)]
    )


def truth_of(film: FilmShape, displacement_um: float, points_mm: FloatArray) -> FloatArray:
    """The quantities (n,) in mm of the true film; its terms by least squares over the disc."""
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-500, 500, 61)] * 2))
    inside = np.hypot(x, y) <= 500
    x, y = x[inside], y[inside]
    rows, height = height_matrix(x, y, 500.0), film.height_mm(x, y, displacement_um)
    terms = (parameter_to_coeffs() @ np.linalg.lstsq(rows, height, rcond=None)[0])[list(TERMS)]
    angle = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    rim = film.height_mm(500 * np.cos(angle), 500 * np.sin(angle), displacement_um)
    vertex = film.height_mm(np.zeros(1), np.zeros(1), displacement_um)
    return np.concatenate(
        [[rim.mean() - vertex[0]], terms, film.height_mm(*points_mm, displacement_um) - vertex]
    )


def bench(seed: int) -> dict[str, Any]:
    """One bench: errors over sigmas of the first set and of the change to the second."""
    rng = np.random.default_rng((2026, seed))
    stated = stated_bench(calibrated=bool(seed % 2))
    law = np.random.default_rng((2027, seed))
    slack, poisson = 10 ** law.uniform(-5, -3) * law.integers(2), law.uniform(0.25, 0.45)
    film = typical_film(37.1, 500.0, seed, slack, poisson)
    (there, _), room, sigmas = true_bench(stated, rng), Room.drawn(rng), stated_sigmas(stated)
    air_k_per_m, glass_mm = rng.standard_normal(2) * (sigmas.air_k_per_m, sigmas.glass_mm)
    renderer = BentRays(
        there,
        film,
        Light(gamma=room.gamma),
        seed=seed,
        air_k_per_m=air_k_per_m,
        glass_mm=abs(glass_mm),
    )

    def render(pattern: Any, displacement_um: float, gain: float) -> FloatArray:
        return renderer.render(pattern, displacement_um, gain=gain).astype(float)

    radius, angle = 475 * np.sqrt(rng.random(POINTS)), 2 * np.pi * rng.random(POINTS)
    points_mm = np.stack([radius * np.cos(angle), radius * np.sin(angle)])
    rows = quantities(points_mm)
    found, answer = [], {"seed": seed, "calibrated": bool(seed % 2), "causes": room.causes()}
    spread, _ = spread_of(stated, None)
    live, seen_live = (
        LiveReconstructor(stated, LIVE_BIN_PX, laser_noise_um=LASER_NOISE_UM, spread=spread),
        [],
    )
    for _ in range(2):
        stack = room.stack(render, rng, stated.camera)
        truth = truth_of(film, room.mean_um, points_mm)
        seen_live.append(live_answer(live, stack, truth) if room.laser else None)  # a hold has one
        try:
            full, examined, verdict = measured(stack, stated)
        except RejectedSetError as error:
            return answer | {"verdict": "rejected", "reason": str(error)}
        if verdict == "rejected":
            return answer | {"verdict": "rejected", "reason": "quality"}
        # without a laser, which pressure the figure belongs to is unknown: the truth is at the mean
        found.append(
            (rows @ full.surface.parameters - truth, examined.budget, verdict, examined.doubts)
        )
    (first, budget, verdict, doubts), (second, later, _, _) = found
    covariances = (
        budget.covariance(True) + budget.covariance(False),
        later.change_covariance(budget),
    )
    sigma, change = (np.sqrt(np.einsum("ij,jk,ik->i", rows, c, rows)) for c in covariances)
    first_live, second_live = seen_live
    if first_live is not None and second_live is not None:
        answer |= {
            "live_error_um": first_live[0].tolist(),
            "live_sigma_um": np.hypot(first_live[1], first_live[2]).tolist(),
            "live_change_error_um": (second_live[0] - first_live[0]).tolist(),
            "live_change_sigma_um": np.hypot(first_live[1], second_live[1]).tolist(),
        }
    return answer | {
        "verdict": verdict,
        "doubts": list(doubts),
        "error_um": (1e3 * first).tolist(),
        "sigma_um": (1e3 * sigma).tolist(),
        "change_error_um": (1e3 * (second - first)).tolist(),
        "change_sigma_um": (1e3 * change).tolist(),
    }


def answers(path: Path, count: int, bench: Callable[[int], dict[str, Any]]) -> list[dict[str, Any]]:
    """Those already in the file, and the missing ones, which are added to it."""
    path.parent.mkdir(exist_ok=True)
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True) if path.exists() else []
    whole = [line for line in lines if line.endswith("\n")]
    if len(whole) < len(lines):  # a run that was killed may leave half a line
        path.write_text("".join(whole), encoding="utf-8")
    known = {one["seed"]: one for one in map(json.loads, whole)}
    for seed in range(count):
        if seed not in known:
            known[seed] = bench(seed)
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(known[seed]) + "\n")
    return [known[seed] for seed in range(count)]


def held(
    given: list[dict[str, Any]], of: str, part: slice = slice(None)
) -> tuple[float, float, int]:
    """Share of 95 % intervals that hold the truth, bar over scatter (1 is sharp), and intervals."""
    pairs = [
        (one[f"{of}error_um"][part], one[f"{of}sigma_um"][part])
        for one in given
        if f"{of}error_um" in one
    ]
    if not pairs:
        return math.nan, math.nan, 0
    error, sigma = np.array(pairs).transpose(1, 0, 2)
    ratio = np.abs(error) / sigma
    return float(np.mean(ratio < 1.96)), 0.6745 / float(np.median(ratio)), error.size


_ANSWERED = {
    "": "height",
    "change_": "change",
    "live_": "live cycle",
    "live_change_": "live change",
}
_PARTS = {"sag": slice(0, 1), "Z4..Z11": slice(1, 9), "map": slice(9, None)}


def run(count: int = BENCHES) -> list[Figure]:
    """Coverage by quantity, for heights and for changes."""
    given = answers(ANSWERS, count, bench)
    figures = []
    for state in (False, True):
        some = [one for one in given if one["calibrated"] == state]
        name = "sigmas / 100" if state else "sigmas by hand"
        for of, what in _ANSWERED.items():
            for quantity, part in _PARTS.items():
                share, width, size = held(some, of, part)
                if not size:
                    continue
                label = f"{name}, {what}: {quantity} in its 95 % interval ({size})"
                figures.append(
                    Figure(label, 100 * share, "%", "width over scatter", width, "93 .. 97")
                )
    sure = [one for one in given if one["verdict"] == "ok"]
    far = sum(max(np.abs(one["error_um"]) / np.array(one["sigma_um"])) > 3 for one in sure)
    label = f"'ok' with an error above 3 sigma, of {len(given)}"
    figures.append(at_most(label, 100 * far / len(given), "%", 0.5))
    figures.append(
        Figure(
            "rejected", 100 * sum(one["verdict"] == "rejected" for one in given) / len(given), "%"
        )
    )
    return figures


def table(given: list[dict[str, Any]]) -> list[str]:
    """Coverage for the sets with each cause, as lines of a page."""
    head = (
        "| cause | benches | height % | change % | live cycle % | live change % | width of "
        "change over scatter |"
    )
    lines = [head, "|" + 7 * "---|"]
    every = sorted({cause for one in given for cause in one["causes"]})
    for cause in ["(all)", *every]:
        some = [one for one in given if cause == "(all)" or cause in one["causes"]]
        shares = " | ".join(
            f"{100 * held(some, of)[0]:.0f}" for of in ("", "change_", "live_", "live_change_")
        )
        lines.append(f"| {cause} | {len(some)} | {shares} | {held(some, 'change_')[1]:.1f} |")
    return lines


if __name__ == "__main__":
    wanted = int(sys.argv[1]) if len(sys.argv) > 1 else BENCHES
    for figure in run(wanted):
        print(f"{figure.name}: {figure.value:.1f} {figure.unit} {figure.reference_value or ''}")
    print("\n".join(table(answers(ANSWERS, wanted, bench))))
