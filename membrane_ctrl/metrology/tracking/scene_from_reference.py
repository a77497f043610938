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
from membrane_ctrl.metrology.tracking.bin_cells import Cells
from membrane_ctrl.metrology.tracking.crossed_scene import RESPONSE_POWERS, CrossedScene
from membrane_ctrl.model.arrays import FloatArray, IntArray

# A bin averages the fringes: at this phase across it they lose a tenth of their swing.
_BIN_RAD = 1.6
_MOST_BINS_QUANTILE = 0.95  # of the bins, which have a smaller phase across them
_PIXEL_RAD = 2.5  # largest phase across a pixel: more is hardly sampled
_BINS_PX = (16, 8, 4, 2, 1)  # sides that are tried
_ENOUGH_BINS = 280 * PARAMETERS  # fewer do not determine the surface and three maps of light
_STRAIGHT = 2e-3  # deviation from a straight line below which a panel's response is straight
# Least number of fringes across the mirror. Light is judged in squares of a twelfth of its
# diameter: with eight fringes, squares of a dark part look covered, and the error bars are three
# times too small.
_LEAST_FRINGES = 9
# Length over which the weights fade to 0 where the bins end, in fringes. Slow changes of
# illumination do not affect the shape over whole fringes; the parts of fringes at the edge would
# cost ten times the error. The fading costs 9 % of noise.
_FADES = 0.8
_USUAL_QUANTILE = 0.75  # of the changes of phase, half of which are across the fringes
_RIPPLES = 8  # harmonics of the reference's fringes in the mean of its steps
_SHADES = np.linspace(0, 1, 101)  # at which the response is compared with a straight line


def make_scene(
    optics: OpticsConfig,
    checked: Checked,
    figure: bin_figure.BinFigure,
    period_mm: float,
    contrast: float = 1.0,
) -> CrossedScene:
    """Make the scene of a reference set for a crossed pattern on the same region.

    Parameters
    ----------
    optics : OpticsConfig
        The bench.
    checked : Checked
        The reference set.
    figure : BinFigure
        The surface through its bins.
    period_mm : float
        Period of the crossed fringes.
    contrast : float
        Contrast of the pattern, c in docs/reference/interfaces.md.

    Returns
    -------
    CrossedScene

    Raises
    ------
    ValueError
        If the camera cannot resolve such fringes, or the mirror shows too few.
    """
    camera = optics.camera
    tracer = checked.tracer
    shape = figure.fit.surface
    rad_per_mm = 2 * math.pi / period_mm
    mm_per_rad = screen_scale.mm_per_rad(optics.pattern)

    # Screen points of the reference's bins, as its surface predicts them.
    traced_mm = tracer.predict_screen(figure.points, shape)
    fringes = float(np.ptp(traced_mm, axis=1).min()) / period_mm
    if fringes < _LEAST_FRINGES:
        seen = f"only {fringes:.0f} fringes across the mirror"
        raise ValueError(
            f"{seen}, but {_LEAST_FRINGES} or more separate light and shape: use a shorter period"
        )

    # What the reference shows, in its bins, and then in the larger bins of the scene.
    bin_px = _choose_bin_px(checked, figure, traced_mm * rad_per_mm)
    response, level_range = _measure_response(checked, figure, traced_mm, mm_per_rad, optics)
    fine = _make_maps(checked, figure, traced_mm, mm_per_rad, level_range, contrast)
    coarse = _average_squares(fine, bin_px // checked.binned.bin_px)
    rows = camera.height_px // bin_px
    columns = camera.width_px // bin_px
    coarse = coarse[:, :rows, :columns].reshape(len(fine), -1)

    # Bins that are wholly known, in the order of the fit's cells.
    known = np.isfinite(coarse).all(axis=0)
    index, counted, cells = Cells.from_bins(np.flatnonzero(known), columns)

    # Rays of the bins, traced to the surface.
    grid = bin_grid.BinGrid(tracer.geometry, camera, bin_px)
    no_screen_mm = np.zeros((2, index.size))
    points = ray_tracing.Points.from_rays(grid.rays[:, index], no_screen_mm)
    tracer.place_on_shape(points, shape.height)
    bias_mm = grid.averaging_bias_mm(tracer, points, shape, index)
    position_mm = tracer.position_mm(points)
    seen_rad = tracer.predict_screen(points, shape) * rad_per_mm

    # Weights, which fade with the distance from where the bins end.
    fringe_bins = 2 * math.pi / _rad_per_bin(index, (rows, columns), seen_rad, _USUAL_QUANTILE)
    padded = np.pad(known.reshape(rows, columns), 1)
    distances = ndimage.distance_transform_edt(padded)[1:-1, 1:-1]
    from_edge = distances.reshape(-1)[index]
    rising = np.minimum(from_edge / (_FADES * fringe_bins), 1)
    fading = np.sin(rising * math.pi / 2) ** 2
    taper = (fading * counted).astype(np.float32)
    return CrossedScene(
        tracer=tracer,
        surface=shape,
        bin_px=bin_px,
        index=index,
        row=index // columns,
        cells=cells,
        points=points,
        beyond_mm=coarse[:2, index] + bias_mm,
        light_adu=coarse[2:, index].copy(),
        basis=zernike.evaluate_terms(*position_mm / shape.radius_mm).astype(np.float32),
        taper=taper,
        edge=taper,
        position_mm=position_mm,
        response=response,
        rad_per_mm=rad_per_mm,
        half_side_mm=optics.pattern.periods * optics.pattern.period_mm / 2,
    )


def _make_maps(
    checked: Checked,
    figure: bin_figure.BinFigure,
    traced_mm: FloatArray,
    mm_per_rad: float,
    level_range: FloatArray | None,
    contrast: float,
) -> FloatArray:
    """Maps of the reference, in its bins.

    Parameters
    ----------
    checked, figure : Checked, BinFigure
        The reference, and the surface through its n bins.
    traced_mm : (2, n) array
        Screen points that the surface predicts.
    mm_per_rad : float
        Of the reference's fringes.
    level_range : (3, n) array or None
        Level, range and range of the light, from `_measure_response`.
    contrast : float
        Contrast of the crossed pattern.

    Returns
    -------
    (5, rows, columns) array
        Screen points beyond the traced ones along x and y, mm; light and both swings, ADU. NaN
        outside the mirror.
    """
    fine = np.full((5, *checked.binned.means.shape[1:]), np.nan)
    # The reference's own errors repeat with its fringes.
    phase_rad = traced_mm / mm_per_rad
    for axis, beyond_mm in enumerate(figure.points.screen_mm - traced_mm):
        fine[axis].reshape(-1)[figure.index] = _without_harmonics(beyond_mm, phase_rad[axis])

    # Each axis has half of the panel's range.
    fine[2] = checked.view.light
    fine[3:] = contrast * checked.view.swing_adu.mean(axis=0) / 2
    if level_range is not None:
        shares = np.array([[1.0], [contrast / 4], [contrast / 4]])
        fine[2:].reshape(3, -1)[:, figure.index] = level_range * shares
    return fine


def _choose_bin_px(checked: Checked, figure: bin_figure.BinFigure, phase_rad: FloatArray) -> int:
    """Side of the largest bins, made of whole ones of the reference, over which the fringes hardly
    average out.

    `phase_rad` (2, n) are the phases of the crossed pattern in the reference's bins. Raises
    ValueError if a pixel is too large for the fringes.
    """
    fine_px = checked.binned.bin_px
    shape = checked.binned.means.shape[1:]
    rad_per_px = _rad_per_bin(figure.index, shape, phase_rad, _MOST_BINS_QUANTILE) / fine_px
    for side_px in _BINS_PX:
        consists_of_whole = side_px % fine_px == 0
        keeps_swing = side_px * rad_per_px <= _BIN_RAD
        bins = figure.index.size * (fine_px / side_px) ** 2
        if consists_of_whole and keeps_swing and bins > _ENOUGH_BINS:
            return side_px
    if rad_per_px > _PIXEL_RAD:
        pixels = 2 * math.pi / rad_per_px
        raise ValueError(f"the camera sees only {pixels:.1f} pixels a fringe: use a longer period")
    return fine_px


def _rad_per_bin(
    index: IntArray, shape: tuple[int, ...], phase_rad: FloatArray, quantile: float
) -> float:
    """Change of the phases from bin to bin.

    Parameters
    ----------
    index : (n,) int array
        Numbers of the bins.
    shape : (int, int)
        Rows and columns of bins.
    phase_rad : (2, n) array
        Phases of x and y.
    quantile : float
        Which quantile of the changes.

    Returns
    -------
    float
        The larger of that along rows and that along columns.
    """
    maps = np.full((2, *shape), np.nan)
    maps.reshape(2, -1)[:, index] = phase_rad
    changes_rad = [np.abs(np.diff(maps, axis=axis)) for axis in (1, 2)]
    return max(float(np.nanquantile(change_rad, quantile)) for change_rad in changes_rad)


def _average_squares(fine: FloatArray, side: int) -> FloatArray:
    """Means of maps (k, rows, columns) over squares of `side` x `side`; NaN unless all of a square
    is known.
    """
    rows = fine.shape[1] // side
    columns = fine.shape[2] // side
    whole = fine[:, : rows * side, : columns * side]
    squares = whole.reshape(len(fine), rows, side, columns, side)
    return np.asarray(squares.mean(axis=(2, 4)))


def _measure_response(
    checked: Checked,
    figure: bin_figure.BinFigure,
    traced_mm: FloatArray,
    mm_per_rad: float,
    optics: OpticsConfig,
) -> tuple[FloatArray, FloatArray | None]:
    """Measure the panel's response from the reference's sinusoids, black and white frame.

    The mean of N phase steps contains the N-th harmonic of the reference's fringes: a ripple that
    coincides with crossed fringes that are N times finer, and would look like a tilt that turns
    with their steps. The level is therefore without harmonics, and the range is that of black and
    white.

    Parameters
    ----------
    checked, figure : Checked, BinFigure
        The reference, and the surface through its n bins.
    traced_mm : (2, n) array
        Screen points that the surface predicts.
    mm_per_rad : float
        Of the reference's fringes.
    optics : OpticsConfig
        The bench.

    Returns
    -------
    response : (4,) array
        As `CrossedScene.response`.
    level_range : (3, n) array or None
        Level, range and again range of the light, ADU; None without usable black and white frames.
    """
    stack = checked.stack
    index = figure.index
    straight = np.zeros(len(RESPONSE_POWERS))
    pair = stack.white_and_black({flag.frame for flag in checked.flags} | set(stack.unusable))
    if pair is None:
        return straight, None
    white, black = pair
    low = checked.binned.means[black].reshape(-1)[index].astype(float)
    high = checked.binned.means[white].reshape(-1)[index].astype(float)

    # Level v that each sinusoid shows, from 0 to 1, and level y that the camera sees.
    shown = []
    seen = []
    levels = []
    for axis, used in enumerate(checked.view.used):
        phases = traced_mm[axis] / mm_per_rad + screen_scale.centre_phase_rad(optics.pattern)
        for frame in used:
            light_adu = checked.binned.means[frame].reshape(-1)[index]
            shown.append((1 + np.cos(phases + stack.patterns[frame].shift_rad)) / 2)
            seen.append((light_adu - low) / (high - low))
        mean_of_axis = np.mean(seen[-len(used) :], axis=0)
        levels.append(_without_harmonics(mean_of_axis, phases))
    v = np.concatenate(shown)
    y = np.concatenate(seen)

    # Least squares for y - v = sum c_k (v^k - v); a response that is nearly straight counts as
    # straight.
    columns = np.stack([v**k - v for k in RESPONSE_POWERS])
    solved = np.linalg.solve(columns @ columns.T, columns @ (y - v))
    at_shades = np.stack([_SHADES**k - _SHADES for k in RESPONSE_POWERS])
    deviation = solved @ at_shades
    response = straight
    if np.abs(deviation).max() > _STRAIGHT:
        response = solved
    light_range = high - low
    level = low + light_range * np.mean(levels, axis=0)
    return response, np.stack([level, light_range, light_range])


def _without_harmonics(values: FloatArray, phase_rad: FloatArray) -> FloatArray:
    """Values (n,) less the part that repeats with the phases (n,); their mean stays."""
    turns = np.arange(1, _RIPPLES + 1)[:, None] * phase_rad
    waves = np.concatenate([np.ones((1, phase_rad.size)), np.cos(turns), np.sin(turns)])
    amplitudes = np.linalg.solve(waves @ waves.T, waves @ values)
    return np.asarray(values - amplitudes[1:] @ waves[1:])
