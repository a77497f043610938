"""The image of a distant point on the mirror's axis: focus, path differences, point spread function
and Strehl ratio at a wavelength.

A plane wave along the axis reaches the point P of the mirror and is reflected to the focus F. Its
path, counted from a plane in front of the mirror, is

    L = |F - P| - z.

F makes the mean square of L - mean(L) least. The wave comes along the axis of the paraboloid
through the points: a telescope is pointed, and a tilt of the mirror is no error. The point spread
function is the squared modulus of the Fourier transform of exp(2 pi i L / wavelength) over the
aperture, as POPPY and prysm define it; divided by that of equal paths, its largest value is the
Strehl ratio.
"""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.numerics.vectors import column_blocks, vector_lengths
from membrane_ctrl.model.arrays import FloatArray

_PADDING = 4  # of the aperture: samples of the image at a quarter of wavelength over aperture
_FEW_POINTS = 20_000  # enough to come close to the focus; the last steps take all
_FIRST_STEPS, _LAST_STEPS = 4, 2  # Gauss-Newton's, with few points and with all
_ENERGY_SHARES = (0.5, 0.8)
_CURVE_POINTS = 2000  # of a curve of the energy: enough for a picture
# Neighbouring cells whose paths differ by more than half a wavelength do not show what lies between
# them.
_LARGEST_STEP = 0.5
# This share of the steps must be smaller
_RESOLVED_SHARE = 0.99


@dataclass(frozen=True)
class StarImage:
    """The image of a distant point.

    Attributes
    ----------
    focus_mm : float
        Height of the focus above the origin.
    path_rms_um : float
        RMS of the path differences there: about twice the error of the surface.
    strehl : float
    resolved : bool
        Whether the cells resolve the path differences at this wavelength; otherwise the point
        spread function is not that of the mirror.
    radius_50_um, radius_80_um : float
        Radii around the middle of the image that hold 50 and 80 % of the energy.
    spread : (m, m) array
        Point spread function, 1 for the peak of equal paths.
    pixel_um : float
        Distance of its samples in the focal plane.
    curve_um, curve_share : (n,) arrays
        Radii around the middle, and the share of the energy within each.
    """

    focus_mm: float
    path_rms_um: float
    strehl: float
    resolved: bool
    radius_50_um: float
    radius_80_um: float
    spread: FloatArray
    pixel_um: float
    curve_um: FloatArray
    curve_share: FloatArray


def image_star(axis_mm: FloatArray, height_mm: FloatArray, wavelength_um: float) -> StarImage:
    """Return the image of a distant point.

    Parameters
    ----------
    axis_mm : (n,) array
        Middle of the cells of a square grid, evenly spaced.
    height_mm : (n, n) array
        Of the mirror; NaN outside the aperture.
    wavelength_um : float

    Returns
    -------
    StarImage

    Raises
    ------
    ValueError
        A mirror without a focus in front of it.
    """
    mask = np.isfinite(height_mm)
    rows, columns = np.nonzero(mask)
    points = np.stack((axis_mm[columns], axis_mm[rows], height_mm[mask]))
    # Path differences in the focus, on the map's grid.
    focus_mm, path_mm = find_paths(points)
    path_um = 1e3 * (path_mm - path_mm.mean())
    paths = np.zeros(mask.shape)
    paths[mask] = path_um
    # Point spread function, padded for samples finer than the image of a perfect aperture
    waves = np.where(mask, np.exp(2j * np.pi * paths / wavelength_um), 0.0)
    size = _PADDING * len(axis_mm)
    field = np.fft.fftshift(np.fft.fft2(waves, (size, size)))
    spread = np.abs(field) ** 2 / np.count_nonzero(mask) ** 2
    # Width of a pixel in the focus: wavelength times distance over the padded aperture.
    step_mm = float(axis_mm[1] - axis_mm[0])
    distance_mm = float(focus_mm[2] - points[2].min())
    pixel_um = wavelength_um * distance_mm / (size * step_mm)
    radius, energy = _sum_energy(spread)
    radius_50, radius_80 = np.interp(_ENERGY_SHARES, energy, radius).tolist()
    every = max(1, radius.size // _CURVE_POINTS)
    return StarImage(
        focus_mm=float(focus_mm[2]),
        path_rms_um=float(np.sqrt(np.mean(path_um**2))),
        strehl=float(spread.max()),
        resolved=_is_resolved(paths, mask, wavelength_um),
        radius_50_um=pixel_um * radius_50,
        radius_80_um=pixel_um * radius_80,
        spread=spread,
        pixel_um=pixel_um,
        curve_um=pixel_um * radius[::every],
        curve_share=energy[::every],
    )


def find_paths(points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The focus (3,) and the paths (n,) to it, in mm, by Gauss-Newton steps.

    Parameters
    ----------
    points_mm : (3, n) array
        Points of the mirror.

    Raises
    ------
    ValueError
        A mirror without a focus in front of it.
    """
    # Start: the paraboloid z = c_0 + c_1 u + c_2 v + c_3 (u^2 + v^2) through the points, by least
    # squares. u and v are about 1, so that the normal matrix is well conditioned.
    x, y, z = points_mm
    scale_mm = float(np.sqrt(np.mean(np.square(points_mm[:2])) * 2))
    normal = np.zeros((4, 4))
    right = np.zeros(4)
    for block in column_blocks(x.size):
        u, v = points_mm[:2, block] / scale_mm
        columns = np.stack((np.ones_like(u), u, v, u * u + v * v))
        normal += columns @ columns.T
        right += columns @ z[block]
    found = np.linalg.solve(normal, right)
    tilt_x, tilt_y, curvature = found[1:] / (scale_mm, scale_mm, scale_mm**2)
    if curvature <= 0:
        raise ValueError("the mirror has no focus in front of it")

    # The wave comes along the paraboloid's axis: turn it to z. Its focus is 1 / (4 c) above it.
    turned_mm = np.stack((x, y, z - tilt_x * x - tilt_y * y))
    focus = np.array([0.0, 0.0, 1 / (4 * curvature)])

    # Steps to the focus of the points themselves, the first ones with some of them.
    some_mm = turned_mm[:, :: max(1, x.size // _FEW_POINTS)]
    for cloud_mm in [some_mm] * _FIRST_STEPS + [turned_mm] * _LAST_STEPS:
        focus = focus + _focus_step(cloud_mm, focus)

    # L = |F - P| - z.
    path = np.empty(x.size)
    for block in column_blocks(x.size):
        towards = focus[:, None] - turned_mm[:, block]
        path[block] = vector_lengths(towards) - turned_mm[2, block]
    return focus, path


def _focus_step(points_mm: FloatArray, focus_mm: FloatArray) -> FloatArray:
    """Gauss-Newton step (3,) of the focus towards the least variance of the paths."""
    # Sums of the gradients dL/dF = (F - P) / |F - P|, of the paths L, and of their products. The
    # path of the vertex is subtracted: sums of whole paths would lose digits.
    count = points_mm.shape[1]
    of_gradient = np.zeros(3)
    of_path = 0.0
    normal = np.zeros((3, 3))
    right = np.zeros(3)
    for block in column_blocks(count):
        towards = focus_mm[:, None] - points_mm[:, block]
        distance = vector_lengths(towards)
        path = distance - points_mm[2, block] - focus_mm[2]
        gradient = towards / distance
        of_gradient += gradient.sum(axis=1)
        of_path += float(path.sum())
        normal += gradient @ gradient.T
        right += gradient @ path

    # The mean path is free: the products about the means, sum g g^T - n mean(g) mean(g)^T.
    mean = of_gradient / count
    normal -= count * np.outer(mean, mean)
    right -= mean * of_path
    return -np.asarray(np.linalg.solve(normal, right))


def find_strehl(points_mm: FloatArray, wavelength_um: float) -> tuple[float, float]:
    """Return the Strehl ratio in the focus of least path differences, and their RMS.

    Where the paths differ by much less than the wavelength, this is the largest value of the point
    spread function.

    Parameters
    ----------
    points_mm : (3, n) array
        Points of the mirror, each standing for an equal area.
    wavelength_um : float
        Of the light.

    Returns
    -------
    strehl : float
        From 0 to 1; NaN for a mirror without a focus.
    rms_um : float
        RMS of the path differences; NaN without a focus.
    """
    try:
        _, path_mm = find_paths(points_mm)
    except ValueError:
        return np.nan, np.nan
    path_um = 1e3 * (path_mm - path_mm.mean())
    # Square of the mean of exp(i phase); cosine and sine take half of the time.
    phase_rad = 2 * np.pi * path_um / wavelength_um
    strehl = np.mean(np.cos(phase_rad)) ** 2 + np.mean(np.sin(phase_rad)) ** 2
    return float(strehl), float(np.sqrt(np.mean(path_um**2)))


def _is_resolved(paths_um: FloatArray, mask: FloatArray, wavelength_um: float) -> bool:
    """Whether nearly all neighbouring cells differ by less than half a wavelength."""
    small = []
    for axis in (0, 1):
        # Neighbours along this axis that are both inside the aperture.
        both = np.logical_and(
            np.take(mask, range(len(mask) - 1), axis), np.take(mask, range(1, len(mask)), axis)
        )
        steps = np.abs(np.diff(paths_um, axis=axis))[both]
        small.append(steps < _LARGEST_STEP * wavelength_um)
    return bool(np.mean(np.concatenate(small)) >= _RESOLVED_SHARE)


def _sum_energy(spread: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Radii (n,) of all samples around the middle of the energy, in order, and the share (n,) of
    the energy up to each.
    """
    # The middle is the centre of gravity.
    axis = np.arange(len(spread))
    total = spread.sum()
    row = float(spread.sum(axis=1) @ axis / total)
    column = float(spread.sum(axis=0) @ axis / total)

    # Energy summed from the middle outwards.
    radius = np.hypot(axis[:, None] - row, axis[None, :] - column).ravel()
    order = np.argsort(radius)
    energy = np.cumsum(spread.ravel()[order]) / total
    return radius[order], energy
