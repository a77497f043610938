"""What the camera sees of the mirror and, reflected by it, of the pattern: is a stated geometry
plausible?

On a paraboloid and without the lens' distortion: enough to judge a bench, not to measure with it.
"""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config.schema import CameraConfig, GeometryConfig, OpticsConfig
from membrane_ctrl.model.arrays import FloatArray

# Shares of the mirror that must be measured: with less than half, the terms are not determined.
_LEAST = 0.5
_GOOD = 0.9
_RINGS = 20  # of points on the mirror
_SPOKES = 36
_FOLD_RANGE = 4.0  # search for a fold of the lens up to here, over the picture's corner
_FOLD_STEPS = 4001
_DEPTHS = np.linspace(0.0, 0.5, 26)  # of any bowl, over its radius


@dataclass(frozen=True, slots=True)
class Sight:
    """What a camera sees of a mirror.

    Attributes
    ----------
    shown : float
        Share of the analysed part of the mirror that is in the camera's image.
    measured : float
        Share that is shown, with the camera's ray reflected onto the pattern.
    centre_off_mm : float
        Distance from O' to where the ray by the vertex meets the screen's plane; infinite if it
        never does.
    """

    shown: float
    measured: float
    centre_off_mm: float


@dataclass(frozen=True, slots=True)
class Doubt:
    """Why a geometry is not plausible, and what to check.

    Attributes
    ----------
    hopeless : bool
        Less than half of the mirror can be measured, or it is seen twice.
    key : str
        Key of the configuration that is probably wrong.
    why, remedy : str
        For people.
    table : str
        Table of the key, in `optics`.
    """

    hopeless: bool
    key: str
    why: str
    remedy: str
    table: str = "geometry"


def compute_poses(
    geometry: GeometryConfig,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Poses of camera and screen in world, from either form of a geometry.

    Source: docs/reference/interfaces.md.

    Returns
    -------
    pinhole_mm : (3,) array
        F.
    rotation : (3, 3) array
        Rows: the camera's x (right), y (down) and z (forward).
    origin_mm : (3,) array
        O'.
    s_x, s_y : (3,) arrays
        Unit vectors on the screen.

    Raises
    ------
    ValueError
        Neither form is complete.
    """
    screen = None if geometry.screen is None else geometry.screen.pose
    if geometry.camera is not None and screen is not None:
        pinhole = np.array(geometry.camera.position_mm, float)
        rotation = np.array(geometry.camera.rotation, float)
        origin, s_x, s_y = (np.array(vector, float) for vector in screen)
        return pinhole, rotation, origin, s_x, s_y
    if geometry.a_mm is None or geometry.b_mm is None or geometry.alpha_deg is None:
        raise ValueError("geometry has neither a_mm, b_mm, alpha_deg nor both poses")
    # The short form: F = a (cos alpha, 0, sin alpha) looking at O, O' = b (-cos alpha, 0, sin
    # alpha) and the screen perpendicular to O O'.
    cosine = math.cos(math.radians(geometry.alpha_deg))
    sine = math.sin(math.radians(geometry.alpha_deg))
    pinhole = geometry.a_mm * np.array([cosine, 0.0, sine])
    rotation = np.array([[sine, 0.0, -cosine], [0.0, -1.0, 0.0], [-cosine, 0.0, -sine]])
    origin = geometry.b_mm * np.array([-cosine, 0.0, sine])
    s_x = np.array([-sine, 0.0, -cosine])
    s_y = np.array([0.0, 1.0, 0.0])
    return pinhole, rotation, origin, s_x, s_y


def trace_view(optics: OpticsConfig, sag_mm: float) -> Sight:
    """Follow the camera's rays to a bowl of this depth and on to the screen's plane.

    Parameters
    ----------
    optics : OpticsConfig
        The bench.
    sag_mm : float
        Depth of the paraboloid.

    Returns
    -------
    Sight
    """
    pinhole, rotation, origin, s_x, s_y = compute_poses(optics.geometry)
    camera = optics.camera
    pattern = optics.pattern
    mirror = optics.mirror

    # Points (n, 3) on the bowl, the vertex and then rings of equal area, and their normals.
    radius = np.sqrt((np.arange(_RINGS) + 0.5) / _RINGS) * mirror.analysis_radius_mm
    spoke = 2 * np.pi * np.arange(_SPOKES) / _SPOKES
    x = np.append(0.0, np.outer(radius, np.cos(spoke)))
    y = np.append(0.0, np.outer(radius, np.sin(spoke)))
    bend = sag_mm / mirror.radius_mm**2
    point = np.stack([x, y, bend * (x**2 + y**2)], axis=1)
    normal = np.stack([-2 * bend * x, -2 * bend * y, np.ones_like(x)], axis=1)

    # The camera's rays to these points, and their reflections: r - 2 (r.n) n / n.n
    ray = point - pinhole
    towards = np.sum(ray * normal, axis=1)
    twice_projected = 2 * towards / np.sum(normal**2, axis=1)
    reflected = ray - twice_projected[:, None] * normal

    # The pixels that see the points, and where the reflections meet the screen's plane.
    in_camera = ray @ rotation.T
    focal_px = camera.focal_mm / (1e-3 * camera.pixel_um)
    screen_normal = np.cross(s_x, s_y)  # points at the mirror
    to_screen = (origin - point) @ screen_normal
    along_reflected = reflected @ screen_normal
    with np.errstate(divide="ignore", invalid="ignore"):
        pixel = focal_px * in_camera[:, :2] / in_camera[:, 2:] + camera.principal
        reach = to_screen / along_reflected
        from_origin = point + reach[:, None] * reflected - origin

    # Which points are in the image, and which reflections meet the pattern from the front.
    size_px = np.array([camera.width_px, camera.height_px])
    inside = (pixel >= -0.5) & (pixel <= size_px - 0.5)
    shown = (in_camera[:, 2] > 0) & inside.all(axis=1)
    arrives = (towards < 0) & (along_reflected < 0) & (to_screen < 0)
    on_screen_mm = np.abs(from_origin @ np.stack([s_x, s_y], axis=1))
    half_side_mm = pattern.periods * pattern.period_mm / 2
    measured = shown & arrives & (on_screen_mm <= half_side_mm).all(axis=1)

    centre_off_mm = math.inf
    if arrives[0]:
        centre_off_mm = float(np.hypot(*on_screen_mm[0]))
    return Sight(float(shown[1:].mean()), float(measured[1:].mean()), centre_off_mm)


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
    if fold_px < corner_px:
        return fold_px
    return math.inf


def _distort_radius(tangent: FloatArray, distortion: tuple[float, ...]) -> FloatArray:
    """Radial part of OpenCV's lens model.

    Source: OpenCV, camera calibration, `calib3d`: coefficients in the order k1, k2, p1, p2, k3, k4,
    k5, k6; missing ones are 0.

    Parameters
    ----------
    tangent : array
        Distance from the axis over the distance along it, before the lens.
    distortion : tuple of float
        Coefficients.

    Returns
    -------
    array
        The same behind the lens.
    """
    padded = distortion + (0.0,) * 8
    k1, k2, _, _, k3, k4, k5, k6 = padded[:8]
    r2: FloatArray = tangent**2
    numerator = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    denominator = 1 + k4 * r2 + k5 * r2**2 + k6 * r2**3
    return np.asarray(tangent * numerator / denominator)


def find_lens_doubt(optics: OpticsConfig) -> Doubt | None:
    """The doubt about a lens model that folds within the picture, if it does.

    It is hopeless if the fold is within the picture of the mirror.
    """
    camera = optics.camera
    mirror = optics.mirror
    fold_px = find_lens_fold_px(camera)
    if math.isinf(fold_px):
        return None
    # The mirror's rim as the camera sees it
    pinhole, rotation, *_ = compute_poses(optics.geometry)
    spoke = 2 * np.pi * np.arange(_SPOKES) / _SPOKES
    rim = mirror.analysis_radius_mm * np.stack([np.cos(spoke), np.sin(spoke), 0 * spoke], axis=1)
    in_camera = (rim - pinhole) @ rotation.T
    # Tangents of the angles to the axis, before the lens, up to that of the rim.
    tangent = np.hypot(in_camera[:, 0], in_camera[:, 1]) / in_camera[:, 2]
    up_to_rim = np.linspace(0.0, float(tangent.max()), _FOLD_STEPS)
    in_mirror = bool((np.diff(_distort_radius(up_to_rim, camera.distortion)) <= 0).any())
    where = "within the picture, beside the mirror"
    if in_mirror:
        where = "within the mirror's picture"
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

    Parameters
    ----------
    optics : OpticsConfig
        The bench.
    depth_known : bool
        Whether `mirror.sag_mm` is the film's depth. If not, the geometry is judged with the depth
        that suits it best.

    Returns
    -------
    Doubt or None
    """
    # A folded lens makes every other judgement wrong
    fold = find_lens_doubt(optics)
    if fold is not None:
        return fold
    depths_mm = [optics.mirror.sag_mm]
    if not depth_known:
        depths_mm = (_DEPTHS * optics.mirror.radius_mm).tolist()
    views = [trace_view(optics, depth_mm) for depth_mm in depths_mm]
    best = max(views, key=lambda view: view.measured)
    if best.measured >= _GOOD:
        return None
    hopeless = best.measured < _LEAST
    geometry = optics.geometry

    # The mirror is not in the picture: the camera's pose.
    if best.shown < _GOOD:
        key = "a_mm" if geometry.camera is None else "camera.position_mm"
        why = f"{best.shown:.0%} of the mirror is in the camera's image"
        remedy = "check the camera's pose, focal_mm, pixel_um and principal_px"
        return Doubt(hopeless, key, why, remedy)

    # The mirror does not show the pattern: the angle, or the screen's pose.
    half_mm = optics.pattern.periods * optics.pattern.period_mm / 2
    why = (
        f"the pattern ({half_mm:.0f} mm each way from O') is seen in {best.measured:.0%} of the "
        "mirror"
    )
    if geometry.alpha_deg is not None:
        return Doubt(
            hopeless, "alpha_deg", why, _find_angle_hint(optics, geometry.alpha_deg, depths_mm)
        )
    if math.isinf(best.centre_off_mm):
        why += ": the camera's ray by the vertex never meets the screen"
    elif best.centre_off_mm > half_mm:
        place = f"{best.centre_off_mm:.0f} mm from O'"
        why += f": the camera's ray by the vertex meets the screen {place}"
    return Doubt(hopeless, "screen.origin_mm", why, "check the poses, [pattern] and mirror.sag_mm")


def _find_angle_hint(optics: OpticsConfig, alpha_deg: float, depths_mm: list[float]) -> str:
    """What the angle may be instead, if the bench is plausible with that."""
    alternatives = (
        ("as radians", math.degrees(alpha_deg)),
        ("from the mirror's axis", 90.0 - alpha_deg),
    )
    for reading, corrected_deg in alternatives:
        if not 0.0 < corrected_deg < 180.0:
            continue
        geometry = optics.geometry.model_copy(update={"alpha_deg": corrected_deg})
        corrected = optics.model_copy(update={"geometry": geometry})
        if max(trace_view(corrected, depth_mm).measured for depth_mm in depths_mm) >= _GOOD:
            return f"{reading} it is {corrected_deg:.1f} deg"
    return (
        "measure alpha_deg from the mirror's plane; check a_mm, b_mm, [pattern] and mirror.sag_mm"
    )
