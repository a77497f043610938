"""The forward model: where a surface on a bench sends each camera ray on the screen, and its
derivatives.

A ray P = F + t d meets the film at F_z + t d_z = z + h(x, y), with n = (-h_x, -h_y, 1) its normal
there; it leaves as u = d - 2 (d n) / (n n) n and meets the screen at S = P + k u. For small changes
of anything (chain rule):

    dP = G (dF + t dd) + d / (n d) (dz + dh)             G = 1 - d n^T / (n d)
    dn = -(dh_x, dh_y, 0) - H dP                         H = second derivatives of h, bordered by zeros
    du = (1 - 2 n n^T / (n n)) dd + B dn                 B = -2 / (n n) (n d^T + (d n) 1 - 2 (d n) / (n n) n n^T)
    ds = T (dP + k du - dO' + X^T dX (S - O')) + (E u) s^2 dc / (N u)

with X the screen's rows, E the first two, N = (third row) - w_x e_x - w_y e_y the normal of a face
that deviates by w = c s^2 + map (see `optics.geometry`) and T = E (1 - u N^T / (N u)), which lets
the ray run to the face.
"""  # noqa: E501

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.polynomial import polynomial as series

from membrane_ctrl.metrology.calibration.board_lens import lens_derivatives
from membrane_ctrl.metrology.film import film_law
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.metrology.rays import kernels
from membrane_ctrl.metrology.rays.bench_parameters import (
    OPTICAL,
    POSE,
    SCREEN_MOVE,
    BenchGeometry,
    Poses,
    screen_elsewhere,
)
from membrane_ctrl.metrology.rays.geometry import BOW_RADIUS_MM, Geometry
from membrane_ctrl.metrology.rays.surface import PARAMETERS, Artefact, SeenScreen, Surface
from membrane_ctrl.metrology.reconstruction.surface_fit import Points, Tracer, parabola
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_DEGREE

# of one set: its surface's parameters, the height of its vertex, its round terms beyond them, and
# by how much the film was deeper in the x frames than in the y frames
BEYOND = slice(PARAMETERS + 1, PARAMETERS + 1 + len(film_law.BEYOND))
MOTION = BEYOND.stop
LOCAL = MOTION + 1
COLUMNS = LOCAL + OPTICAL
MOVED = (
    SCREEN_MOVE + 2
)  # of a screen elsewhere: its move, by how much the film was deeper, and in x than in y
STILL_UM = 1e-3  # of a film that does not move
_CHUNK = 8192  # points whose derivatives are in memory at a time: 8 MB


@dataclass(frozen=True)
class Elsewhere:
    """What is known, besides the fringes, of the same film seen with the screen put elsewhere."""

    shift_mm: tuple[float, float, float]  # of the screen along s_x, s_y and towards the mirror
    shift_sigma_mm: float  # of its length
    turn_sigma_deg: float  # of its direction, and of the screen's turns
    deeper_um: float  # by how much the film was deeper then, by the laser
    motion_um: float  # in the x frames than in the y frames
    motion_sigma_um: float
    glass_sigma_mm: float = 0.0  # of a screen seen directly, in place of a film that is deeper

    def known(self, laser_sigma_um: float) -> FloatArray:
        """Values and sigmas (2, MOVED), in mm and degrees: the move, the film deeper, deeper in x
        than in y.
        """
        deeper_mm = 1e-3 * np.array([self.deeper_um, self.motion_um])
        told = np.concatenate([self.shift_mm, np.zeros(3), deeper_mm])
        deeper_sigma_mm = self.glass_sigma_mm or 1e-3 * np.sqrt(2) * laser_sigma_um
        film_mm = np.array([deeper_sigma_mm, 1e-3 * max(self.motion_sigma_um, STILL_UM)])
        # a rail is as parallel to the screen's normal as the screen is to itself after the move
        across_mm = np.sqrt(
            np.sum(np.square(self.shift_mm)) - np.square(self.shift_mm)
        ) * np.radians(self.turn_sigma_deg)
        shift_mm = np.hypot(self.shift_sigma_mm, across_mm)
        return np.stack(
            [told, np.concatenate([shift_mm, np.full(3, self.turn_sigma_deg), film_mm])]
        )


# of the screen seen directly: nothing is known of its place, and its pixels may lie behind some mm
# of glass
ANYWHERE = Elsewhere((0.0, 0.0, 0.0), 1e3, 1e2, 0.0, 0.0, 0.0, glass_sigma_mm=3.0)
_GLASS_INDEX = 1.52
_PER_POINT = ("column_px", "row_px", "screen_mm", "sigma_mm")  # the last axis: points


@dataclass(frozen=True)
class SetPhases:
    """One capture set as screen points of bins, and those of the same film with the screen put
    elsewhere.
    """

    name: str
    column_px: FloatArray  # (n,): centres of the bins
    row_px: FloatArray  # (n,)
    screen_mm: FloatArray  # (2, n): s_x, s_y seen there
    sigma_mm: FloatArray  # (n,): expected noise of each of the two
    displacement_um: float  # mean laser reading of the set; NaN without
    # by how much deeper the film was in the x frames than in the y frames, as told; a sigma of 0:
    # not at all
    motion_um: float = 0.0
    motion_sigma_um: float = 0.0
    # RMS motion of the film during the set; that from frame to frame of an axis is corrected
    moved_um: float = 0.0
    artefact: Artefact | SeenScreen | None = None  # what is seen instead of the film
    elsewhere: tuple[Elsewhere, ...] = ()
    # (n,): with which of them a point was seen, from 1; 0, or None, in its place
    screen: IntArray | None = None
    # of the fringes; 0: unknown, and nothing that repeats with them is taken out
    period_mm: float = 0.0

    def seen_with(self, screen: int) -> BoolArray:
        """Which points (n,) were seen with the screen in that place."""
        return np.full(self.sigma_mm.size, True) if self.screen is None else self.screen == screen

    def thinned(self, most: int) -> "SetPhases":
        """Every k-th bin, so that at most `most` are left."""
        return self.subset(slice(None, None, -(-self.column_px.size // most)))

    def subset(self, keep: slice | BoolArray) -> "SetPhases":
        """Some of the bins."""
        parts = {name: getattr(self, name)[..., keep] for name in _PER_POINT}
        return replace(self, **parts, screen=None if self.screen is None else self.screen[keep])

    def beside(self, again: "SetPhases", known: Elsewhere) -> "SetPhases":
        """The set with the points of the same film, seen again with the screen elsewhere."""
        before = np.zeros(self.sigma_mm.size, int) if self.screen is None else self.screen
        screen = np.append(before, np.full(again.sigma_mm.size, len(self.elsewhere) + 1))
        parts: Any = {
            name: np.concatenate([getattr(k, name) for k in (self, again)], -1)
            for name in _PER_POINT
        }
        return replace(self, **parts, elsewhere=(*self.elsewhere, known), screen=screen)


@dataclass(frozen=True)
class Chunk:
    """Residuals and derivatives of some points."""

    place: slice  # which points
    residual_mm: FloatArray  # (2, m): seen minus predicted
    # (2, COLUMNS + further poses, m), of the prediction by: the set's own unknowns, mm; the optical
    # parameters
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
    tracer.start(points, parabola(surface.sag_mm, surface.radius_mm))
    tracer.intersect(points, surface, newton=4)  # from some mm: 0.1 mm, 1 nm, 1e-16 mm
    return points


def residual_mm(
    bench: BenchGeometry,
    phases: SetPhases,
    surface: Surface,
    vertex_z_mm: float,
    elsewhere: Sequence[FloatArray] = (),
) -> FloatArray:
    """Seen minus predicted screen points (2, n); `elsewhere` are the
    moves (MOVED,) of the screen.
    """
    out = np.empty_like(phases.screen_mm)
    for _, there, _, some in views(bench, [], phases, elsewhere):
        part = phases.subset(some)
        shape = None if isinstance(phases.artefact, SeenScreen) else surface
        points = place_rays(there, part, surface, vertex_z_mm)
        met = [_meet(there, points, shape, part).screen_mm for part in _parts(points.t_mm.size)]
        out[:, some] = part.screen_mm - np.concatenate(met, axis=1) / bench.pitch
    return out


def views(
    bench: BenchGeometry, turns: list[Poses], phases: SetPhases, moves: Sequence[FloatArray]
) -> Iterator[tuple[int, BenchGeometry, list[Poses], BoolArray]]:
    """Each place of the screen: its number, the bench and its `turns` there, and which points (n,)
    were seen so.
    """
    if isinstance(phases.artefact, SeenScreen):
        # it stands somewhere before the camera: the bench's poses do not matter
        camera, (s_x, s_y, _) = bench.geometry, phases.artefact.axes @ bench.geometry.rotation
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


def chunks(
    bench: BenchGeometry,
    turns: list[Poses],
    phases: SetPhases,
    surface: Surface,
    vertex_z_mm: float,
    motion_mm: float = 0.0,
    deeper_mm: float = 0.0,
) -> Iterator[Chunk]:
    """Residuals with derivatives, some points at a time. `turns`: the `pose_derivatives`, and any
    further.
    """
    points = place_rays(bench, phases, surface, vertex_z_mm)
    shape = None if isinstance(phases.artefact, SeenScreen) else surface
    for part in _parts(points.t_mm.size):
        meet = _meet(bench, points, shape, part)
        lens = lens_derivatives(
            bench.geometry, phases.column_px[part], phases.row_px[part], meet.ray
        )
        derivatives = _derivatives(bench, turns, shape, meet, lens)
        # both are small enough to be linear
        by_motion = derivatives[:, MOTION]
        predicted = (
            meet.screen_mm / bench.pitch + motion_mm * by_motion + deeper_mm * deeper(by_motion)
        )
        yield Chunk(part, phases.screen_mm[:, part] - predicted, derivatives)


def _parts(count: int) -> Iterator[slice]:
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


def _meet(bench: BenchGeometry, points: Points, surface: Surface | None, part: slice) -> _Meeting:
    """Reflect the rays and follow them to the face, by Newton's steps from the plane unless it is
    one.
    """
    geometry, d = bench.geometry, points.rays[:, part]
    t = np.zeros(d.shape[1]) if surface is None else points.t_mm[part]
    place, n, u = geometry.pinhole_mm[:, None] + t * d, d, d
    if surface is not None:
        hx, hy = surface.slopes(place[0], place[1])
        n = np.stack([-hx, -hy, np.ones_like(hx)])
        u = d - 2 * np.sum(d * n, axis=0) / np.sum(n * n, axis=0) * n
    axes = geometry.screen_axes
    start, along = axes @ (place - geometry.screen_origin_mm[:, None]), axes @ u
    k = -start[2] / along[2]
    for _ in range(0 if geometry.face.is_plane else kernels.FACE_STEPS):
        at = start + k * along
        w, by_x, by_y = geometry.face.heights(at[:2])
        k = k - (at[2] - w) / (along[2] - by_x * along[0] - by_y * along[1])
    at = start + k * along
    _w, by_x, by_y = geometry.face.heights(at[:2])
    face = axes[2][:, None] - by_x * axes[0][:, None] - by_y * axes[1][:, None]
    return _Meeting(d, t, place, n, u, k, axes.T @ at, face, at[:2])


def _derivatives(
    bench: BenchGeometry, turns: list[Poses], surface: Surface | None, m: _Meeting, lens: FloatArray
) -> FloatArray:
    """(2, COLUMNS + further poses, m) by the formulas above, right to left: the effect of a change
    of P, u, n, d.
    """
    geometry, axes = bench.geometry, bench.geometry.screen_axes
    across, onto = axes[:2] @ m.leaves, np.sum(m.face * m.leaves, axis=0)  # E u, N u
    by_point = axes[:2, :, None] - across[:, None] * (m.face / onto)  # T
    out = np.zeros((2, COLUMNS + len(turns) - len(POSE), m.t_mm.size))
    by_pinhole, by_ray = by_point, by_point * m.reach_mm
    if surface is not None:
        by_pinhole, by_ray = _by_surface(surface, m, by_point, out)
    in_camera = geometry.rotation @ m.ray
    for j, turn in enumerate(turns):
        moved = axes.T @ (turn.screen @ m.from_origin) - turn.origin_mm[:, None]
        of_ray = turn.camera.T @ in_camera
        column = np.einsum("acm,c->am", by_pinhole, turn.pinhole_mm)
        column += np.einsum("acm,cm->am", by_ray, of_ray) + np.einsum("acm,cm->am", by_point, moved)
        out[:, LOCAL + j if j < len(POSE) else COLUMNS + j - len(POSE)] = column
    first = LOCAL + len(POSE)
    out[:, first : first + len(lens)] = np.einsum("acm,lcm->alm", by_ray, lens)
    square = m.screen_mm[0] ** 2 + m.screen_mm[1] ** 2
    out[:, COLUMNS - 2] = across * square / onto / BOW_RADIUS_MM**2
    if surface is None:  # by 1 mm of glass over the pixels, which bends rays that lean
        sine = across / np.linalg.norm(m.leaves, axis=0) / _GLASS_INDEX
        out[:, MOTION] = deeper(sine / np.sqrt(1 - np.sum(sine**2, axis=0))) / 4
    out /= bench.pitch
    out[:, COLUMNS - 1] = -m.screen_mm / bench.pitch**2
    return out


def _by_surface(
    surface: Surface, m: _Meeting, by_point: FloatArray, out: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Fill in the surface's own columns; returns the effect of a change of the pinhole and of the
    ray, (2, 3, m).
    """
    d, n, k = m.ray, m.normal, m.reach_mm
    nn, nd = np.sum(n * n, axis=0), np.sum(n * d, axis=0)
    ray = by_point * k  # T k, of u
    along = np.einsum("acm,cm->am", ray, n)
    by_normal = -2 / nn * (along[:, None] * d + nd * ray - 2 * nd / nn * along[:, None] * n)
    hxx, hxy, hyy = surface.curvatures(m.place[0], m.place[1])
    by_place = by_point.copy()
    by_place[:, 0] -= by_normal[:, 0] * hxx + by_normal[:, 1] * hxy
    by_place[:, 1] -= by_normal[:, 0] * hxy + by_normal[:, 1] * hyy
    by_height = np.einsum("acm,cm->am", by_place, d) / nd
    by_pinhole = by_place - by_height[:, None] * n  # by_place G
    by_ray = by_pinhole * m.t_mm + ray - 2 / nn * along[:, None] * n
    x, y, scale = (
        m.place[0] / surface.radius_mm,
        m.place[1] / surface.radius_mm,
        1 / surface.radius_mm,
    )
    height, height_x, height_y = (
        np.vstack(parts) for parts in zip(basis(x, y), round_basis(x, y), strict=True)
    )
    for axis in range(2):
        slope = (by_normal[axis, 0] * height_x + by_normal[axis, 1] * height_y) * scale
        by_terms = by_height[axis] * height - slope
        out[axis, :PARAMETERS], out[axis, BEYOND] = by_terms[:PARAMETERS], by_terms[PARAMETERS:]
    out[:, PARAMETERS] = by_height
    deeper = np.einsum("j,ajm->am", _deeper(), out[:, :PARAMETERS]) - by_height
    out[0, MOTION], out[1, MOTION] = deeper[0] / 2, -deeper[1] / 2
    return by_pinhole, by_ray


def deeper(by_motion: FloatArray) -> FloatArray:
    """Change (2, m) of the screen points by 1 mm of depth in all frames, from that by 1 mm from x
    to y.
    """
    return np.asarray(by_motion * np.array([[2.0], [-2.0]]))


@cache
def _deeper() -> FloatArray:
    """Change (parameters,) of the surface's parameters by 1 mm of sag; the vertex goes down by as
    much.
    """
    return Surface.hencky_bowl(1.0, 1.0).parameters


def basis(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Heights and slopes (parameters, n) of the surface's parameters in radii, each 0 at the
    vertex.
    """
    v = x * x + y * y
    excess = film_law.excess() / film_law.excess_rms()
    bowl = series.polyval(v, excess) - excess[0]
    grows = 2 * series.polyval(v, series.polyder(excess))
    powers, tables = _monomials(x, y), _tables()
    heights, slopes_x, slopes_y = (table @ powers for table in tables)
    heights -= zernike.at_vertex()[1:, None]
    return (
        np.vstack([heights, bowl]),
        np.vstack([slopes_x, grows * x]),
        np.vstack([slopes_y, grows * y]),
    )


def round_basis(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Heights and slopes (k, n) of the terms of `film_law.BEYOND` in radii,
    each 0 at the vertex.
    """
    v, terms = x * x + y * y, film_law.beyond()
    heights = [series.polyval(v, term) for term in terms]
    grows = np.array([2 * series.polyval(v, series.polyder(term)) for term in terms])
    return np.array(heights), grows * x, grows * y


def _monomials(x: FloatArray, y: FloatArray) -> FloatArray:
    """x^p y^q, p + q <= ZERNIKE_DEGREE, p outer, (terms, n)."""
    out, column = [], np.ones_like(x)
    for p in range(ZERNIKE_DEGREE + 1):
        term = column
        for _ in range(ZERNIKE_DEGREE + 1 - p):
            out.append(term)
            term = term * y
        column = column * x
    return np.stack(out)


@cache
def _tables() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Z_j, dZ_j/dx and dZ_j/dy, j = 2, 3, ..., as coefficients (terms - 1,
    terms) of `_monomials`.
    """
    p, q = np.array(
        [(p, q) for p in range(ZERNIKE_DEGREE + 1) for q in range(ZERNIKE_DEGREE + 1 - p)]
    ).T
    table = zernike.monomial_table()
    height, of_x, of_y = (
        t[1:, p, q] for t in (table, *(zernike.differentiate(table, axis) for axis in (1, 2)))
    )
    return np.ascontiguousarray(height), np.ascontiguousarray(of_x), np.ascontiguousarray(of_y)
