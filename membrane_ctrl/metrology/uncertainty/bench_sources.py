"""Sources of error that belong to the bench: its geometry, glass, air, temperature and vertex."""

import math
from collections.abc import Iterator, Sequence
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

_GLASS_INDEX = 1.5  # refractive index
_STEEL_PER_K = 12e-6  # thermal expansion
_AIR_PER_MM = 0.92e-9  # curvature of a ray across a gradient of 1 K/m
# The same as a vector: warm air has a lower index, and rays bend towards the cold.
_BEND = np.array([[0.0], [-_AIR_PER_MM], [0.0]])


def geometry_sources(
    bench: TrialBench, spread: GeometrySpread, widened: float = 1.0
) -> Iterator[Source]:
    """Rows of the budget for poses, lens and screen; correlated ones share a row.

    Parameters
    ----------
    bench : TrialBench
        Some points of the set.
    spread : GeometrySpread
        Covariance of the geometry.
    widened : float
        Factor of every sigma.
    """
    jacobian = widened * linear_covariance.geometry_jacobian(bench, spread)
    # Correlated numbers share a row: their effects are those of the root of their covariance.
    is_linked = np.count_nonzero(spread.covariance, axis=1) > 1
    if is_linked.any():
        names = [spread.names[k] for k in np.flatnonzero(is_linked)]
        several = ", ".join(names)
        if set(names) & set(GENERAL_NAMES):
            several = "calibrated"
        root = spread.covariance_root()[np.ix_(is_linked, is_linked)]
        effects = jacobian[:, is_linked] @ root
        description = f"poses and optics, with their correlations: {several}"
        yield Source("geometry", description, math.nan, effects)
    # Each other one has a row of its own.
    descriptions = {parameter.name: parameter.description for parameter in bench_parameters.ALL}
    for k in np.flatnonzero(~is_linked):
        name = spread.names[k]
        sigma = float(spread.sigmas[k])
        description = descriptions.get(name, name)
        yield Source(name, description, widened * sigma, jacobian[:, [k]] * sigma)


def bench_sources(bench: TrialBench, sigmas: SigmasConfig) -> Iterator[Source]:
    """Rows of the budget for what bends the rays, or moves the bench beyond its poses: glass, air
    and temperature.

    Section 4 of docs/explanation/uncertainty.md.

    Parameters
    ----------
    bench : TrialBench
        Some points of the set.
    sigmas : SigmasConfig
        Standard uncertainties of glass, air gradient and temperature.

    Yields
    ------
    Source
    """
    geometry = bench.geometry().geometry

    # Rays from the film to the screen, (3, n) unit vectors.
    rays = geometry.rays(bench.column_px, bench.row_px)
    on_film_mm = geometry.pinhole_mm[:, None] + bench.t_mm * rays
    leaving = geometry.screen_points(bench.screen_mm) - on_film_mm
    path_mm = np.linalg.norm(leaving, axis=0)
    leaving /= path_mm

    # Glass, by Snell's law: the components of the direction along the screen shrink by 1 / n. The
    # tangents of the ray in the glass shift the point that is seen, per mm of its thickness.
    sines = (geometry.screen_axes @ leaving)[:2]
    tangents = sines / np.sqrt(_GLASS_INDEX**2 - np.sum(sines**2, axis=0))
    description = "glass in front of the screen's pixels"
    yield disturbed_source(bench, "glass_mm", description, sigmas.glass_mm, tangents)

    # Air: rays bent on both ways.
    to_screen_mm = _shift_on_screen(geometry, leaving, _BEND * path_mm**2 / 2)
    air_mm = _bent_to_film_mm(bench) + to_screen_mm
    description = "vertical temperature gradient of the air"
    yield disturbed_source(bench, "air_k_per_m", description, sigmas.air_k_per_m, air_mm)

    # Temperature: a steel frame grows, with both distances.
    growth = _STEEL_PER_K * sigmas.temperature_k
    values = np.zeros(len(bench_parameters.NAMES))
    lengths_mm = {"a_mm": geometry.pinhole_mm, "b_mm": geometry.screen_origin_mm}
    for name, length_mm in lengths_mm.items():
        values[bench_parameters.NAMES.index(name)] = growth * float(np.linalg.norm(length_mm))
    effect = bench.solve(bench_poses.bench_at(geometry, values)) - bench.surface.parameters
    description = "growth of the frame since its distances were measured"
    yield Source("temperature_k", description, sigmas.temperature_k, effect[:, None])


def _bent_to_film_mm(bench: TrialBench) -> FloatArray:
    """Change (2, n) of the screen points per K/m when the air bends the rays from the camera to the
    film.

    They meet the film as straight rays do that come from a point near the pinhole.
    """
    nominal = bench.geometry().geometry
    mean_square_mm2 = float(np.mean(bench.t_mm**2))
    shifted_mm = nominal.pinhole_mm - _BEND[:, 0] * mean_square_mm2 / 2
    shifted = replace(nominal, pinhole_mm=shifted_mm)
    tracer, points = traced_points(bench, shifted, _BEND * bench.t_mm)
    tracer.intersect(points, bench.surface, newton=3)
    return tracer.predict_screen(points, bench.surface) - bench.screen_mm


def _shift_on_screen(geometry: Geometry, leaving: FloatArray, shift_mm: FloatArray) -> FloatArray:
    """Change (2, n) of the screen points when the rays arrive shifted.

    `leaving` (3, n) are their directions, `shift_mm` (3, n) the shifts, in world.
    """
    axes = geometry.screen_axes
    normal = axes[2]
    to_plane_mm = leaving * (normal @ shift_mm) / (normal @ leaving)
    return np.asarray(axes[:2] @ (shift_mm - to_plane_mm))


def disturbed_source(
    bench: TrialBench, name: str, description: str, sigma: float, per_unit_mm: FloatArray
) -> Source:
    """Return the row for an input that moves the screen points.

    Parameters
    ----------
    bench : TrialBench
        Some points of the set.
    name, description : str
        Of the row.
    sigma : float
        Standard uncertainty of the input, in its unit.
    per_unit_mm : (2, n) array
        Motion of the screen points per unit of the input.

    Returns
    -------
    Source
    """
    solved = bench.solve(bench.geometry(), sigma * per_unit_mm, linear=True)
    effect = solved - bench.surface.parameters
    return Source(name, description, sigma, effect[:, None])


def film_source(
    bench: TrialBench, sigmas_um: Sequence[float] | FloatArray, description: str, paired: bool
) -> Source:
    """The row for motion of the film from the x frames to the y frames that is not corrected.

    Parameters
    ----------
    bench : TrialBench
        Some points of the set.
    sigmas_um : (k,) floats
        Independent parts of the motion.
    description : str
        Description of the row.
    paired : bool
        As `Source.paired`.
    """
    half_mm = moves_mm(bench) * np.array([[0.5], [-0.5]])
    per_um = bench.solve(bench.geometry(), half_mm, linear=True) - bench.surface.parameters
    sigma_um = float(np.linalg.norm(sigmas_um))
    return Source(
        "film_x_to_y_um",
        description,
        sigma_um,
        np.outer(per_um, sigmas_um),
        common=False,
        paired=paired,
    )


def vertex_source(bench: TrialBench, sigma_um: float, description: str) -> Source:
    """Return the row for a vertex that is nearer to camera and screen, or further from them, than
    the laser measures.

    Parameters
    ----------
    bench : TrialBench
        Some points of the set.
    sigma_um : float
        Standard uncertainty of the vertex' place.
    description : str
        Of the row.

    Returns
    -------
    Source
    """
    nominal = bench.geometry()
    geometry = nominal.geometry
    # A vertex that is lower by sigma is a camera and a screen that are higher by it.
    away_mm = np.array([0.0, 0.0, 1e-3 * sigma_um])
    farther = replace(
        geometry,
        pinhole_mm=geometry.pinhole_mm + away_mm,
        screen_origin_mm=geometry.screen_origin_mm + away_mm,
    )
    solved = bench.solve(replace(nominal, geometry=farther), linear=True)
    effect = solved - bench.surface.parameters
    return Source("vertex_um", description, sigma_um, effect[:, None], common=False, paired=False)
