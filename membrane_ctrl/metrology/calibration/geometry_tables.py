"""The solution as the tables of `geometry.toml`.

`[geometry]` is what every command reads. `[covariance]` is what error bars and a Monte Carlo use:
shifts and turns of camera and screen in world, twelve of them, made from the eleven parameters
(the twelfth direction, a turn of everything about z, has no variance: it defines x), and the
parameters of lens, bow and pitch that were free. `[parameters]` are the calibration's own,
`[calibration]` states the origin of all that. The screen's bow is in `[geometry.screen]`.
`[camera]` and `[pattern]` are there if the lens or the screen's pitch were calibrated; a
measurement with such a file needs them too.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from membrane_ctrl.config.optics import (
    CameraPoseConfig,
    GeometryConfig,
    OpticsConfig,
    ScreenPoseConfig,
    Vector3,
)
from membrane_ctrl.metrology.calibration.set_state import RING_PLACE
from membrane_ctrl.metrology.calibration.solver import Solution
from membrane_ctrl.metrology.rays import bench_parameters, bench_poses
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.screen_face import BOW_RADIUS_MM
from membrane_ctrl.metrology.uncertainty.geometry_spread import GENERAL_NAMES
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.geometry_hash import SCHEMA, hash_content
from membrane_ctrl.model.program import file_origin

_LENS = ("focal_relative", "principal_x_px", "principal_y_px", "k1", "k2", "p1", "p2")


@dataclass(frozen=True)
class Origin:
    """Origin of a geometry, as `[calibration]` states it.

    Attributes
    ----------
    date_utc : str
    sets : tuple of str
        Names of the capture sets.
    screen_residual_um : float
        Median over the sets of the RMS of seen minus predicted screen points.
    slope_residual_urad : float
        Median over the sets of the RMS that `measure` states with this geometry: the reference for
        a drift.
    slope_noise_urad : float
        Share of the camera's noise in it.
    condition : float
        See `weak_combinations.condition_number`.
    notes : tuple of str
        Findings of the calibration.
    """

    date_utc: str
    sets: tuple[str, ...]
    screen_residual_um: float
    slope_residual_urad: float
    slope_noise_urad: float
    condition: float
    notes: tuple[str, ...] = ()


def make_geometry_tables(
    solution: Solution, optics: OpticsConfig, origin: Origin
) -> dict[str, Any]:
    """Make the content of `geometry.toml`.

    Parameters
    ----------
    solution : Solution
        The calibration.
    optics : OpticsConfig
        The stated bench.
    origin : Origin
        Where the numbers come from.

    Returns
    -------
    dict
        The tables of the module's text.
    """
    free = [bench_parameters.NAMES.index(name) for name in solution.free_names]

    # Geometry, its covariance in the general form, and the parameters as solved.
    tables: dict[str, Any] = {
        **file_origin(SCHEMA),
        "geometry": calibrated_geometry(solution, optics).model_dump(exclude_none=True),
        "covariance": {
            "names": [*GENERAL_NAMES, *_list_free_options(solution)],
            "matrix": general_covariance(solution).tolist(),
        },
        "parameters": {
            "names": [bench_parameters.NAMES[k] for k in free],
            "values": solution.values[free].tolist(),
            "sigmas": solution.sigmas[free].tolist(),
            "covariance": solution.covariance[np.ix_(free, free)].tolist(),
        },
    }

    # Lens and period, if they were free.
    bench = solution.bench
    if set(solution.free_names) & set(_LENS):
        of_camera = {
            key: getattr(optics.camera, key) for key in ("width_px", "height_px", "pixel_um")
        }
        tables["camera"] = of_camera | {
            "focal_mm": bench.geometry.focal_px * optics.camera.pixel_um * 1e-3,
            "principal_px": list(bench.geometry.principal_px),
            "distortion": list(bench.geometry.distortion),
        }
    if "pitch_relative" in solution.free_names:
        tables["pattern"] = {"period_mm": optics.pattern.period_mm * bench.pitch}

    # Where the numbers come from, and the hash of all tables before.
    tables["calibration"] = {
        "date_utc": origin.date_utc,
        "sets": list(origin.sets),
        "screen_residual_um": origin.screen_residual_um,
        "slope_residual_urad": origin.slope_residual_urad,
        "slope_noise_urad": origin.slope_noise_urad,
        "ring_um": (1e3 * solution.common[RING_PLACE][1:]).tolist(),
        "condition": origin.condition,
        "notes": list(origin.notes),
        "hash": hash_content(tables),
    }
    return tables


def calibrated_geometry(solution: Solution, optics: OpticsConfig) -> GeometryConfig:
    """Return the calibrated geometry in the general form.

    Parameters
    ----------
    solution : Solution
    optics : OpticsConfig
        The stated bench, whose height map of the screen stays.

    Returns
    -------
    GeometryConfig
        With the reference displacement of the calibration.
    """
    reference = {"reference_displacement_um": solution.problem.references.reference_um}
    return general_form(solution.bench.geometry, optics).model_copy(update=reference)


def general_form(geometry: Geometry, optics: OpticsConfig) -> GeometryConfig:
    """Return a geometry as the poses of camera and screen.

    Parameters
    ----------
    geometry : Geometry
    optics : OpticsConfig
        The stated bench, whose height map and reference displacement stay.

    Returns
    -------
    GeometryConfig
    """
    height_map = None
    if optics.geometry.screen is not None:
        height_map = optics.geometry.screen.height_map
    right, down, forward = (_to_vector(row) for row in geometry.rotation)
    return GeometryConfig(
        reference_displacement_um=optics.geometry.reference_displacement_um,
        camera=CameraPoseConfig(
            position_mm=_to_vector(geometry.pinhole_mm), rotation=(right, down, forward)
        ),
        screen=ScreenPoseConfig(
            origin_mm=_to_vector(geometry.screen_origin_mm),
            s_x=_to_vector(geometry.screen_s_x),
            s_y=_to_vector(geometry.screen_s_y),
            bow_mm=geometry.face.bow_per_mm * BOW_RADIUS_MM**2,
            height_map=height_map,
        ),
    )


def general_covariance(solution: Solution) -> FloatArray:
    """Covariance (12 + k, 12 + k) of `GENERAL_NAMES` and of the k free parameters of lens, bow and
    pitch.

    Rows r of a body turned by a small w become r + w x r, so that C^T dC is minus the cross-product
    matrix of w.
    """
    geometry = solution.bench.geometry
    columns = []
    for turn in bench_poses.pose_derivatives(solution.problem.stated, solution.values):
        camera_turn = _turn_vector(geometry.rotation.T @ turn.camera)
        screen_turn = _turn_vector(geometry.screen_axes.T @ turn.screen)
        changes = [turn.pinhole_mm, camera_turn, turn.origin_mm, screen_turn]
        columns.append(np.concatenate(changes))
    poses = np.stack(columns, axis=1)

    # From the free parameters to the general form: the poses by their derivatives, the others
    # unchanged.
    optional = [bench_parameters.NAMES.index(name) for name in _list_free_options(solution)]
    general_poses, stated_poses = poses.shape
    used = [*range(stated_poses), *optional]
    matrix = np.eye(general_poses + len(optional), len(used), k=stated_poses - general_poses)
    matrix[:general_poses, :stated_poses] = poses
    covariance = matrix @ solution.covariance[np.ix_(used, used)] @ matrix.T
    return np.asarray((covariance + covariance.T) / 2)


def _list_free_options(solution: Solution) -> list[str]:
    """Names of the optional parameters that were free."""
    return [
        parameter.name
        for parameter in bench_parameters.OPTIONAL
        if parameter.name in solution.free_names
    ]


def _turn_vector(cross: FloatArray) -> FloatArray:
    """Small turn w (3,) from minus its cross-product matrix (3, 3), which is antisymmetric."""
    x = cross[2, 1] - cross[1, 2]
    y = cross[0, 2] - cross[2, 0]
    z = cross[1, 0] - cross[0, 1]
    return -np.array([x, y, z]) / 2


def _to_vector(values: FloatArray) -> Vector3:
    return float(values[0]), float(values[1]), float(values[2])
