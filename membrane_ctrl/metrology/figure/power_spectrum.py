"""Power spectral density of the deviation from the best sphere."""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.figure.quantities import Figure
from membrane_ctrl.model.arrays import FloatArray


@dataclass(frozen=True)
class PowerSpectrum:
    """Power spectral density of a deviation, mean over the directions; its sum over the plane is
    the mean square.

    Attributes
    ----------
    frequency_per_mm : (m,) array
    density_um2_mm2 : (m,) array
    sigma_um2_mm2 : (m,) array
        1 sigma as an estimate of a random surface's density.
    """

    frequency_per_mm: FloatArray
    density_um2_mm2: FloatArray
    sigma_um2_mm2: FloatArray


def power_spectrum(found: Figure, axis_mm: FloatArray, aperture_mm: float) -> PowerSpectrum:
    """Spectrum of the deviation from the best sphere under a radial Hann window.

    Cells without a measurement are filled by the fit of the terms.

    Parameters
    ----------
    found : Figure
        The figure, with its maps (n, n).
    axis_mm : (n,) array
        Middle of the cells, along x as along y.
    aperture_mm : float
        Radius of the aperture, at which the window ends.

    Returns
    -------
    PowerSpectrum
        Rings of half a wave over the aperture's radius, up to half the sampling frequency.
    """
    # The window, cos^2 of a quarter turn over the aperture.
    x, y = np.meshgrid(axis_mm, axis_mm)
    r = np.hypot(x, y)
    share = np.minimum(r / aperture_mm, 1)
    window = np.where(r < aperture_mm, np.cos(np.pi / 2 * share) ** 2, 0.0)

    # The deviation under it, without its weighted mean, and the density of its waves, for which the
    # window's power is undone.
    step_mm = float(axis_mm[1] - axis_mm[0])
    deviation = np.where(np.isfinite(found.deviation_um), found.deviation_um, found.smooth_um)
    mean = np.sum(window * deviation) / np.sum(window)
    transform = np.fft.rfft2(window * (deviation - mean))
    window_power = np.sum(window**2)
    density = np.abs(transform) ** 2 * step_mm**2 / window_power

    # The ring of each wave, by its frequency in any direction.
    along_x = np.fft.rfftfreq(axis_mm.size, step_mm)
    along_y = np.fft.fftfreq(axis_mm.size, step_mm)
    frequency_x, frequency_y = np.meshgrid(along_x, along_y)
    width = 1 / (2 * aperture_mm)
    ring = np.round(np.hypot(frequency_x, frequency_y) / width).astype(np.int64).ravel()

    # Means over the rings, without the first one, which is the mean height.
    count = np.bincount(ring)
    is_sampled = np.arange(count.size) * width < 0.5 / step_mm
    known = np.flatnonzero((count > 0) & is_sampled)[1:]
    means = np.bincount(ring, density.ravel()) / np.maximum(count, 1)
    ring_mean = means[known]

    # Neighbours in the plane share what the window smears: fewer are independent.
    independent = window_power**2 / (window.size * np.sum(window**4))
    sigma = ring_mean / np.sqrt(np.maximum(count[known] * independent, 1.0))
    return PowerSpectrum(width * known.astype(np.float64), ring_mean, sigma)
