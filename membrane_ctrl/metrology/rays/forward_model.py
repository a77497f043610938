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
    displace_screen,
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
    """Return the directions in which the camera sees a set's bins.

    Parameters
    ----------
    geometry : Geometry
    phases : SetPhases

    Returns
    -------
    (3, n) array
        Unit vectors in world.
    """
    return geometry.rays(phases.column_px, phases.row_px)


def place_rays(
    bench: BenchGeometry, phases: SetPhases, surface: Surface, vertex_z_mm: float
) -> Points:
    """Follow the rays of a set to the surface.

    Parameters
    ----------
    bench : BenchGeometry
        The bench.
    phases : SetPhases
        The set, with n bins.
    surface : Surface
        The film, or the artefact.
    vertex_z_mm : float
        Height of its vertex in world.

    Returns
    -------
    Points
        n rays, with their lengths to the surface.
    """
    points = Points.from_rays(camera_rays(bench.geometry, phases), phases.screen_mm)
    tracer = Tracer(bench.geometry, surface.radius_mm, vertex_z_mm)
    tracer.place_on_shape(points, make_parabola(surface.sag_mm, surface.radius_mm))
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
    moved_screens: Sequence[FloatArray] = (),
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
    moved_screens : sequence of (MOVED,) arrays
        Moves of the screen, one for each further place of it.

    Returns
    -------
    (2, n) array
        In mm.
    """
    bench = _bench_before(bench, phases)
    out = np.empty_like(phases.screen_mm)
    for _, there, _, some in screen_views(bench, [], phases, moved_screens):
        # The points that were seen with the screen in this place, and their rays.
        seen = phases.subset(some)
        shape = _reflecting_surface(phases, surface)
        points = place_rays(there, seen, surface, vertex_z_mm)

        # Where the rays meet the screen, from mm on the panel to stated mm.
        met_mm = [
            _intersect_screen(there, points, shape, part).screen_mm
            for part in _split_points(points.t_mm.size)
        ]
        out[:, some] = seen.screen_mm - np.concatenate(met_mm, axis=1) / bench.pitch
    return out


def screen_views(
    bench: BenchGeometry, turns: list[Poses], phases: SetPhases, moves: Sequence[FloatArray]
) -> Iterator[tuple[int, BenchGeometry, list[Poses], BoolArray]]:
    """Go through the places of the screen in a set.

    Parameters
    ----------
    bench : BenchGeometry
    turns : list of Poses
        Derivatives of its poses.
    phases : SetPhases
        The set of n bins.
    moves : sequence of (MOVED,) arrays
        Moves of the screen, one for each further place of it.

    Yields
    ------
    place : int
        0: where the bench has the screen; k: after move k - 1.
    bench : BenchGeometry
        With the screen there.
    turns : list of Poses
        Derivatives there; of a moved screen also those by the six numbers of the move.
    seen : (n,) bool array
        The points seen with the screen there.
    """
    if isinstance(phases.artefact, SeenScreen):
        # The screen is somewhere in front of the camera: the bench's poses do not matter.
        camera = bench.geometry
        s_x, s_y, _ = phases.artefact.axes @ camera.rotation
        origin_mm = camera.pinhole_mm + camera.rotation.T @ phases.artefact.origin_mm
        there = replace(camera, screen_origin_mm=origin_mm, screen_s_x=s_x, screen_s_y=s_y)
        at_rest = Poses(np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3)))
        before_move = replace(bench, geometry=there)
        moved = displace_screen(before_move, [at_rest] * len(turns), moves[0][:SCREEN_MOVE])
        yield 1, *moved, phases.select_screen(0)
        return
    yield 0, bench, turns, phases.select_screen(0)
    for k, move in enumerate(moves, start=1):
        yield k, *displace_screen(bench, turns, move[:SCREEN_MOVE]), phases.select_screen(k)


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
    bench = _bench_before(bench, phases)
    points = place_rays(bench, phases, surface, vertex_z_mm)
    shape = _reflecting_surface(phases, surface)
    for part in _split_points(points.t_mm.size):
        meeting = _intersect_screen(bench, points, shape, part)
        column_px = phases.column_px[part]
        row_px = phases.row_px[part]
        by_lens = lens_derivatives(bench.geometry, column_px, row_px, meeting.ray)
        derivatives = _compute_derivatives(bench, turns, shape, meeting, by_lens)

        # Motion and depth are small enough to be linear.
        by_motion = derivatives[:, MOTION]
        by_depth = depth_derivative(by_motion)
        at_rest_mm = meeting.screen_mm / bench.pitch
        predicted_mm = at_rest_mm + motion_mm * by_motion + deeper_mm * by_depth
        yield Chunk(part, phases.screen_mm[:, part] - predicted_mm, derivatives)


def _bench_before(bench: BenchGeometry, phases: SetPhases) -> BenchGeometry:
    """The bench of a set: an artefact in the mirror's place has no front film."""
    if phases.artefact is None:
        return bench
    return replace(bench, geometry=bench.geometry.without_front_film())


def _reflecting_surface(phases: SetPhases, surface: Surface) -> Surface | None:
    """The surface that reflects the rays of a set; None if the camera sees the screen itself."""
    if isinstance(phases.artefact, SeenScreen):
        return None
    return surface


def _split_points(count: int) -> Iterator[slice]:
    return (slice(first, min(first + _CHUNK, count)) for first in range(0, count, _CHUNK))


@dataclass(frozen=True)
class _Meeting:
    """Points where rays meet film and screen, in the symbols of the module's text.

    Attributes
    ----------
    ray : (3, m) array
        Unit vectors d.
    t_mm : (m,) array
        Length t of the ray to the film; 0 without a film.
    film_point : (3, m) array
        P, in world.
    normal : (3, m) array
        n of the film, with n_z = 1.
    reflected : (3, m) array
        Unit vectors u.
    reach_mm : (m,) array
        Length k from the film to the screen.
    from_origin : (3, m) array
        S - O', in world.
    face_normal : (3, m) array
        N of the screen's face, of length 1 along the plane's normal.
    screen_mm : (2, m) array
        s_x and s_y of S.
    """

    ray: FloatArray
    t_mm: FloatArray
    film_point: FloatArray
    normal: FloatArray
    reflected: FloatArray
    reach_mm: FloatArray
    from_origin: FloatArray
    face_normal: FloatArray
    screen_mm: FloatArray


def _intersect_screen(
    bench: BenchGeometry, points: Points, surface: Surface | None, part: slice
) -> _Meeting:
    """Reflect the rays of some points at the film, and follow them to the face of the screen.

    Without a surface the rays reach the screen directly.
    """
    geometry = bench.geometry
    d = points.rays[:, part]
    if surface is None:
        t = np.zeros(d.shape[1])
        film_point = geometry.pinhole_mm[:, None] + t * d
        n = d
        u = d
    else:
        # P = F + t d, and u = d - 2 (d n) / (n n) n.
        t = points.t_mm[part]
        film_point = geometry.pinhole_mm[:, None] + t * d
        hx, hy = surface.slopes(film_point[0], film_point[1])
        n = np.stack([-hx, -hy, np.ones_like(hx)])
        turn = 2 * np.sum(d * n, axis=0) / np.sum(n * n, axis=0)
        u = d - turn * n

    # P and u along the screen's axes s_x, s_y and normal. The ray meets the plane at k = -P / u.
    axes = geometry.screen_axes
    start = axes @ (film_point - geometry.screen_origin_mm[:, None])
    along = axes @ u
    k = -start[2] / along[2]

    # From there to a face that is no plane, by Newton's steps on (P + k u)_normal = w.
    steps = 0
    if not geometry.face.is_plane:
        steps = kernels.FACE_STEPS
    for _ in range(steps):
        place = start + k * along
        w, by_x, by_y = geometry.face.heights(place[:2])
        approach = along[2] - by_x * along[0] - by_y * along[1]
        k = k - (place[2] - w) / approach

    # S, and the normal N = normal - w_x s_x - w_y s_y there.
    screen_point = start + k * along
    _w, by_x, by_y = geometry.face.heights(screen_point[:2])
    screen_mm = screen_point[:2]
    if surface is not None and geometry.gas_lens is not None:
        x_mm, y_mm, _z_mm = film_point
        screen_mm = screen_mm + geometry.gas_lens.find_shift_mm(x_mm, y_mm, surface.sag_mm)
    s_x, s_y, plane_normal = axes
    face_normal = plane_normal[:, None] - by_x * s_x[:, None] - by_y * s_y[:, None]
    return _Meeting(
        ray=d,
        t_mm=t,
        film_point=film_point,
        normal=n,
        reflected=u,
        reach_mm=k,
        from_origin=axes.T @ screen_point,
        face_normal=face_normal,
        screen_mm=screen_mm,
    )


def _compute_derivatives(
    bench: BenchGeometry,
    turns: list[Poses],
    surface: Surface | None,
    meeting: _Meeting,
    by_lens: FloatArray,
) -> FloatArray:
    """Derivatives of the screen points, by the chain rule of the module's text from right to left.

    First the effect of a change of each intermediate vector (S, u, n, P, d) on the screen point,
    then that of each parameter, which changes some of these vectors.

    Parameters
    ----------
    bench : BenchGeometry
    turns : list of Poses
        Derivatives of the poses by their parameters, and by any further ones.
    surface : Surface or None
        The film; None without one.
    meeting : _Meeting
        m points where rays meet film and screen.
    by_lens : (7, 3, m) array
        Derivatives of the rays by the parameters of the lens.

    Returns
    -------
    (2, COLUMNS + further poses, m) array
        In stated mm of the screen, by the unit of each parameter.
    """
    geometry = bench.geometry
    axes = geometry.screen_axes
    out = np.zeros((2, COLUMNS + len(turns) - len(POSE), meeting.t_mm.size))

    # T = E (1 - u N^T / (N u)): a change of the screen point, as the ray runs on to the face.
    along_axes = axes[:2] @ meeting.reflected  # E u
    onto_face = np.sum(meeting.face_normal * meeting.reflected, axis=0)  # N u
    by_point = axes[:2, :, None] - along_axes[:, None] * (meeting.face_normal / onto_face)

    # The surface's own columns, and the effect of the pinhole and of the ray (equations 1 to 3).
    if surface is None:
        by_pinhole = by_point
        by_ray = by_point * meeting.reach_mm
    else:
        by_pinhole, by_ray = _fill_surface_columns(surface, meeting, by_point, out)

    # Poses of camera and screen (equation 4): each moves the pinhole, turns the ray, and moves the
    # face under the screen point.
    in_camera = geometry.rotation @ meeting.ray
    for j, turn in enumerate(turns):
        ray_change = turn.camera.T @ in_camera
        face_change = axes.T @ (turn.screen @ meeting.from_origin) - turn.origin_mm[:, None]
        column = np.einsum("acm,c->am", by_pinhole, turn.pinhole_mm)
        column += np.einsum("acm,cm->am", by_ray, ray_change) + np.einsum(
            "acm,cm->am", by_point, face_change
        )
        if j < len(POSE):
            place = LOCAL + j
        else:
            place = COLUMNS + j - len(POSE)
        out[:, place] = column

    # The lens turns the ray.
    first = LOCAL + len(POSE)
    out[:, first : first + len(by_lens)] = np.einsum("acm,lcm->alm", by_ray, by_lens)

    # A bow of the screen moves the face by s^2 dc along its normal: (E u) s^2 dc / (N u).
    square = meeting.screen_mm[0] ** 2 + meeting.screen_mm[1] ** 2
    out[:, COLUMNS - 2] = along_axes * square / onto_face / BOW_RADIUS_MM**2

    # Without a film the column of motion is that of 1 mm of glass over the pixels, which bends
    # oblique rays (Snell): tangent of the angle inside the glass.
    if surface is None:
        sine = along_axes / np.linalg.norm(meeting.reflected, axis=0) / _GLASS_INDEX
        tangent = sine / np.sqrt(1 - np.sum(sine**2, axis=0))
        out[:, MOTION] = depth_derivative(tangent) / 4

    # From mm on the panel to stated mm, and the scale itself.
    out /= bench.pitch
    out[:, COLUMNS - 1] = -meeting.screen_mm / bench.pitch**2
    return out


def _fill_surface_columns(
    surface: Surface, meeting: _Meeting, by_point: FloatArray, out: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Fill in the columns of the surface's own unknowns.

    Parameters
    ----------
    surface : Surface
        The film.
    meeting : _Meeting
        m points on it.
    by_point : (2, 3, m) array
        T: change of the screen point by a change of S.
    out : (2, columns, m) array
        Derivatives; the first `LOCAL` columns are filled in.

    Returns
    -------
    by_pinhole, by_ray : (2, 3, m) arrays
        Change of the screen point by a change of F and of d.
    """
    d = meeting.ray
    n = meeting.normal
    n_n = np.sum(n * n, axis=0)
    n_d = np.sum(n * d, axis=0)

    # By the reflected ray u: T k. By the normal n: T k B (equation 3).
    by_reflected = by_point * meeting.reach_mm
    along_normal = np.einsum("acm,cm->am", by_reflected, n)[:, None]
    by_normal = (
        -2 / n_n * (along_normal * d + n_d * by_reflected - 2 * n_d / n_n * along_normal * n)
    )

    # By the point P on the film, where the normal turns with the curvatures: T - T k B H
    # (equation 2).
    hxx, hxy, hyy = surface.curvatures(meeting.film_point[0], meeting.film_point[1])
    by_film_point = by_point.copy()
    by_film_point[:, 0] -= by_normal[:, 0] * hxx + by_normal[:, 1] * hxy
    by_film_point[:, 1] -= by_normal[:, 0] * hxy + by_normal[:, 1] * hyy

    # By the film's height: P moves by d / (n d). By the pinhole: P moves by G = 1 - d n^T / (n d).
    # By the ray d: P moves by t G, and u turns (equations 1 and 3).
    by_height = np.einsum("acm,cm->am", by_film_point, d) / n_d
    by_pinhole = by_film_point - by_height[:, None] * n
    by_ray = by_pinhole * meeting.t_mm + by_reflected - 2 / n_n * along_normal * n

    # By the parameters: each changes height and slopes by those of its term.
    x = meeting.film_point[0] / surface.radius_mm
    y = meeting.film_point[1] / surface.radius_mm
    bases = zip(evaluate_basis(x, y), evaluate_beyond_basis(x, y), strict=True)
    height, height_x, height_y = (np.vstack(parts) for parts in bases)
    per_mm = 1 / surface.radius_mm
    for axis in range(2):
        by_slopes = by_normal[axis, 0] * height_x + by_normal[axis, 1] * height_y
        by_terms = by_height[axis] * height - by_slopes * per_mm
        out[axis, :PARAMETERS] = by_terms[:PARAMETERS]
        out[axis, BEYOND] = by_terms[PARAMETERS:]
    out[:, PARAMETERS] = by_height

    # By the film's motion from the x frames to the y frames: half of it to each side.
    by_sag = np.einsum("j,ajm->am", _sag_direction(), out[:, :PARAMETERS]) - by_height
    out[0, MOTION] = by_sag[0] / 2
    out[1, MOTION] = -by_sag[1] / 2
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
