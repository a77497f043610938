"""The forward model: where a surface on a bench sends each camera ray on the screen, and its derivatives.

A ray P = F + t d meets the film at F_z + t d_z = z + h(x, y), with n = (-h_x, -h_y, 1) its normal there; it leaves as
u = d - 2 (d n) / (n n) n and meets the screen at S = P + k u. For small changes of anything (chain rule):

    dP = G (dF + t dd) + d / (n d) (dz + dh)             G = 1 - d n^T / (n d)
    dn = -(dh_x, dh_y, 0) - H dP                         H = second derivatives of h, bordered by zeros
    du = (1 - 2 n n^T / (n n)) dd + B dn                 B = -2 / (n n) (n d^T + (d n) 1 - 2 (d n) / (n n) n n^T)
    ds = T (dP + k du - dO' + X^T dX (S - O')) + (E u) s^2 dc / (N u)

with X the screen's rows, E the first two, N = (third row) - w_x e_x - w_y e_y the normal of a face that deviates by w
= c s^2 + map (see `optics.geometry`) and T = E (1 - u N^T / (N u)), which lets the ray run to the face.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.polynomial import polynomial as series

from membrane_ctrl.metrology.calibrate.parameters import OPTICAL, POSE, BenchGeometry, Poses
from membrane_ctrl.metrology.optics import compiled, film_law, kernels, zernike
from membrane_ctrl.metrology.optics.geometry import BOW_RADIUS_MM, Geometry
from membrane_ctrl.metrology.optics.surface import PARAMETERS, Artefact, Surface
from membrane_ctrl.metrology.reconstruct import Points, Tracer, parabola
from membrane_ctrl.model.arrays import BoolArray, FloatArray

# Small matrix products as plain loops.
#
# A linear algebra library has its own threads, which wait for each other on a machine shared with the control loop:
# products of 40 by 40 then take five times as long as these loops on one core.

_BLOCK = 512  # columns that stay in the second-level cache


@compiled.kernel
def gram(rows):  # type: ignore[no-untyped-def]
    """rows @ rows.T of a (c, n) array with many columns."""
    count, size = rows.shape
    out = np.zeros((count, count))
    for first in range(0, size, _BLOCK):
        last = min(first + _BLOCK, size)
        for i in range(count):
            for j in range(i + 1):
                total = 0.0
                for k in range(first, last):
                    total += rows[i, k] * rows[j, k]
                out[i, j] += total
    for i in range(count):
        for j in range(i):
            out[j, i] = out[i, j]
    return out


@compiled.kernel
def multiply(table, rows):  # type: ignore[no-untyped-def]
    """table @ rows of an (a, b) and a (b, n) array with many columns; zeros in the table cost nothing."""
    out = np.zeros((table.shape[0], rows.shape[1]))
    for i in range(table.shape[0]):
        for j in range(table.shape[1]):
            factor = table[i, j]
            if factor != 0.0:
                for k in range(rows.shape[1]):
                    out[i, k] += factor * rows[j, k]
    return out


# of one set: its surface's 36, the height of its vertex, its round terms beyond the 36, and by how much the film was
# deeper in the x frames than in the y frames
BEYOND = slice(PARAMETERS + 1, PARAMETERS + 1 + len(film_law.BEYOND))
MOTION = BEYOND.stop
LOCAL = MOTION + 1
COLUMNS = LOCAL + OPTICAL
_CHUNK = 8192  # points whose derivatives are in memory at a time: 8 MB


@dataclass(frozen=True)
class SetPhases:
    """One capture set as screen points of bins."""

    name: str
    column_px: FloatArray  # (n,): centres of the bins
    row_px: FloatArray  # (n,)
    screen_mm: FloatArray  # (2, n): s_x, s_y seen there
    sigma_mm: FloatArray  # (n,): expected noise of each of the two
    displacement_um: float  # mean laser reading of the set; NaN without
    # by how much deeper the film was in the x frames than in the y frames, as told; a sigma of 0: not at all
    motion_um: float = 0.0
    motion_sigma_um: float = 0.0
    moved_um: float = 0.0  # RMS motion of the film during the set; that from frame to frame of an axis is corrected
    artefact: Artefact | None = None  # what stands in the mirror's place; None: the film

    def thinned(self, most: int) -> "SetPhases":
        """Every k-th bin, so that at most `most` are left."""
        return self.subset(slice(None, None, -(-self.column_px.size // most)))

    def subset(self, keep: slice | BoolArray) -> "SetPhases":
        """Some of the bins."""
        return replace(
            self,
            column_px=self.column_px[keep],
            row_px=self.row_px[keep],
            screen_mm=self.screen_mm[:, keep],
            sigma_mm=self.sigma_mm[keep],
        )


@dataclass(frozen=True)
class Chunk:
    """Residuals and derivatives of some points."""

    place: slice  # which points
    residual_mm: FloatArray  # (2, m): seen minus predicted
    # (2, COLUMNS, m), of the prediction by: the set's own unknowns, mm; the optical parameters
    derivatives: FloatArray


def camera_rays(geometry: Geometry, phases: SetPhases) -> FloatArray:
    """Unit vectors (3, n) in world of a set's bins."""
    return geometry.rays(phases.column_px, phases.row_px)


def place_rays(bench: BenchGeometry, phases: SetPhases, surface: Surface, vertex_z_mm: float) -> Points:
    """The set's rays, followed to the surface."""
    points = Points.of(camera_rays(bench.geometry, phases), phases.screen_mm)
    tracer = Tracer(bench.geometry, surface.radius_mm, vertex_z_mm)
    tracer.start(points, parabola(surface.sag_mm, surface.radius_mm))
    tracer.intersect(points, surface, newton=4)  # from some mm: 0.1 mm, 1 nm, 1e-16 mm
    return points


def residual_mm(bench: BenchGeometry, phases: SetPhases, surface: Surface, vertex_z_mm: float) -> FloatArray:
    """Seen minus predicted screen points (2, n)."""
    points = place_rays(bench, phases, surface, vertex_z_mm)
    parts = [_meet(bench, points, surface, part).screen_mm for part in _parts(points.t_mm.size)]
    return phases.screen_mm - np.concatenate(parts, axis=1) / bench.pitch


def chunks(
    bench: BenchGeometry,
    turns: list[Poses],
    phases: SetPhases,
    surface: Surface,
    vertex_z_mm: float,
    motion_mm: float = 0.0,
) -> Iterator[Chunk]:
    """Residuals with derivatives, some points at a time. `turns` are the `pose_derivatives` there."""
    points = place_rays(bench, phases, surface, vertex_z_mm)
    for part in _parts(points.t_mm.size):
        meet = _meet(bench, points, surface, part)
        lens = lens_derivatives(bench.geometry, phases.column_px[part], phases.row_px[part], meet.ray)
        derivatives = _derivatives(bench, turns, surface, meet, lens)
        # it is small enough to be linear
        predicted = meet.screen_mm / bench.pitch + motion_mm * derivatives[:, MOTION]
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


def _meet(bench: BenchGeometry, points: Points, surface: Surface, part: slice) -> _Meeting:
    """Reflect the rays and follow them to the face, by Newton's steps from the plane unless it is one."""
    geometry, d, t = bench.geometry, points.rays[:, part], points.t_mm[part]
    place = geometry.pinhole_mm[:, None] + t * d
    hx, hy = slopes(surface, place[0], place[1])
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
    bench: BenchGeometry, turns: list[Poses], surface: Surface, m: _Meeting, lens: FloatArray
) -> FloatArray:
    """(2, COLUMNS, m) by the formulas above, right to left: the effect on s of a change of P, u, n, d."""
    geometry, d, n, u, k = bench.geometry, m.ray, m.normal, m.leaves, m.reach_mm
    axes = geometry.screen_axes
    across, onto = axes[:2] @ u, np.sum(m.face * u, axis=0)  # E u, N u
    by_point = axes[:2, :, None] - across[:, None] * (m.face / onto)  # T
    nn, nd = np.sum(n * n, axis=0), np.sum(n * d, axis=0)
    ray = by_point * k  # T k, of u
    along = np.einsum("acm,cm->am", ray, n)
    by_normal = -2 / nn * (along[:, None] * d + nd * ray - 2 * nd / nn * along[:, None] * n)
    hxx, hxy, hyy = curvatures(surface, m.place[0], m.place[1])
    by_place = by_point.copy()
    by_place[:, 0] -= by_normal[:, 0] * hxx + by_normal[:, 1] * hxy
    by_place[:, 1] -= by_normal[:, 0] * hxy + by_normal[:, 1] * hyy
    by_height = np.einsum("acm,cm->am", by_place, d) / nd
    by_pinhole = by_place - by_height[:, None] * n  # by_place G
    by_ray = by_pinhole * m.t_mm + ray - 2 / nn * along[:, None] * n
    out = np.empty((2, COLUMNS, d.shape[1]))
    x, y, scale = m.place[0] / surface.radius_mm, m.place[1] / surface.radius_mm, 1 / surface.radius_mm
    height, height_x, height_y = (np.vstack(parts) for parts in zip(basis(x, y), round_basis(x, y), strict=True))
    for axis in range(2):
        slope = (by_normal[axis, 0] * height_x + by_normal[axis, 1] * height_y) * scale
        by_terms = by_height[axis] * height - slope
        out[axis, :PARAMETERS], out[axis, BEYOND] = by_terms[:PARAMETERS], by_terms[PARAMETERS:]
    out[:, PARAMETERS] = by_height
    deeper = np.einsum("j,ajm->am", _deeper(), out[:, :PARAMETERS]) - by_height
    out[0, MOTION], out[1, MOTION] = deeper[0] / 2, -deeper[1] / 2
    in_camera = geometry.rotation @ d
    for j, turn in enumerate(turns):
        moved = axes.T @ (turn.screen @ m.from_origin) - turn.origin_mm[:, None]
        of_ray = turn.camera.T @ in_camera
        column = np.einsum("acm,c->am", by_pinhole, turn.pinhole_mm)
        column += np.einsum("acm,cm->am", by_ray, of_ray) + np.einsum("acm,cm->am", by_point, moved)
        out[:, LOCAL + j] = column
    first = LOCAL + len(POSE)
    out[:, first : first + len(lens)] = np.einsum("acm,lcm->alm", by_ray, lens)
    square = m.screen_mm[0] ** 2 + m.screen_mm[1] ** 2
    out[:, -2] = across * square / onto / BOW_RADIUS_MM**2
    out /= bench.pitch
    out[:, -1] = -m.screen_mm / bench.pitch**2
    return out


@cache
def _deeper() -> FloatArray:
    """Change (36,) of the surface's parameters by 1 mm of sag; the vertex goes down by as much."""
    return Surface.hencky_bowl(1.0, 1.0).parameters


def lens_derivatives(geometry: Geometry, column_px: FloatArray, row_px: FloatArray, rays: FloatArray) -> FloatArray:
    """d ray / d (relative focal length, principal point, k1, k2, p1, p2), (7, 3, m).

    A pixel fixes the distorted point q = ((c, r) - principal) / focal = f(p; k): dp = (df/dp)^-1 (dq - df/dk dk), and
    the unit vector c of (p, 1) turns by (1 - c c^T) (dp, 0) / |(p, 1)|. Coefficients beyond the first four, if the
    stated lens has any, count as constants of df/dp only to first order: they are left out there.
    """
    c = geometry.rotation @ rays
    x, y = c[0] / c[2], c[1] / c[2]
    k1, k2, p1, p2 = (*geometry.distortion, 0.0, 0.0, 0.0, 0.0)[:4]
    r2 = x * x + y * y
    radial, grows = 1 + k1 * r2 + k2 * r2**2, 2 * (k1 + 2 * k2 * r2)
    fxx = radial + grows * x * x + 2 * p1 * y + 6 * p2 * x
    fxy = grows * x * y + 2 * p1 * x + 2 * p2 * y
    fyy = radial + grows * y * y + 6 * p1 * y + 2 * p2 * x
    qx = (column_px - geometry.principal_px[0]) / geometry.focal_px
    qy = (row_px - geometry.principal_px[1]) / geometry.focal_px
    zero, step = np.zeros_like(x), np.full_like(x, -1 / geometry.focal_px)
    of_x = np.stack([-qx, step, zero, -x * r2, -x * r2**2, -2 * x * y, -(r2 + 2 * x * x)])
    of_y = np.stack([-qy, zero, step, -y * r2, -y * r2**2, -(r2 + 2 * y * y), -2 * x * y])
    det = fxx * fyy - fxy**2
    px, py = (fyy * of_x - fxy * of_y) / det, (fxx * of_y - fxy * of_x) / det
    moved = np.stack([px, py, np.zeros_like(px)], axis=1) * c[2]
    turned = moved - np.sum(moved * c, axis=1, keepdims=True) * c
    return np.asarray(np.einsum("ij,lim->ljm", geometry.rotation, turned))


def basis(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Heights and slopes (36, n) of the surface's parameters in radii, each 0 at the vertex."""
    v = x * x + y * y
    excess = film_law.excess() / film_law.excess_rms()
    bowl = series.polyval(v, excess) - excess[0]
    grows = 2 * series.polyval(v, series.polyder(excess))
    powers, tables = _monomials(x, y), _tables()
    heights = multiply(tables[0], powers) - zernike.at_vertex()[1:, None]
    slopes_x, slopes_y = multiply(tables[1], powers), multiply(tables[2], powers)
    return np.vstack([heights, bowl]), np.vstack([slopes_x, grows * x]), np.vstack([slopes_y, grows * y])


def round_basis(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Heights and slopes (k, n) of the terms of `film_law.BEYOND` in radii, each 0 at the vertex."""
    v, terms = x * x + y * y, film_law.beyond()
    heights = [series.polyval(v, term) for term in terms]
    grows = np.array([2 * series.polyval(v, series.polyder(term)) for term in terms])
    return np.array(heights), grows * x, grows * y


def _monomials(x: FloatArray, y: FloatArray) -> FloatArray:
    """x^p y^q, p + q <= 7, p outer, (36, n)."""
    out, column = [], np.ones_like(x)
    for p in range(zernike.DEGREE + 1):
        term = column
        for _ in range(zernike.DEGREE + 1 - p):
            out.append(term)
            term = term * y
        column = column * x
    return np.stack(out)


@cache
def _tables() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Z_j, dZ_j/dx and dZ_j/dy, j = 2..36, as coefficients (35, 36) of `_monomials`."""
    p, q = np.array([(p, q) for p in range(zernike.DEGREE + 1) for q in range(zernike.DEGREE + 1 - p)]).T
    table = zernike.monomial_table()
    height, of_x, of_y = (t[1:, p, q] for t in (table, *(zernike.differentiate(table, axis) for axis in (1, 2))))
    return np.ascontiguousarray(height), np.ascontiguousarray(of_x), np.ascontiguousarray(of_y)


def slopes(surface: Surface, x_mm: FloatArray, y_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """dh/dx and dh/dy."""
    x, y = x_mm / surface.radius_mm, y_mm / surface.radius_mm
    grows = 2 * series.polyval(x * x + y * y, series.polyder(surface.excess))
    of_x, of_y = (series.polyval2d(x, y, series.polyder(surface.polynomial, axis=axis)) for axis in (0, 1))
    return (of_x + grows * x) / surface.radius_mm, (of_y + grows * y) / surface.radius_mm


def curvatures(surface: Surface, x_mm: FloatArray, y_mm: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """h_xx, h_xy and h_yy in 1/mm."""
    x, y = x_mm / surface.radius_mm, y_mm / surface.radius_mm
    v = x * x + y * y
    first = 2 * series.polyval(v, series.polyder(surface.excess))
    second = 4 * series.polyval(v, series.polyder(surface.excess, 2))
    by_x, by_y = (series.polyder(surface.polynomial, axis=axis) for axis in (0, 1))
    hxx = series.polyval2d(x, y, series.polyder(by_x, axis=0)) + first + second * x * x
    hxy = series.polyval2d(x, y, series.polyder(by_x, axis=1)) + second * x * y
    hyy = series.polyval2d(x, y, series.polyder(by_y, axis=1)) + first + second * y * y
    return hxx / surface.radius_mm**2, hxy / surface.radius_mm**2, hyy / surface.radius_mm**2
