"""Small rigid motions of camera, screen, lens and mirror, and what each does to the screen points.

A bench is known by its calibration. What moves afterwards changes the screen points that the
camera's pixels see, in a way that the geometry determines. Each motion has three shifts and three
turns about axes of the moved body:

| body   | axes                                        | turns about                    |
|--------|---------------------------------------------|--------------------------------|
| camera | x right, y down, z forward                  | the pinhole                    |
| screen | s_x, s_y, normal towards the mirror         | O'                             |
| mirror | world x, y, z                               | the vertex                     |
| lens   | image shifts along x and y, and focal length | none                           |
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from membrane_ctrl.metrology.rays import ray_tracing
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.motion_group import LARGEST, MotionGroup
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.model.arrays import FloatArray

# Step of the central differences. 100 µm or 100 µrad: a motion so small is linear to 1e-4, and a
# trace of 1e-9 mm is exact to 1e-8 of its effect.
_STEP = 1e-1
_MM_PER_UM = 1e-3
_RAD_PER_URAD = 1e-6
_NEWTON_STEPS = 3  # from 0.1 mm off: below 1e-12 mm


GROUPS = (
    MotionGroup("the camera shifted sideways", 2, "µm"),
    MotionGroup.hidden("the camera shifted along its axis", "µm"),
    MotionGroup("the camera turned", 2, "µrad"),
    MotionGroup("the camera rolled about its axis", 1, "µrad"),
    MotionGroup("the screen shifted sideways", 2, "µm"),
    MotionGroup.hidden("the screen shifted along its normal", "µm"),
    MotionGroup("the screen tilted", 2, "µrad", knock=LARGEST),
    MotionGroup("the screen rolled in its plane", 1, "µrad"),
    MotionGroup("the mirror shifted sideways", 2, "µm", allowance=0.0),
    MotionGroup.hidden("the mirror shifted along z", "µm", allowance=0.0),
    MotionGroup("the mirror tilted", 2, "µrad", allowance=0.0, is_of_mirror=True),
    MotionGroup.hidden("the mirror rolled about z", "µrad"),
    MotionGroup("the picture shifted on the sensor", 2, "µrad"),
    MotionGroup.hidden("the focal length changed", "ppm", allowance=1.0),
)
COMPONENTS = sum(group.components for group in GROUPS)


@cache
def group_columns() -> tuple[slice, ...]:
    """Columns of each group among all components."""
    ends = np.cumsum([group.components for group in GROUPS]).tolist()
    begins = [0, *ends[:-1]]
    return tuple(slice(begin, end) for begin, end in zip(begins, ends, strict=True))


def describe_hidden_allowance() -> str:
    """What the bars allow of hidden motions, for a person: bodies and 1 sigma of each motion."""
    hidden = [group for group in GROUPS if group.is_hidden and group.allowance > 0]
    return "; ".join(f"{group.name} by {group.allowance:g} {group.unit}" for group in hidden)


@dataclass(frozen=True)
class _Moved:
    """A bench after a motion: its geometry, and the rays (3, n) in world."""

    geometry: Geometry
    rays: FloatArray


def screen_changes(
    geometry: Geometry, rays: FloatArray, t_mm: FloatArray, surface: Surface, vertex_z_mm: float
) -> FloatArray:
    """Change of the seen screen points by each component of the motions.

    Parameters
    ----------
    geometry : Geometry
        The bench before the motion.
    rays : (3, n) array
        Unit vectors of pixels or bins, in world.
    t_mm : (n,) array
        Their lengths to the surface.
    surface, vertex_z_mm
        The film.

    Returns
    -------
    (COMPONENTS, 2, n) array
        In mm per µm or µrad (ppm), in the order of `GROUPS`.
    """
    out = np.empty((COMPONENTS, 2, rays.shape[1]))
    in_camera = geometry.rotation @ rays
    step = _STEP / _MM_PER_UM
    for k in range(COMPONENTS):
        # Trace the rays of the bench moved by one step to either side.
        screen_mm = []
        for sign in (1.0, -1.0):
            components = np.zeros(COMPONENTS)
            components[k] = sign * step
            moved = _bench_after(geometry, in_camera, components)
            points = ray_tracing.Points(moved.rays, out[k], np.ones(t_mm.size), t_mm.copy())
            tracer = ray_tracing.Tracer(moved.geometry, surface.radius_mm, vertex_z_mm)
            tracer.intersect(points, surface, newton=_NEWTON_STEPS)
            screen_mm.append(tracer.predict_screen(points, surface))

        # Central difference.
        out[k] = (screen_mm[0] - screen_mm[1]) / (2 * step)
    return out


def _bench_after(geometry: Geometry, in_camera: FloatArray, components: FloatArray) -> _Moved:
    """The bench after a motion.

    Parameters
    ----------
    geometry : Geometry
        The bench before.
    in_camera : (3, n) array
        Rays in the camera's frame.
    components : (COMPONENTS,) array
        The motion, in µm, µrad and ppm: shifts and turns of camera, screen and mirror, and the
        lens.
    """
    camera_shift = components[0:3]
    camera_turn = components[3:6]
    screen_shift = components[6:9]
    screen_turn = components[9:12]
    mirror_shift = components[12:15]
    mirror_turn = components[15:18]
    image_x, image_y, focal = components[18:]

    # The lens: pixels see other directions.
    across = in_camera[:2] / in_camera[2] * (1 - 1e-6 * focal)
    across = across - _RAD_PER_URAD * np.array([[image_x], [image_y]])
    seen = np.vstack([across, np.ones(across.shape[1])])
    seen /= np.linalg.norm(seen, axis=0)

    # Camera and screen, about their own axes.
    pinhole = geometry.pinhole_mm + geometry.rotation.T @ (_MM_PER_UM * camera_shift)
    rotation = _turn_matrix(camera_turn).T @ geometry.rotation
    axes = geometry.screen_axes
    origin = geometry.screen_origin_mm + axes.T @ (_MM_PER_UM * screen_shift)
    axes = _turn_matrix(screen_turn).T @ axes

    # The mirror: the others move the opposite way.
    back = _turn_matrix(mirror_turn).T
    shift_mm = _MM_PER_UM * mirror_shift
    rotation = rotation @ back.T
    axes = axes @ back.T
    moved = replace(
        geometry,
        pinhole_mm=back @ (pinhole - shift_mm),
        rotation=rotation,
        screen_origin_mm=back @ (origin - shift_mm),
        screen_s_x=axes[0],
        screen_s_y=axes[1],
    )
    return _Moved(moved, np.ascontiguousarray(rotation.T @ seen))


def _turn_matrix(turn_urad: FloatArray) -> FloatArray:
    """Turn (3, 3) by a small vector (3,) of angles, exact to third order."""
    x, y, z = _RAD_PER_URAD * turn_urad
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / 2)
