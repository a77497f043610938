"""The budget of a figure's uncertainty: what each input contributes (JCGM 100, clause 5).

An input with the standard uncertainty u changes the figure's parameters by c u, with c its
sensitivity: one solution of the thinned points with the input off by u. Inputs of type B (data
sheets, rulers) are known before the measurement; those of type A are seen in the set itself. Inputs
that all sets of a bench share cancel in a change between two sets.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from membrane_ctrl.config.optics import OpticsConfig, SigmasConfig
from membrane_ctrl.metrology.figure.pixel_figure import FullResult
from membrane_ctrl.metrology.phase import phase_steps, screen_scale
from membrane_ctrl.metrology.rays import bench_parameters, bench_poses, disc_heights, surface_basis
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.ray_tracing import Points, Tracer
from membrane_ctrl.metrology.rays.surface import (
    PARAMETERS,
    Surface,
    parameter_to_coeffs,
    sag_gradient,
)
from membrane_ctrl.metrology.reconstruction import film_motion
from membrane_ctrl.metrology.reconstruction.zonal_map import ResidualGrid
from membrane_ctrl.metrology.uncertainty import monte_carlo
from membrane_ctrl.metrology.uncertainty.geometry_spread import GENERAL_NAMES, GeometrySpread
from membrane_ctrl.metrology.uncertainty.monte_carlo import TrialBench
from membrane_ctrl.model.arrays import FloatArray

_GLASS_INDEX = 1.5
_STEEL_PER_K = 12e-6
_AIR_PER_MM = 0.92e-9  # curvature of a ray across a gradient of 1 K/m
_BEND = np.array(
    [[0.0], [-_AIR_PER_MM], [0.0]]
)  # per K/m: warm air is thin, and rays bend towards the cold
LIGHT = 5e-4  # of a frame's level or swing, after the correction or below what it can see
_PATCHES = 40  # across the mirror: slopes that the fit leaves are independent from one to the next


@dataclass(frozen=True)
class Source:
    """One input, or inputs that are correlated."""

    name: str  # ends in the unit of `sigma`
    says: str
    sigma: float  # standard uncertainty of the input; NaN for several at once
    # (parameters, k): independent changes of the parameters, of 1 sigma each, from this input
    effects_mm: FloatArray
    common: bool = True  # whether all sets of a bench share it
    # whether two sets have the same error in the same column: it cancels in a change
    paired: bool = True
    # sum of squares of noise in effects that the set shows: the noise has a row of its own
    noise_mm2: float = 0.0

    @property
    def known_mm(self) -> FloatArray:
        """The effects beyond that noise."""
        share = 1 - self.noise_mm2 / max(float(np.sum(self.effects_mm**2)), 1e-300)
        return np.asarray(math.sqrt(max(share, 0.0)) * self.effects_mm)

    @property
    def covariance_mm2(self) -> FloatArray:
        """Covariance (parameters, parameters)."""
        return np.asarray(self.known_mm @ self.known_mm.T)

    def change(self, earlier: "Source | None") -> list[FloatArray]:
        """Effects on the change since an earlier set."""
        if earlier is None:
            return [self.known_mm]
        if not (self.paired and earlier.paired):
            return [self.known_mm, earlier.known_mm]
        noise_mm2 = self.noise_mm2 + earlier.noise_mm2
        return [
            replace(
                self, effects_mm=self.effects_mm - earlier.effects_mm, noise_mm2=noise_mm2
            ).known_mm
        ]


@dataclass(frozen=True)
class Budget:
    """All inputs of one figure."""

    sources: tuple[Source, ...]
    disc: float  # analysis radius over the radius of the terms

    def covariance(self, common: bool) -> FloatArray:
        """(parameters, parameters) in mm^2 of the parameters, from what all sets of the bench share
        or from this set's own."""
        parts = [source.covariance_mm2 for source in self.sources if source.common == common]
        return np.asarray(np.sum([np.zeros((PARAMETERS, PARAMETERS)), *parts], axis=0))

    def change_covariance(self, earlier: "Budget") -> FloatArray:
        """(parameters, parameters) in mm^2 of the parameters' change since another set of the same
        bench.

        What both share cancels but for the difference of its effects on the two.
        """
        before = {source.name: source for source in earlier.sources}
        parts = [np.zeros((PARAMETERS, 1))]
        for own in self.sources:
            parts += own.change(before.pop(own.name, None))
        effects = np.concatenate([*parts, *(left.known_mm for left in before.values())], axis=1)
        return np.asarray(effects @ effects.T)

    def rows(self) -> list[dict[str, Any]]:
        """Per input, the largest contribution first: its own uncertainty, 1 sigma of sag, height
        and figure.
        """
        rows: list[dict[str, Any]] = []
        for one in self.sources:
            sigma = one.sigma if math.isfinite(one.sigma) else None
            about = {"name": one.name, "says": one.says, "sigma": sigma, "common": one.common}
            rows.append(about | self.sizes(one.covariance_mm2))
        return sorted(rows, key=lambda row: -float(row["height_rms_um"]))

    def total(self) -> dict[str, Any]:
        """1 sigma of sag, height, figure and of the coefficients."""
        whole = self.covariance(True) + self.covariance(False)
        to_coeffs = parameter_to_coeffs()
        coeffs = 1e3 * np.sqrt(np.maximum(np.diag(to_coeffs @ whole @ to_coeffs.T), 0.0))
        return self.sizes(whole) | {"coeffs_um": coeffs.tolist()}

    def sizes(self, covariance_mm2: FloatArray) -> dict[str, float]:
        """1 sigma of the sag, and over the disc of the height and of the figure (the height without
        its plane).
        """
        squares = {
            name: np.sum(means * covariance_mm2) for name, means in _products(self.disc).items()
        }
        return {name: 1e3 * math.sqrt(max(float(square), 0.0)) for name, square in squares.items()}


@lru_cache
def _products(disc: float) -> dict[str, FloatArray]:
    """Means (parameters, parameters) over a disc of products of what two parameters do to sag,
    height and figure.
    """
    heights, plane = disc_heights.disc(disc)
    basis = {
        "height_rms_um": heights,
        "figure_rms_um": disc_heights.without_plane(heights, plane),
    }
    return {"sag_um": np.outer(sag_gradient(), sag_gradient())} | {
        n: b.T @ b / len(b) for n, b in basis.items()
    }


def geometry_sources(
    bench: TrialBench, spread: GeometrySpread, widened: float = 1.0
) -> Iterator[Source]:
    """Poses, lens and screen; those that are correlated are one source. `widened` multiplies every
    sigma.
    """
    jacobian = widened * monte_carlo.geometry_jacobian(bench, spread)
    linked = np.count_nonzero(spread.covariance, axis=1) > 1
    says = {parameter.name: parameter.says for parameter in bench_parameters.ALL}
    if linked.any():
        names = [name for name, is_linked in zip(spread.names, linked, strict=True) if is_linked]
        several = "calibrated" if set(names) & set(GENERAL_NAMES) else ", ".join(names)
        effects = jacobian[:, linked] @ spread.root()[np.ix_(linked, linked)]
        yield Source(
            "geometry", f"poses and optics, with their correlations: {several}", math.nan, effects
        )
    for k in np.flatnonzero(~linked):
        name, sigma = spread.names[k], float(spread.sigmas[k])
        yield Source(name, says.get(name, name), widened * sigma, jacobian[:, [k]] * sigma)


def bench_sources(bench: TrialBench, sigmas: SigmasConfig) -> Iterator[Source]:
    """What bends the rays or moves the bench beyond its poses."""
    nominal = bench.geometry()
    point = nominal.geometry.pinhole_mm[:, None] + bench.t_mm * nominal.geometry.rays(
        bench.column_px, bench.row_px
    )
    leaving = nominal.geometry.screen_points(bench.screen_mm) - point
    path_mm = np.linalg.norm(leaving, axis=0)
    leaving /= path_mm
    # tangents of the ray at the screen: in glass sin / n
    across = nominal.geometry.screen_axes @ leaving
    inside = across[:2] / np.sqrt(_GLASS_INDEX**2 - np.sum(across[:2] ** 2, axis=0))
    yield _disturbed(
        bench, "glass_mm", "glass in front of the screen's pixels", sigmas.glass_mm, inside
    )
    air_mm = _bent_to_film_mm(bench) + _onto_screen(
        nominal.geometry, leaving, _BEND * path_mm**2 / 2
    )
    yield _disturbed(
        bench, "air_k_per_m", "vertical temperature gradient of the air", sigmas.air_k_per_m, air_mm
    )
    grown, values = _STEEL_PER_K * sigmas.temperature_k, np.zeros(len(bench_parameters.NAMES))
    for name, length in (
        ("a_mm", nominal.geometry.pinhole_mm),
        ("b_mm", nominal.geometry.screen_origin_mm),
    ):
        values[bench_parameters.NAMES.index(name)] = grown * float(np.linalg.norm(length))
    effect = bench.solve(bench_poses.bench_at(nominal.geometry, values)) - bench.surface.parameters
    says = "growth of the frame since its distances were measured"
    yield Source("temperature_k", says, sigmas.temperature_k, effect[:, None])


def _bent_to_film_mm(bench: TrialBench) -> FloatArray:
    """Change (2, n) of the screen points per K/m when the air bends the rays from the camera to the
    film.

    They meet the film as straight rays do that come from beside the pinhole.
    """
    nominal = bench.geometry().geometry
    beside = replace(
        nominal, pinhole_mm=nominal.pinhole_mm - _BEND[:, 0] * float(np.mean(bench.t_mm**2)) / 2
    )
    tracer, points = _stand(bench, beside, _BEND * bench.t_mm)
    tracer.intersect(points, bench.surface, newton=3)
    return tracer.predict_screen(points, bench.surface) - bench.screen_mm


def _onto_screen(geometry: Geometry, leaving: FloatArray, shift_mm: FloatArray) -> FloatArray:
    """Change (2, n) of the screen points when the rays arrive shifted by (3, n)."""
    axes = geometry.screen_axes
    return np.asarray(axes[:2] @ (shift_mm - leaving * (axes[2] @ shift_mm) / (axes[2] @ leaving)))


def _disturbed(
    bench: TrialBench, name: str, says: str, sigma: float, per_unit_mm: FloatArray
) -> Source:
    """A source that moves the screen points by (2, n) mm per unit of the input."""
    effect = (
        bench.solve(bench.geometry(), sigma * per_unit_mm, linear=True) - bench.surface.parameters
    )
    return Source(name, says, sigma, effect[:, None])


def film_source(bench: TrialBench, sigmas_um: tuple[float, ...], says: str, paired: bool) -> Source:
    """The film moved by so much, in independent parts, from the x frames to the y frames, unknown
    to the phases.
    """
    half = moves_mm(bench) * np.array([[0.5], [-0.5]])
    per_um = bench.solve(bench.geometry(), half, linear=True) - bench.surface.parameters
    sigma_um = math.hypot(*sigmas_um)
    return Source(
        "film_x_to_y_um", says, sigma_um, np.outer(per_um, sigmas_um), common=False, paired=paired
    )


def vertex_source(bench: TrialBench, sigma_um: float, says: str) -> Source:
    """The vertex is not where the laser says: towards camera and screen, or away from them."""
    nominal = bench.geometry()
    away = np.array([0.0, 0.0, 1e-3 * sigma_um])
    geometry = nominal.geometry
    farther = replace(
        geometry,
        pinhole_mm=geometry.pinhole_mm + away,
        screen_origin_mm=geometry.screen_origin_mm + away,
    )
    effect = bench.solve(replace(nominal, geometry=farther), linear=True) - bench.surface.parameters
    return Source("vertex_um", says, sigma_um, effect[:, None], common=False, paired=False)


def moved_film(bench: TrialBench, displacement_um: float) -> TrialBench:
    """The bench with the film's bowl deeper by a displacement, and the ring in its place."""
    deeper_mm, surface = displacement_um * 1e-3, bench.surface
    bowl = Surface.hencky_bowl(deeper_mm, surface.radius_mm)
    surface = Surface.from_parameters(surface.parameters + bowl.parameters, surface.radius_mm)
    there = replace(bench, surface=surface, vertex_z_mm=bench.vertex_z_mm - deeper_mm)
    return replace(there, screen_mm=predicted_mm(there, bench.geometry(), surface))


def moves_mm(bench: TrialBench) -> FloatArray:
    """Change (2, n) of the screen points per µm of the film's displacement."""
    tracer, points = _stand(bench, bench.geometry().geometry)
    return film_motion.sensitivity_mm_per_um(tracer, points, bench.surface)


def predicted_mm(
    bench: TrialBench, there: bench_poses.BenchGeometry, surface: Surface
) -> FloatArray:
    """Where (2, n) a surface on another bench sends the rays of the points."""
    tracer, points = _stand(bench, there.geometry)
    tracer.intersect(points, surface, newton=3)
    return tracer.predict_screen(points, surface) / there.pitch


def _stand(
    bench: TrialBench, geometry: Geometry, bent: FloatArray | float = 0.0
) -> tuple[Tracer, Points]:
    points = Points.of(geometry.rays(bench.column_px, bench.row_px) + bent, bench.screen_mm)
    points.t_mm[:] = bench.t_mm
    return Tracer(geometry, bench.surface.radius_mm, bench.vertex_z_mm), points


def blur_source(bench: TrialBench, sigma_px: float) -> Source:
    """A picture blurred by a Gauss of this width: the phase is its mean over the blur.

    The mean of the four values at a distance of sqrt(2) sigma, less the value at the centre
    (`bins.BinGrid`).
    """
    nominal, far = bench.geometry(), math.sqrt(2) * sigma_px
    mean = np.zeros_like(bench.screen_mm)
    for right, down in ((far, 0.0), (-far, 0.0), (0.0, far), (0.0, -far)):
        beside = replace(bench, column_px=bench.column_px + right, row_px=bench.row_px + down)
        mean += predicted_mm(beside, nominal, bench.surface) / 4
    effect = (
        bench.solve(bench.geometry(), mean - bench.screen_mm, linear=True)
        - bench.surface.parameters
    )
    return Source("blur_px", "blur of the picture", sigma_px, effect[:, None])


@dataclass(frozen=True)
class FrameEffects:
    """Changes (parameters, frames) of the parameters in mm per unit of one frame's error, x frames
    first.
    """

    level: FloatArray  # its light, relative
    swing: FloatArray  # the amplitude of its fringes and of their harmonics, relative
    film: FloatArray  # the film's place, µm; the figure is that of the mean place
    display: FloatArray  # the same of the fringes' harmonics alone

    @property
    def x_to_y(self) -> FloatArray:
        """(parameters,) per µm of the film's motion from the x to the y frames."""
        x, y = np.split(self.film, 2, axis=1)
        return np.asarray((y.sum(axis=1) - x.sum(axis=1)) / 2)


def frame_effects(
    bench: TrialBench,
    optics: OpticsConfig,
    shifts_rad: Sequence[FloatArray] | FloatArray,
    light: FloatArray | float = 1.0,
    harmonics: FloatArray | None = None,
) -> FrameEffects:
    """Of single frames; `light` (2, n) and `harmonics` (2, 2), second and third of x and y, over
    the amplitude.
    """
    scale, moves = screen_scale.mm_per_rad(optics.pattern), moves_mm(bench)
    light, orders = np.broadcast_to(light, bench.screen_mm.shape), (2, 3)
    effects: tuple[list[FloatArray], ...] = ([], [], [], [])
    for axis, shifts in enumerate(shifts_rad):
        angle = bench.screen_mm[axis] / scale + screen_scale.centre_phase_rad(optics.pattern)
        _, cosine, sine = phase_steps.step_weights(shifts)
        for k, shift in enumerate(shifts):
            # the frame's error over the fringes' amplitude turns the phasor
            turned = -scale * (cosine[k] * np.sin(angle) - sine[k] * np.cos(angle))
            at = angle + shift
            wave, display = np.cos(at), np.zeros_like(at)
            for order, share in zip(
                orders, (0.0, 0.0) if harmonics is None else harmonics[axis], strict=True
            ):
                wave, display = (
                    wave + share * np.cos(order * at),
                    display - order * share * np.sin(order * at),
                )
            errors = (
                light[axis],
                wave,
                -np.sin(at) * moves[axis] / scale,
                display * moves[axis] / scale,
            )
            for effect, error in zip(effects, errors, strict=True):
                off = np.zeros_like(bench.screen_mm)
                off[axis] = turned * error
                effect.append(
                    bench.solve(bench.geometry(), off, linear=True) - bench.surface.parameters
                )
    level, swing, film, display = (np.stack(effect, axis=1) for effect in effects)
    return FrameEffects(level, swing, film - film.mean(axis=1, keepdims=True), display)


def frame_sources(
    bench: TrialBench,
    optics: OpticsConfig,
    shifts_rad: Sequence[FloatArray],
    film_um: float,
    light: float,
) -> Iterator[Source]:
    """What differs from frame to frame: the light, by `light`, and the film, by `film_um`."""
    effects = frame_effects(bench, optics, shifts_rad)
    yield Source(
        "light_relative",
        "light of each frame",
        light,
        light * (effects.level + effects.swing),
        False,
        False,
    )
    says = "motion of the film from frame to frame that no laser has told"
    yield Source("film_um", says, film_um, film_um * effects.film, False, False)


def pixel_sources(
    full: FullResult, slope_variance: FloatArray, noise_adu: float
) -> Iterator[Source]:
    """White noise of the pixels; and what the slopes show beyond it, taken as one error per patch
    of the mirror.
    """
    inverse = full.fit.normal.inverse
    middle = slope_variance[0] * full.fit.normal.x + slope_variance[1] * full.fit.normal.y
    noise = inverse @ np.linalg.cholesky(middle)
    yield Source("noise_adu", "noise of the pixels", noise_adu, noise, False, False)
    left = Patches.of_grid(full.grid).effects(full.surface.radius_mm, inverse)
    left_urad = 1e6 * math.hypot(full.fit.residual_x, full.fit.residual_y)
    says = "slopes that the fit leaves: gamma, light, dust, ripple"
    yield Source(
        "slope_urad", says, left_urad, left, common=False, noise_mm2=float(np.sum(noise**2))
    )


@dataclass(frozen=True)
class Patches:
    """Means of residual slopes over patches of the mirror."""

    places_mm: FloatArray  # (2, patches)
    count: FloatArray  # (patches,): points in each
    slopes: FloatArray  # (2, patches)

    @classmethod
    def of(
        cls, places_mm: FloatArray, count: FloatArray, slopes: FloatArray, reach_mm: float
    ) -> "Patches":
        """Of points that stand for `count` (n,) each, over a square of half the side `reach_mm`."""
        column, row = np.clip(
            ((places_mm / reach_mm + 1) / 2 * _PATCHES).astype(int), 0, _PATCHES - 1
        )
        patch = row * _PATCHES + column
        sums = [
            np.bincount(patch, count * part, _PATCHES**2)
            for part in (np.ones_like(count), *places_mm, *slopes)
        ]
        means = np.array(sums[1:]) / np.maximum(sums[0], 1.0)
        return cls(means[:2], np.asarray(sums[0], float), means[2:])

    @classmethod
    def of_grid(cls, grid: ResidualGrid) -> "Patches":
        """Of a measured set."""
        seen, (x, y) = grid.count > 0, np.meshgrid(grid.axis_mm, grid.axis_mm)
        slopes = np.stack([grid.slope_x[seen], grid.slope_y[seen]])
        return cls.of(
            np.stack([x[seen], y[seen]]), grid.count[seen], slopes, float(grid.axis_mm[-1])
        )

    def effects(self, radius_mm: float, inverse: FloatArray) -> FloatArray:
        """(parameters, patches) on the parameters if the residual slopes are independent from patch
        to patch only.

        The patches are those of the mirror, whatever was seen: two sets of a bench have the same
        ones. `inverse` is that of the fit's normal matrix.
        """
        _, of_x, of_y = surface_basis.basis(*self.places_mm / radius_mm)
        x, y = self.count * self.slopes
        return np.asarray(inverse @ ((of_x * x + of_y * y) / radius_mm))
