"""The scene of a crossed pattern, made from a checked reference set and its figure."""

import math

import numpy as np
from scipy import ndimage

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.figure import bin_figure
from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.metrology.phase import screen_scale
from membrane_ctrl.metrology.rays import ray_tracing
from membrane_ctrl.metrology.rays.surface import PARAMETERS
from membrane_ctrl.metrology.reconstruction import bin_grid
from membrane_ctrl.metrology.tracking.bin_cells import (
    Cells,
)
from membrane_ctrl.metrology.tracking.crossed_scene import RESPONSE_POWERS, CrossedScene
from membrane_ctrl.model.arrays import FloatArray, IntArray

# A bin averages the fringes: at this phase across it (95 % of the bins have less) they lose a tenth
# of their swing.
_BIN_RAD = 1.6
_PIXEL_RAD = 2.5  # across a pixel: more is hardly sampled
_BINS_PX = (16, 8, 4, 2, 1)
_ENOUGH_BINS = 280 * PARAMETERS  # fewer cannot carry the surface and three maps of as many terms
_HARMONIC = 2e-3  # a panel that deviates less from a straight line is straight
# Across the mirror. Light is judged in squares of a twelfth of its diameter: with eight fringes,
# squares of a dark part looked covered, and the error bars came out three times too small.
_LEAST_FRINGES = 9
# Light that wanders is orthogonal to shape over whole fringes; where bins end, parts of fringes are
# left, which cost ten times the error. Weights that fade over this much of a fringe cost 9 % of
# noise.
_FADES = 0.8
_USUAL = 0.75  # quantile of the changes of phase, half of which are across the fringes
_RIPPLES = 8  # harmonics of the reference's fringes in the mean of its steps


def make_scene(
    optics: OpticsConfig,
    checked: Checked,
    figure: bin_figure.BinFigure,
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
    response, level_range = _measure_response(
        checked, figure, traced, screen_scale.mm_per_rad(optics.pattern), optics
    )
    fine = _make_pictures(
        checked, figure, traced, screen_scale.mm_per_rad(optics.pattern), level_range, contrast
    )
    coarse = _average_squares(fine, bin_px // fine_px)
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
        basis=zernike.evaluate_terms(*position / shape.radius_mm).astype(np.float32),
        taper=taper,
        edge=taper,
        position_mm=position,
        response=response,
        rad_per_mm=rad_per_mm,
        half_side_mm=optics.pattern.periods * optics.pattern.period_mm / 2,
    )


def _make_pictures(
    checked: Checked,
    figure: bin_figure.BinFigure,
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


def _bin_px(checked: Checked, figure: bin_figure.BinFigure, phase_rad: FloatArray) -> int:
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


def _average_squares(fine: FloatArray, side: int) -> FloatArray:
    """Means over squares of `side`; NaN unless all of a square is known."""
    rows, columns = fine.shape[1] // side, fine.shape[2] // side
    squares = fine[:, : rows * side, : columns * side].reshape(len(fine), rows, side, columns, side)
    return np.asarray(squares.mean(axis=(2, 4)))


def _measure_response(
    checked: Checked,
    figure: bin_figure.BinFigure,
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
    straight = np.zeros(len(RESPONSE_POWERS))
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
    columns = np.stack([v**k - v for k in RESPONSE_POWERS])
    solved = np.linalg.solve(columns @ columns.T, columns @ (y - v))
    shades = np.linspace(0, 1, 101)
    deviation = solved @ np.stack([shades**k - shades for k in RESPONSE_POWERS])
    response = solved if np.abs(deviation).max() > _HARMONIC else straight
    whole = high - low
    return response, np.stack([low + whole * np.mean(levels, axis=0), whole, whole])


def _without_harmonics(values: FloatArray, phase_rad: FloatArray) -> FloatArray:
    """Values (n,) less what repeats with the phases (n,)."""
    turns = np.arange(1, _RIPPLES + 1)[:, None] * phase_rad
    waves = np.concatenate([np.ones((1, phase_rad.size)), np.cos(turns), np.sin(turns)])
    return np.asarray(values - np.linalg.solve(waves @ waves.T, waves @ values)[1:] @ waves[1:])
