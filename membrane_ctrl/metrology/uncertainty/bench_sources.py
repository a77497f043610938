"""Sources of error that belong to the bench: its geometry, glass, air, temperature and vertex."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from membrane_ctrl.config.optics import SigmasConfig
from membrane_ctrl.metrology.rays import bench_parameters, bench_poses
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.uncertainty import linear_covariance
from membrane_ctrl.metrology.uncertainty.budget import Source
from membrane_ctrl.metrology.uncertainty.geometry_spread import GENERAL_NAMES, GeometrySpread
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench, moves_mm, traced_points
from membrane_ctrl.model.arrays import FloatArray

_GLASS_INDEX = 1.5
_STEEL_PER_K = 12e-6
_AIR_PER_MM = 0.92e-9  # curvature of a ray across a gradient of 1 K/m
_BEND = np.array(
    [[0.0], [-_AIR_PER_MM], [0.0]]
)  # per K/m: warm air is thin, and rays bend towards the cold


def geometry_sources(
    bench: TrialBench, spread: GeometrySpread, widened: float = 1.0
) -> Iterator[Source]:
    """Poses, lens and screen; those that are correlated are one source. `widened` multiplies every
    sigma.
    """
    jacobian = widened * linear_covariance.geometry_jacobian(bench, spread)
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
    yield disturbed_source(
        bench, "glass_mm", "glass in front of the screen's pixels", sigmas.glass_mm, inside
    )
    air_mm = _bent_to_film_mm(bench) + _onto_screen(
        nominal.geometry, leaving, _BEND * path_mm**2 / 2
    )
    yield disturbed_source(
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
    tracer, points = traced_points(bench, beside, _BEND * bench.t_mm)
    tracer.intersect(points, bench.surface, newton=3)
    return tracer.predict_screen(points, bench.surface) - bench.screen_mm


def _onto_screen(geometry: Geometry, leaving: FloatArray, shift_mm: FloatArray) -> FloatArray:
    """Change (2, n) of the screen points when the rays arrive shifted by (3, n)."""
    axes = geometry.screen_axes
    return np.asarray(axes[:2] @ (shift_mm - leaving * (axes[2] @ shift_mm) / (axes[2] @ leaving)))


def disturbed_source(
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
