"""The forward model: where a surface on a bench sends each camera ray on the screen, and its
derivatives.

A ray P = F + t d meets the film at F_z + t d_z = z + h(x, y), with n = (-h_x, -h_y, 1) its normal
there; it leaves as u = d - 2 (d n) / (n n) n and meets the screen at S = P + k u. For small
changes of anything (chain rule):

    dP = G (dF + t dd) + d / (n d) (dz + dh)                            (1)
    dn = -(dh_x, dh_y, 0) - H dP                                        (2)
    du = (1 - 2 n n^T / (n n)) dd + B dn                                (3)
    ds = T (dP + k du - dO' + X^T dX (S - O')) + (E u) s^2 dc / (N u)   (4)

with

    G = 1 - d n^T / (n d)
    H = second derivatives of h, bordered by zeros
    B = -2 / (n n) (n d^T + (d n) 1 - 2 (d n) / (n n) n n^T)
    T = E (1 - u N^T / (N u)), which lets the ray run to the face

where X are the screen's rows, E the first two, and N = (third row) - w_x e_x - w_y e_y the normal
of a face that deviates by w = c s^2 + map (`screen_face`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.polynomial.polynomial import polyval2d

from membrane_ctrl.metrology.film import terms_beyond_fit
from membrane_ctrl.metrology.rays import kernels
from membrane_ctrl.metrology.rays.artefacts import SeenScreen
from membrane_ctrl.metrology.rays.bench_parameters import POSE
from membrane_ctrl.metrology.rays.bench_poses import (
    OPTICAL,
    SCREEN_MOVE,
    BenchGeometry,
    Poses,
    screen_elsewhere,
)
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.lens_derivatives import lens_derivatives
from membrane_ctrl.metrology.rays.ray_tracing import Points, Tracer, make_parabola
from membrane_ctrl.metrology.rays.screen_face import BOW_RADIUS_MM
from membrane_ctrl.metrology.rays.set_phases import SetPhases
from membrane_ctrl.metrology.rays.surface import PARAMETERS, Surface
from membrane_ctrl.metrology.rays.surface_basis import evaluate_basis, evaluate_beyond_basis
from membrane_ctrl.model.arrays import BoolArray, FloatArray

# Columns of the derivatives. First the set's own unknowns: its surface's parameters, the height of
# its vertex, its terms beyond them (round ones and waves), by how much the film was deeper in the x
# frames than in the y frames, and the seat of a turned mirror (`set_state`), on which the fringes
# do not depend; then the optical parameters.
BEYOND = slice(PARAMETERS + 1, PARAMETERS + 1 + terms_beyond_fit.BEYOND_TERMS)
MOTION = BEYOND.stop
SEAT = slice(MOTION + 1, MOTION + 4)
LOCAL = SEAT.stop
LOCAL_EVEN = MOTION + 1 - len(terms_beyond_fit.WAVES)  # of a film without waves beyond the fit's
COLUMNS = LOCAL + OPTICAL
_CHUNK = 8192  # points whose derivatives are in memory at a time: 8 MB
_GLASS_INDEX = 1.52


@dataclass(frozen=True)
class Chunk:
    """Residuals and derivatives of some points.

    Attributes
    ----------
    place : slice
        The points among all of the set.
    residual_mm : (2, m) array
        Seen minus predicted screen points.
    derivatives : (2, COLUMNS + further poses, m) array
        Of the predicted screen points by the set's own unknowns in mm, by the optical parameters,
        and by further poses.
    """

    place: slice
    residual_mm: FloatArray
    derivatives: FloatArray


def camera_rays(geometry: Geometry, phases: SetPhases) -> FloatArray:
    """Unit vectors (3, n) in world of a set's bins."""
    return geometry.rays(phases.column_px, phases.row_px)


def place_rays(
    bench: BenchGeometry, phases: SetPhases, surface: Surface, vertex_z_mm: float
) -> Points:
    """The set's rays, followed to the surface."""
    points = Points.of(camera_rays(bench.geometry, phases), phases.screen_mm)
    tracer = Tracer(bench.geometry, surface.radius_mm, vertex_z_mm)
    tracer.start(points, make_parabola(surface.sag_mm, surface.radius_mm))
    tracer.intersect(points, surface, newton=4)  # from some mm: 0.1 mm, 1 nm, 1e-16 mm
    if surface.beyond_mm:
        _follow_waves(tracer, points, surface)
    return points


def _follow_waves(tracer: Tracer, points: Points, surface: Surface) -> None:
    """One more Newton step, to the waves that the kernels do not have: of less than a micrometre,
    it is exact to 1e-13 mm.
    """
    x, y = tracer.position_mm(points)
    hx, hy = surface.slopes(x, y)
    raised = polyval2d(x / surface.radius_mm, y / surface.radius_mm, surface.waves)
    d = points.rays
    points.t_mm += raised / (d[2] - hx * d[0] - hy * d[1])


def residual_mm(
    bench: BenchGeometry,
    phases: SetPhases,
    surface: Surface,
    vertex_z_mm: float,
    elsewhere: Sequence[FloatArray] = (),
) -> FloatArray:
    """Seen minus predicted screen points.

    Parameters
    ----------
    bench : BenchGeometry
    phases : SetPhases
        Screen points of n bins.
    surface : Surface
    vertex_z_mm : float
        Height of the vertex.
    elsewhere : sequence of (MOVED,) arrays
        Moves of the screen, one for each further place of it.

    Returns
    -------
    (2, n) array
        In mm.
    """
    out = np.empty_like(phases.screen_mm)
    for _, there, _, some in screen_views(bench, [], phases, elsewhere):
        part = phases.subset(some)
        shape = None if isinstance(phases.artefact, SeenScreen) else surface
        points = place_rays(there, part, surface, vertex_z_mm)
        met = [
            _intersect_screen(there, points, shape, part).screen_mm
            for part in _split_points(points.t_mm.size)
        ]
        out[:, some] = part.screen_mm - np.concatenate(met, axis=1) / bench.pitch
    return out


def screen_views(
    bench: BenchGeometry, turns: list[Poses], phases: SetPhases, moves: Sequence[FloatArray]
) -> Iterator[tuple[int, BenchGeometry, list[Poses], BoolArray]]:
    """Each place of the screen: its number, the bench and its `turns` there, and which points (n,)
    were seen so.
    """
    if isinstance(phases.artefact, SeenScreen):
        # The screen stands somewhere before the camera: the bench's poses do not matter.
        camera = bench.geometry
        s_x, s_y, _ = phases.artefact.axes @ camera.rotation
        origin_mm = camera.pinhole_mm + camera.rotation.T @ phases.artefact.origin_mm
        there = replace(camera, screen_origin_mm=origin_mm, screen_s_x=s_x, screen_s_y=s_y)
        still = Poses(np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3)))
        moved = screen_elsewhere(
            replace(bench, geometry=there), [still] * len(turns), moves[0][:SCREEN_MOVE]
        )
        yield 1, *moved, phases.seen_with(0)
        return
    yield 0, bench, turns, phases.seen_with(0)
    for k, move in enumerate(moves, start=1):
        yield k, *screen_elsewhere(bench, turns, move[:SCREEN_MOVE]), phases.seen_with(k)


def linearise_points(
    bench: BenchGeometry,
    turns: list[Poses],
    phases: SetPhases,
    surface: Surface,
    vertex_z_mm: float,
    motion_mm: float = 0.0,
    deeper_mm: float = 0.0,
) -> Iterator[Chunk]:
    """Residuals with derivatives, some points at a time.

    Parameters
    ----------
    bench : BenchGeometry
    turns : list of Poses
        The `pose_derivatives`, and any further.
    phases : SetPhases
    surface : Surface
    vertex_z_mm : float
        Height of the vertex.
    motion_mm : float
        By how much the film was deeper in the x frames than in the y frames.
    deeper_mm : float
        By how much it was deeper in all frames.

    Yields
    ------
    Chunk
    """
    points = place_rays(bench, phases, surface, vertex_z_mm)
    shape = None if isinstance(phases.artefact, SeenScreen) else surface
    for part in _split_points(points.t_mm.size):
        meet = _intersect_screen(bench, points, shape, part)
        lens = lens_derivatives(
            bench.geometry, phases.column_px[part], phases.row_px[part], meet.ray
        )
        derivatives = _compute_derivatives(bench, turns, shape, meet, lens)
        # Motion and depth are small enough to be linear.
        by_motion = derivatives[:, MOTION]
        predicted = (
            meet.screen_mm / bench.pitch
            + motion_mm * by_motion
            + deeper_mm * depth_derivative(by_motion)
        )
        yield Chunk(part, phases.screen_mm[:, part] - predicted, derivatives)


def _split_points(count: int) -> Iterator[slice]:
    return (slice(first, min(first + _CHUNK, count)) for first in range(0, count, _CHUNK))


@dataclass(frozen=True)
class _Meeting:
    """Points where rays meet film and screen; vectors are (3, m)."""

    ray: FloatArray
    t_mm: FloatArray
    place: FloatArray
    normal: FloatArray
    leaves: FloatArray
    reach_mm: FloatArray
    from_origin: FloatArray
    face: FloatArray
    screen_mm: FloatArray


def _intersect_screen(
    bench: BenchGeometry, points: Points, surface: Surface | None, part: slice
) -> _Meeting:
    """Reflect the rays and follow them to the face, by Newton's steps from the plane unless it is
    one.
    """
    # The ray P = F + t d, reflected at the film; without a film it reaches the screen directly.
    geometry = bench.geometry
    d = points.rays[:, part]
    if surface is None:
        t = np.zeros(d.shape[1])
        place = geometry.pinhole_mm[:, None] + t * d
        n = d
        u = d
    else:
        t = points.t_mm[part]
        place = geometry.pinhole_mm[:, None] + t * d
        hx, hy = surface.slopes(place[0], place[1])
        n = np.stack([-hx, -hy, np.ones_like(hx)])
        u = d - 2 * np.sum(d * n, axis=0) / np.sum(n * n, axis=0) * n

    # S = P + k u on the screen, in its own axes: on the plane, then by Newton's steps on the face.
    axes = geometry.screen_axes
    start = axes @ (place - geometry.screen_origin_mm[:, None])
    along = axes @ u
    k = -start[2] / along[2]
    steps = 0 if geometry.face.is_plane else kernels.FACE_STEPS
    for _ in range(steps):
        at = start + k * along
        w, by_x, by_y = geometry.face.heights(at[:2])
        k = k - (at[2] - w) / (along[2] - by_x * along[0] - by_y * along[1])
    at = start + k * along
    _w, by_x, by_y = geometry.face.heights(at[:2])
    face = axes[2][:, None] - by_x * axes[0][:, None] - by_y * axes[1][:, None]
    return _Meeting(d, t, place, n, u, k, axes.T @ at, face, at[:2])


def _compute_derivatives(
    bench: BenchGeometry, turns: list[Poses], surface: Surface | None, m: _Meeting, lens: FloatArray
) -> FloatArray:
    """(2, COLUMNS + further poses, m) by the formulas above, right to left: the effect of a change
    of P, u, n, d.
    """
    geometry = bench.geometry
    axes = geometry.screen_axes
    across = axes[:2] @ m.leaves  # E u
    onto = np.sum(m.face * m.leaves, axis=0)  # N u
    by_point = axes[:2, :, None] - across[:, None] * (m.face / onto)  # T
    out = np.zeros((2, COLUMNS + len(turns) - len(POSE), m.t_mm.size))

    # The surface's own columns, and the effect of the pinhole and of the ray (equations 1 to 3).
    if surface is None:
        by_pinhole = by_point
        by_ray = by_point * m.reach_mm
    else:
        by_pinhole, by_ray = _by_surface(surface, m, by_point, out)

    # Poses of camera and screen (equation 4).
    in_camera = geometry.rotation @ m.ray
    for j, turn in enumerate(turns):
        moved = axes.T @ (turn.screen @ m.from_origin) - turn.origin_mm[:, None]
        of_ray = turn.camera.T @ in_camera
        column = np.einsum("acm,c->am", by_pinhole, turn.pinhole_mm)
        column += np.einsum("acm,cm->am", by_ray, of_ray) + np.einsum("acm,cm->am", by_point, moved)
        place = LOCAL + j if j < len(POSE) else COLUMNS + j - len(POSE)
        out[:, place] = column

    # Lens, bow of the screen, and glass over its pixels, which bends oblique rays: by 1 mm of it.
    first = LOCAL + len(POSE)
    out[:, first : first + len(lens)] = np.einsum("acm,lcm->alm", by_ray, lens)
    square = m.screen_mm[0] ** 2 + m.screen_mm[1] ** 2
    out[:, COLUMNS - 2] = across * square / onto / BOW_RADIUS_MM**2
    if surface is None:
        sine = across / np.linalg.norm(m.leaves, axis=0) / _GLASS_INDEX
        tangent = sine / np.sqrt(1 - np.sum(sine**2, axis=0))
        out[:, MOTION] = depth_derivative(tangent) / 4

    # From mm on the panel to stated mm, and the scale itself.
    out /= bench.pitch
    out[:, COLUMNS - 1] = -m.screen_mm / bench.pitch**2
    return out


def _by_surface(
    surface: Surface, m: _Meeting, by_point: FloatArray, out: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Fill in the surface's own columns; returns the effect of a change of the pinhole and of the
    ray, (2, 3, m).
    """
    d = m.ray
    n = m.normal
    nn = np.sum(n * n, axis=0)
    nd = np.sum(n * d, axis=0)

    # By the reflected ray, T k, and by the normal, T k B (equation 3).
    ray = by_point * m.reach_mm
    along = np.einsum("acm,cm->am", ray, n)
    by_normal = -2 / nn * (along[:, None] * d + nd * ray - 2 * nd / nn * along[:, None] * n)

    # By the point on the film, whose normal turns with it (equation 2).
    hxx, hxy, hyy = surface.curvatures(m.place[0], m.place[1])
    by_place = by_point.copy()
    by_place[:, 0] -= by_normal[:, 0] * hxx + by_normal[:, 1] * hxy
    by_place[:, 1] -= by_normal[:, 0] * hxy + by_normal[:, 1] * hyy

    # By the film's height, the pinhole and the ray (equation 1).
    by_height = np.einsum("acm,cm->am", by_place, d) / nd
    by_pinhole = by_place - by_height[:, None] * n  # by_place G
    by_ray = by_pinhole * m.t_mm + ray - 2 / nn * along[:, None] * n

    # By the parameters: each changes height and slopes by those of its term.
    x = m.place[0] / surface.radius_mm
    y = m.place[1] / surface.radius_mm
    scale = 1 / surface.radius_mm
    bases = zip(evaluate_basis(x, y), evaluate_beyond_basis(x, y), strict=True)
    height, height_x, height_y = (np.vstack(parts) for parts in bases)
    for axis in range(2):
        slope = (by_normal[axis, 0] * height_x + by_normal[axis, 1] * height_y) * scale
        by_terms = by_height[axis] * height - slope
        out[axis, :PARAMETERS] = by_terms[:PARAMETERS]
        out[axis, BEYOND] = by_terms[PARAMETERS:]
    out[:, PARAMETERS] = by_height

    # By the film's motion from the x frames to the y frames: half of it to each side.
    deeper = np.einsum("j,ajm->am", _sag_direction(), out[:, :PARAMETERS]) - by_height
    out[0, MOTION] = deeper[0] / 2
    out[1, MOTION] = -deeper[1] / 2
    return by_pinhole, by_ray


def depth_derivative(by_motion: FloatArray) -> FloatArray:
    """Change (2, m) of the screen points by 1 mm of depth in all frames, from that by 1 mm from x
    to y.
    """
    return np.asarray(by_motion * np.array([[2.0], [-2.0]]))


@cache
def _sag_direction() -> FloatArray:
    """Change (parameters,) of the surface's parameters by 1 mm of sag; the vertex goes down by as
    much.
    """
    return Surface.hencky_bowl(1.0, 1.0).parameters
