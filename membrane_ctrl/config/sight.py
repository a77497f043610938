"""What the camera sees of the mirror and, reflected by it, of the pattern: is a stated geometry
plausible?

On a paraboloid and without the lens' distortion: enough to judge a bench, not to measure with it.
"""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config.schema import CameraConfig, GeometryConfig, OpticsConfig
from membrane_ctrl.model.arrays import FloatArray

_LEAST, _GOOD = 0.5, 0.9  # shares of the mirror: from less than half, the terms are not determined
_RINGS, _SPOKES = 20, 36
_FOLD_RANGE, _FOLD_STEPS = 4.0, 4001  # of the picture's corner, to look for a fold of the lens
_DEPTHS = np.linspace(0.0, 0.5, 26)  # of any bowl, over its radius


@dataclass(frozen=True, slots=True)
class Sight:
    """Shares of the analysed part of the mirror, 0 to 1."""

    shown: float  # within the camera's image
    measured: float  # shown, with the camera's ray reflected onto the pattern
    # from O' to where the ray by the vertex meets the screen's plane; infinite if it never does
    centre_off_mm: float


@dataclass(frozen=True, slots=True)
class Doubt:
    """Why a geometry is not plausible, and what to check."""

    hopeless: bool  # less than half of the mirror can be measured, or it is seen twice
    key: str  # of the table
    why: str
    remedy: str
    table: str = "geometry"  # of the optics


def compute_poses(
    geometry: GeometryConfig,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Pinhole (3,), rotation (3, 3), O', s_x and s_y (3,) in world, from either form
    (docs/reference/interfaces.md).
    """
    screen = None if geometry.screen is None else geometry.screen.pose
    if geometry.camera is not None and screen is not None:
        general = (geometry.camera.position_mm, geometry.camera.rotation, *screen)
        pinhole, rotation, origin, s_x, s_y = (np.array(value, float) for value in general)
        return pinhole, rotation, origin, s_x, s_y
    if geometry.a_mm is None or geometry.b_mm is None or geometry.alpha_deg is None:
        raise ValueError("geometry has neither a_mm, b_mm, alpha_deg nor both poses")
    cosine, sine = (
        math.cos(math.radians(geometry.alpha_deg)),
        math.sin(math.radians(geometry.alpha_deg)),
    )
    return (
        geometry.a_mm * np.array([cosine, 0.0, sine]),
        np.array([[sine, 0.0, -cosine], [0.0, -1.0, 0.0], [-cosine, 0.0, -sine]]),
        geometry.b_mm * np.array([-cosine, 0.0, sine]),
        np.array([-sine, 0.0, -cosine]),
        np.array([0.0, 1.0, 0.0]),
    )


def trace_view(optics: OpticsConfig, sag_mm: float) -> Sight:
    """Follow the camera's rays to a bowl of this depth and on to the screen's plane."""
    pinhole, rotation, origin, s_x, s_y = compute_poses(optics.geometry)
    camera, pattern, mirror = optics.camera, optics.pattern, optics.mirror
    radius = (
        np.sqrt((np.arange(_RINGS) + 0.5) / _RINGS) * mirror.analysis_radius_mm
    )  # rings of equal area
    spoke = 2 * np.pi * np.arange(_SPOKES) / _SPOKES
    x, y = (
        np.append(0.0, np.outer(radius, np.cos(spoke))),
        np.append(0.0, np.outer(radius, np.sin(spoke))),
    )
    bend = sag_mm / mirror.radius_mm**2
    point = np.stack([x, y, bend * (x**2 + y**2)], axis=1)
    normal = np.stack([-2 * bend * x, -2 * bend * y, np.ones_like(x)], axis=1)
    ray = point - pinhole
    towards = np.sum(ray * normal, axis=1)
    seen = ray @ rotation.T
    reflected = ray - (2 * towards / np.sum(normal**2, axis=1))[:, None] * normal
    face = np.cross(s_x, s_y)  # points at the mirror
    with np.errstate(divide="ignore", invalid="ignore"):
        pixel = (
            camera.focal_mm / (1e-3 * camera.pixel_um) * seen[:, :2] / seen[:, 2:]
            + camera.principal
        )
        place = point + ((origin - point) @ face / (reflected @ face))[:, None] * reflected - origin
    inside = (pixel >= -0.5) & (pixel <= np.array([camera.width_px, camera.height_px]) - 0.5)
    shown = (seen[:, 2] > 0) & inside.all(axis=1)
    arrives = (towards < 0) & (reflected @ face < 0) & ((origin - point) @ face < 0)
    on_screen = np.abs(place @ np.stack([s_x, s_y], axis=1))
    lit = arrives & (on_screen <= pattern.periods * pattern.period_mm / 2).all(axis=1)
    centre_off_mm = float(np.hypot(*on_screen[0])) if arrives[0] else math.inf
    return Sight(float(shown[1:].mean()), float((shown & lit)[1:].mean()), centre_off_mm)


def find_lens_fold_px(camera: CameraConfig) -> float:
    """Distance from the principal point at which the lens model folds; infinite without a fold.

    From there on, points farther from the axis come nearer to it in the picture, which no lens
    does. A fold beyond the picture's corners does not count.
    """
    column, row = camera.principal
    corner_px = math.hypot(
        max(column, camera.width_px - 1 - column), max(row, camera.height_px - 1 - row)
    )
    focal_px = camera.focal_mm / (1e-3 * camera.pixel_um)
    # far enough for a picture that the model shrinks
    tangent = np.linspace(0.0, _FOLD_RANGE * corner_px / focal_px, _FOLD_STEPS)
    pictured_px = focal_px * _distort_radius(tangent, camera.distortion)
    falls = np.diff(pictured_px) <= 0
    if not falls.any():
        return math.inf
    fold_px = float(pictured_px[np.argmax(falls)])
    return fold_px if fold_px < corner_px else math.inf


def _distort_radius(tangent: FloatArray, distortion: tuple[float, ...]) -> FloatArray:
    """Radial part of OpenCV's model: distance from the axis behind the lens, of that before it."""
    k1, k2, _, _, k3, k4, k5, k6 = (*distortion, *[0.0] * 8)[:8]
    square: FloatArray = tangent**2
    above = 1 + square * (k1 + square * (k2 + square * k3))
    below = 1 + square * (k4 + square * (k5 + square * k6))
    return np.asarray(tangent * above / below)


def find_lens_doubt(optics: OpticsConfig) -> Doubt | None:
    """A lens model that folds within the picture: hopeless if within that of the mirror."""
    camera, mirror = optics.camera, optics.mirror
    fold_px = find_lens_fold_px(camera)
    if math.isinf(fold_px):
        return None
    pinhole, rotation, *_ = compute_poses(optics.geometry)
    spoke = 2 * np.pi * np.arange(_SPOKES) / _SPOKES
    rim = mirror.analysis_radius_mm * np.stack([np.cos(spoke), np.sin(spoke), 0 * spoke], axis=1)
    seen = (rim - pinhole) @ rotation.T
    # before the lens, to compare with where the fold begins
    tangent = np.hypot(seen[:, 0], seen[:, 1]) / seen[:, 2]
    nearer = np.linspace(0.0, float(tangent.max()), _FOLD_STEPS)
    in_mirror = bool((np.diff(_distort_radius(nearer, camera.distortion)) <= 0).any())
    where = "within the mirror's picture" if in_mirror else "within the picture, beside the mirror"
    why = (
        f"the lens model folds {fold_px:.0f} px from the principal point, {where}: farther points "
        "would be pictured nearer"
    )
    remedy = (
        "check signs and order (k1, k2, p1, p2, k3, ...) and focal_mm; calibrate the lens with "
        "photographs that fill the picture"
    )
    return Doubt(in_mirror, "distortion", why, remedy, "camera")


def find_doubt(optics: OpticsConfig, depth_known: bool = True) -> Doubt | None:
    """What is not plausible about a geometry, if anything.

    If the film's depth is not known, the geometry has the benefit of the doubt: that of the depth
    that suits it best.
    """
    fold = find_lens_doubt(optics)
    if fold is not None:
        return fold
    depths_mm = (
        [optics.mirror.sag_mm] if depth_known else (_DEPTHS * optics.mirror.radius_mm).tolist()
    )
    best = max(
        (trace_view(optics, depth_mm) for depth_mm in depths_mm), key=lambda found: found.measured
    )
    if best.measured >= _GOOD:
        return None
    hopeless, geometry = best.measured < _LEAST, optics.geometry
    if best.shown < _GOOD:
        key = "a_mm" if geometry.camera is None else "camera.position_mm"
        why = f"{best.shown:.0%} of the mirror is in the camera's image"
        return Doubt(
            hopeless, key, why, "check the camera's pose, focal_mm, pixel_um and principal_px"
        )
    half_mm = optics.pattern.periods * optics.pattern.period_mm / 2
    why = (
        f"the pattern ({half_mm:.0f} mm each way from O') is seen in {best.measured:.0%} of the "
        "mirror"
    )
    if geometry.alpha_deg is not None:
        return Doubt(hopeless, "alpha_deg", why, _angle_hint(optics, geometry.alpha_deg, depths_mm))
    if best.centre_off_mm > half_mm:
        where = (
            f"{best.centre_off_mm:.0f} mm from O'" if math.isfinite(best.centre_off_mm) else "never"
        )
        why += f": the camera's ray by the vertex meets the screen {where}"
    return Doubt(hopeless, "screen.origin_mm", why, "check the poses, [pattern] and mirror.sag_mm")


def _angle_hint(optics: OpticsConfig, alpha_deg: float, depths_mm: list[float]) -> str:
    """What the angle may be instead, if the bench is plausible with that."""
    for word, meant_deg in (
        ("as radians", math.degrees(alpha_deg)),
        ("from the mirror's axis", 90.0 - alpha_deg),
    ):
        if 0.0 < meant_deg < 180.0:
            geometry = optics.geometry.model_copy(update={"alpha_deg": meant_deg})
            meant = optics.model_copy(update={"geometry": geometry})
            if max(trace_view(meant, depth_mm).measured for depth_mm in depths_mm) >= _GOOD:
                return f"{word} it is {meant_deg:.1f} deg"
    return (
        "measure alpha_deg from the mirror's plane; check a_mm, b_mm, [pattern] and mirror.sag_mm"
    )
