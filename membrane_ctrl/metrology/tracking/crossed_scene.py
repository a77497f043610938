"""What a frame of crossed fringes must show: phases predicted from the surface, light predicted
from the reference.

A bin shows I = A + B_x cos(phi_x + d_x) + B_y cos(phi_y + d_y) + harmonics. Its phases are those of
the screen points that the surface sends its ray to, traced exactly, plus what the reference saw
beyond its own fit: averaging over the bin, and shape that the terms cannot represent. Light and
response of the panel are the reference's.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.figure import pixel_figure
from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.metrology.numerics.compiled import kernel
from membrane_ctrl.metrology.numerics.fast_cosine import cos_sin
from membrane_ctrl.metrology.phase import screen_scale
from membrane_ctrl.metrology.rays import ray_tracing
from membrane_ctrl.metrology.rays.surface import PARAMETERS, Surface
from membrane_ctrl.metrology.reconstruction import bin_grid
from membrane_ctrl.metrology.tracking.bin_cells import (
    BLOCK_BINS,
    BLOCK_CELLS,
    CELL_BINS,
    Cells,
    combine,
    moments,
    project,
    spread,
)
from membrane_ctrl.model.arrays import FloatArray, IntArray, Singles

# A bin averages the fringes: at this phase across it (95 % of the bins have less) they lose a tenth
# of their swing.
_BIN_RAD = 1.6
_PIXEL_RAD = 2.5  # across a pixel: more is hardly sampled
_BINS_PX = (16, 8, 4, 2, 1)
_AT = (
    0,
    PARAMETERS,
    2 * PARAMETERS,
    2 * PARAMETERS,
    2 * PARAMETERS,
)  # in `Cells.blocks`: x, y, then the maps' terms
_ENOUGH_BINS = 280 * PARAMETERS  # fewer cannot carry the surface and three maps of as many terms
_STEP_MM = 0.01  # of a parameter, for the derivatives: their error is 1e-7 of them
_HARMONIC = 2e-3  # a panel that deviates less from a straight line is straight
_RESPONSE_POWERS = (2, 3, 4, 5)
# Across the mirror. Light is judged in squares of a twelfth of its diameter: with eight fringes,
# squares of a dark part looked covered, and the error bars came out three times too small.
_LEAST_FRINGES = 9
# Light that wanders is orthogonal to shape over whole fringes; where bins end, parts of fringes are
# left, which cost ten times the error. Weights that fade over this much of a fringe cost 9 % of
# noise.
_FADES = 0.8
_USUAL = 0.75  # quantile of the changes of phase, half of which are across the fringes
# Share of the reach within which weights are 1. Where they fall from the start, as Tukey's do, they
# differ between bright and dark fringes as soon as light wanders, and bend the figure: 20 nm of sag
# at 0.5 %.
_TRUSTED = np.float32(0.6)
_RIPPLES = 8  # harmonics of the reference's fringes in the mean of its steps


@dataclass(frozen=True)
class CrossedScene:
    """The bench as a frame of crossed fringes sees it; n bins inside the analysis radius, cell by
    cell.
    """

    tracer: ray_tracing.Tracer  # the bench with the vertex of the reference
    surface: Surface  # of the reference
    bin_px: int
    index: IntArray  # (n,): bins, counted row by row
    row: IntArray  # (n,): of the picture, that each is in
    cells: Cells
    points: ray_tracing.Points  # their rays; `t_mm` moves with the surface that was traced last
    beyond_mm: FloatArray  # (2, n): screen points of the reference less the traced ones
    light_adu: FloatArray  # (3, n): mean level and swings of x and y
    basis: Singles  # (terms, n): Noll's order at the bins, for what changes smoothly
    taper: Singles  # (n,): weight, which fades to 0 where the bins end
    edge: Singles  # (n,): the same, 0 for bins that changed between the last five steps
    position_mm: FloatArray  # (2, n): on the mirror
    # (4,): deviation of the panel's response from a straight line, sum c_k (v^k - v), k = 2..5;
    # zeros if straight
    response: FloatArray
    rad_per_mm: float
    half_side_mm: float  # of the pattern

    def phase_rad(self, shape: Surface) -> FloatArray:
        """Phases (2, n) of x and y that a surface shows, counted from the low edge's -pi.

        The ring does not move: a deeper bowl has its vertex lower.
        """
        lower_mm = shape.sag_mm - self.surface.sag_mm
        bench = ray_tracing.Tracer(
            self.tracer.geometry, shape.radius_mm, self.tracer.vertex_z_mm - lower_mm
        )
        bench.intersect(self.points, shape, newton=2)
        seen = bench.predict_screen(self.points, shape) + self.beyond_mm
        return (seen + self.half_side_mm) * self.rad_per_mm - math.pi

    def jacobian(self, shape: Surface) -> Singles:
        """Change (2, parameters, n) of the phases per mm of each parameter of the surface."""
        out = np.empty((2, PARAMETERS, self.index.size), np.float32)
        for k, change_mm in enumerate(np.eye(PARAMETERS) * _STEP_MM):
            above, below = (
                self.phase_rad(
                    Surface.from_parameters(shape.parameters + sign * change_mm, shape.radius_mm)
                )
                for sign in (1, -1)
            )
            out[:, k] = (above - below) / (2 * _STEP_MM)
        return out

    def harmonics_adu(self, phase_rad: FloatArray) -> FloatArray:
        """Light (n,) at phases (2, n) beyond level and swings, by the panel's response."""
        v = 0.5 + 0.25 * np.cos(phase_rad).sum(axis=0)
        bent = self.response @ np.stack([v**k - v for k in _RESPONSE_POWERS])
        return np.asarray(2 * self.light_adu[1:].sum(axis=0) * bent)


@kernel
def _light(rows, base, light, response, begin):  # type: ignore[no-untyped-def]
    """Derivatives of the light of a block's bins, as in `light_waves`, in place of the changes of
    phases and maps.
    """
    one, two, half = np.float32(1), np.float32(2), np.float32(0.5)
    for k in range(BLOCK_BINS):
        p = begin + k
        cx, sx = cos_sin(base[0, p] + rows[k])
        cy, sy = cos_sin(base[1, p] + rows[BLOCK_BINS + k])
        level = light[0, p] * rows[2 * BLOCK_BINS + k]
        swing_x, swing_y = (
            light[1, p] * rows[3 * BLOCK_BINS + k],
            light[2, p] * rows[4 * BLOCK_BINS + k],
        )
        shade = half + half * half * (cx + cy)
        power, slope, bent = shade, np.float32(0), np.float32(0)
        for j in range(4):
            slope += response[j] * (np.float32(j + 2) * power - one)
            power *= shade
            bent += response[j] * (power - shade)
        cx, cy, steeper = cx + two * bent, cy + two * bent, half * (swing_x + swing_y) * slope
        rows[k] = -(swing_x + steeper) * sx
        rows[BLOCK_BINS + k] = -(swing_y + steeper) * sy
        rows[2 * BLOCK_BINS + k] = light[0, p]
        rows[3 * BLOCK_BINS + k] = light[1, p] * cx
        rows[4 * BLOCK_BINS + k] = light[2, p] * cy
        rows[5 * BLOCK_BINS + k] = level + swing_x * cx + swing_y * cy


@kernel
def _weigh(rows, edge, gain, seen, reach, begin):  # type: ignore[no-untyped-def]
    """Turn what `_light` leaves into e w r times the derivatives (5 rows), then `out` of
    `light_left` (4 rows).
    """
    zero, one = np.float32(0), np.float32(1)
    for k in range(BLOCK_BINS):
        p = begin + k
        shown = rows[5 * BLOCK_BINS + k]
        r = seen[p] - gain[p] * shown
        far = max(abs(r) / reach[p] - _TRUSTED, zero) / (one - _TRUSTED) if reach[p] > zero else one
        w = (one - min(far, one) ** 2) ** 2
        left = w * r * edge[p] * gain[p]
        for j in range(5):
            rows[j * BLOCK_BINS + k] *= left
        rows[5 * BLOCK_BINS + k] = r
        rows[6 * BLOCK_BINS + k] = w
        rows[7 * BLOCK_BINS + k] = left * shown
        rows[8 * BLOCK_BINS + k] = w * edge[p] * shown * shown


@kernel
def _block(b, base, light, slow, offset, response, changes, shifts, planes, rows):  # type: ignore[no-untyped-def]
    """`_light` of block b."""
    squares = rows.reshape(-1, CELL_BINS, BLOCK_CELLS)
    for k in range(5):
        at, factors = _AT[k], changes[max(k - 1, 0)]
        combine(
            slow[b, at : at + factors.size], factors, shifts[k] if k < 2 else np.float32(1), planes
        )
        spread(planes, offset[b], squares[k])
    _light(rows, base, light, response, b * BLOCK_BINS)


@kernel
def light_waves(base, light, slow, offset, response, changes, shifts, out):  # type: ignore[no-untyped-def]
    """Derivatives (6, n) of the light of n bins by phi_x, phi_y and relative changes of A, B_x, B_y
    and of all.

    Arguments as in `light_left`.
    """
    rows, planes = np.empty(6 * BLOCK_BINS, np.float32), np.empty(3 * BLOCK_CELLS, np.float32)
    for b in range(offset.shape[0]):
        _block(b, base, light, slow, offset, response, changes, shifts, planes, rows)
        out[:, b * BLOCK_BINS : (b + 1) * BLOCK_BINS] = rows.reshape(6, BLOCK_BINS)


@kernel
def light_left(  # type: ignore[no-untyped-def]
    base, light, slow, offset, response, changes, shifts, edge, gain, seen, reach, right, out
):
    """Residual r and weight w of n bins in `out` (4, n), with e w r times the derivative by a
    relative change of all light and e w times its square; and in `right` (4, parameters) the sums
    of e w r times the derivatives by `changes`.

    `base` (2, n) are phases and `light` (3, n) A, B_x, B_y. They change by `shifts` (2,) and by
    `changes` (4, parameters), of the surface's parameters and of the maps of A, B_x, B_y, times
    `slow`, as in `Cells.blocks`; `offset` as in `Cells`. `edge` (n,) is e, `gain` (n,) multiplies
    all light, `reach` (n,) is where w ends; 0 leaves out. All but `right` are of single precision
    and without gaps, or no vector units are used.
    """
    rows, planes = np.empty(9 * BLOCK_BINS, np.float32), np.empty(3 * BLOCK_CELLS, np.float32)
    squares = rows.reshape(-1, CELL_BINS, BLOCK_CELLS)
    right[:] = 0
    for b in range(offset.shape[0]):
        _block(b, base, light, slow, offset, response, changes, shifts, planes, rows)
        _weigh(rows, edge, gain, seen, reach, b * BLOCK_BINS)
        out[:, b * BLOCK_BINS : (b + 1) * BLOCK_BINS] = rows.reshape(9, BLOCK_BINS)[5:]
        for k in range(5):
            at, sums = _AT[k], right[max(k - 1, 0)]
            moments(squares[k], offset[b], planes)
            project(slow[b, at : at + sums.size], planes, sums)


def scene_of(
    optics: OpticsConfig,
    checked: Checked,
    figure: pixel_figure.BinFigure,
    period_mm: float,
    contrast: float = 1.0,
) -> CrossedScene:
    """The scene of a reference set for a crossed pattern on the same region.

    Parameters
    ----------
    optics : OpticsConfig
        Of the reference.
    checked, figure : Checked, BinFigure
        The reference, and the surface through its bins.
    period_mm : float
        Of the crossed fringes.
    contrast : float
        Of the pattern, c in docs/reference/interfaces.md.

    Raises ValueError if the camera cannot resolve such fringes, or the mirror shows too few.
    """
    camera, fine_px = optics.camera, checked.binned.bin_px
    tracer, shape = checked.tracer, figure.fit.surface
    rad_per_mm = 2 * math.pi / period_mm
    traced = tracer.predict_screen(figure.points, shape)
    fringes = float(np.ptp(traced, axis=1).min()) / period_mm
    if fringes < _LEAST_FRINGES:
        seen = f"only {fringes:.0f} fringes across the mirror"
        raise ValueError(
            f"{seen}, {_LEAST_FRINGES} at least tell light from shape: use a shorter period"
        )
    bin_px = _bin_px(checked, figure, traced * rad_per_mm)
    response, level_range = _response(
        checked, figure, traced, screen_scale.mm_per_rad(optics.pattern), optics
    )
    fine = _pictures(
        checked, figure, traced, screen_scale.mm_per_rad(optics.pattern), level_range, contrast
    )
    coarse = _coarser(fine, bin_px // fine_px)
    rows, columns = camera.height_px // bin_px, camera.width_px // bin_px
    coarse = coarse[:, :rows, :columns].reshape(5, -1)
    known = np.isfinite(coarse).all(axis=0)
    index, counted, cells = Cells.of(np.flatnonzero(known), columns)
    grid = bin_grid.BinGrid(tracer.geometry, camera, bin_px)
    points = ray_tracing.Points.of(grid.rays[:, index], np.zeros((2, index.size)))
    tracer.start(points, shape.height)
    bias = grid.averaging_bias_mm(tracer, points, shape, index)
    position = tracer.position_mm(points)
    seen_rad = tracer.predict_screen(points, shape) * rad_per_mm
    fringe = 2 * math.pi / _rad_per_bin(index, (rows, columns), seen_rad, _USUAL)
    inwards = ndimage.distance_transform_edt(np.pad(known.reshape(rows, columns), 1))[
        1:-1, 1:-1
    ].reshape(-1)[index]
    taper = (
        np.sin(np.minimum(inwards / (_FADES * fringe), 1) * math.pi / 2) ** 2 * counted
    ).astype(np.float32)
    return CrossedScene(
        tracer=tracer,
        surface=shape,
        bin_px=bin_px,
        index=index,
        row=index // columns,
        cells=cells,
        points=points,
        beyond_mm=coarse[:2, index] + bias,
        light_adu=coarse[2:, index].copy(),
        basis=zernike.values(*position / shape.radius_mm).astype(np.float32),
        taper=taper,
        edge=taper,
        position_mm=position,
        response=response,
        rad_per_mm=rad_per_mm,
        half_side_mm=optics.pattern.periods * optics.pattern.period_mm / 2,
    )


def _pictures(
    checked: Checked,
    figure: pixel_figure.BinFigure,
    traced: FloatArray,
    mm_per_rad: float,
    level_range: FloatArray | None,
    contrast: float,
) -> FloatArray:
    """Of the reference (5, rows, columns): screen points beyond `traced` in mm, light and both
    swings in ADU.
    """
    fine = np.full((5, *checked.binned.means.shape[1:]), np.nan)
    coarser_rad = traced / mm_per_rad  # the reference's errors repeat with its fringes
    for axis, beyond_mm in enumerate(figure.points.screen_mm - traced):
        fine[axis].reshape(-1)[figure.index] = _without_harmonics(beyond_mm, coarser_rad[axis])
    fine[2] = checked.view.light
    fine[3:] = (
        contrast * checked.view.swing_adu.mean(axis=0) / 2
    )  # each axis has half of the panel's range
    if level_range is not None:
        fine[2:].reshape(3, -1)[:, figure.index] = level_range * np.array(
            [[1.0], [contrast / 4], [contrast / 4]]
        )
    return fine


def _bin_px(checked: Checked, figure: pixel_figure.BinFigure, phase_rad: FloatArray) -> int:
    """The largest bins, made of whole ones of the reference, over which the fringes hardly average
    out.
    """
    fine_px = checked.binned.bin_px
    per_px = _rad_per_bin(figure.index, checked.binned.means.shape[1:], phase_rad, 0.95) / fine_px
    for side in _BINS_PX:
        if (
            side % fine_px == 0
            and side * per_px <= _BIN_RAD
            and figure.index.size * (fine_px / side) ** 2 > _ENOUGH_BINS
        ):
            return side
    if per_px > _PIXEL_RAD:
        raise ValueError(
            f"the camera sees only {2 * math.pi / per_px:.1f} pixels a fringe: use a longer period"
        )
    return fine_px


def _rad_per_bin(
    index: IntArray, shape: tuple[int, ...], phase_rad: FloatArray, quantile: float
) -> float:
    """Change of phases (2, n) of x and y from bin to bin, a quantile of both; along rows or
    columns, the larger.
    """
    pictures = np.full((2, *shape), np.nan)
    pictures.reshape(2, -1)[:, index] = phase_rad
    return max(
        float(np.nanquantile(np.abs(np.diff(pictures, axis=axis)), quantile)) for axis in (1, 2)
    )


def _coarser(fine: FloatArray, side: int) -> FloatArray:
    """Means over squares of `side`; NaN unless all of a square is known."""
    rows, columns = fine.shape[1] // side, fine.shape[2] // side
    squares = fine[:, : rows * side, : columns * side].reshape(len(fine), rows, side, columns, side)
    return np.asarray(squares.mean(axis=(2, 4)))


def _response(
    checked: Checked,
    figure: pixel_figure.BinFigure,
    traced_mm: FloatArray,
    mm_per_rad: float,
    optics: OpticsConfig,
) -> tuple[FloatArray, FloatArray | None]:
    """The panel's response from the reference's sinusoids, between its black and its white frame;
    level and range.

    Steps put harmonics of the reference's fringes into their mean and their swing, the fourth where
    there are four: a ripple that stands where the crossed fringes are four times finer, and looks
    like a tilt that turns with their steps. The level is without it, and the range is that of black
    and white: (3, n) of level, range, range; None without those.
    """
    stack, index = checked.stack, figure.index
    straight = np.zeros(len(_RESPONSE_POWERS))
    white, black = (stack.single(role) for role in ("white", "black"))
    bad = {flag.frame for flag in checked.flags} | set(stack.unusable)
    if white is None or black is None or {white, black} & bad:
        return straight, None
    low, high = (checked.binned.means[k].reshape(-1)[index].astype(float) for k in (black, white))
    shown, seen, levels = [], [], []
    for axis, used in enumerate(checked.view.used):
        phases = traced_mm[axis] / mm_per_rad + screen_scale.centre_phase_rad(optics.pattern)
        for frame in used:
            shown.append((1 + np.cos(phases + stack.patterns[frame].shift_rad)) / 2)
            seen.append((checked.binned.means[frame].reshape(-1)[index] - low) / (high - low))
        levels.append(_without_harmonics(np.mean(seen[-len(used) :], axis=0), phases))
    v, y = np.concatenate(shown), np.concatenate(seen)
    columns = np.stack([v**k - v for k in _RESPONSE_POWERS])
    solved = np.linalg.solve(columns @ columns.T, columns @ (y - v))
    shades = np.linspace(0, 1, 101)
    deviation = solved @ np.stack([shades**k - shades for k in _RESPONSE_POWERS])
    response = solved if np.abs(deviation).max() > _HARMONIC else straight
    whole = high - low
    return response, np.stack([low + whole * np.mean(levels, axis=0), whole, whole])


def _without_harmonics(values: FloatArray, phase_rad: FloatArray) -> FloatArray:
    """Values (n,) less what repeats with the phases (n,)."""
    turns = np.arange(1, _RIPPLES + 1)[:, None] * phase_rad
    waves = np.concatenate([np.ones((1, phase_rad.size)), np.cos(turns), np.sin(turns)])
    return np.asarray(values - np.linalg.solve(waves @ waves.T, waves @ values)[1:] @ waves[1:])
