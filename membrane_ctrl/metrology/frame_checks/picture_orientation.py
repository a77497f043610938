"""Whether the pictures or the pattern are turned or mirrored against the stated bench.

A camera that hangs upside down, a driver that mirrors its pictures or a screen whose axes are
exchanged gives phases that decode without a fault, and a surface that is wrong by more than any
stated uncertainty. Each such orientation has its own rays or screen points, so each is tried: the
surface is fitted to the bins as if the pictures (or the screen's axes) were turned back, and the
slopes that the fit leaves decide. An orientation is named only if it explains the slopes much
better than the stated one; one that explains them as well is named beside it. (A bench that is
symmetric about the plane of camera and screen cannot distinguish pictures that are mirrored top to
bottom from a pattern that is.)
"""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.phase import screen_scale
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.ray_tracing import Points, Tracer, make_parabola
from membrane_ctrl.metrology.reconstruction import surface_fit
from membrane_ctrl.model.arrays import BoolArray, FloatArray

# RMS of the slopes that a fit leaves: 2 to 5 µrad of a sound film, tens of µrad of wrinkles and
# gamma, hundreds of a wrong orientation.
SUSPICIOUS_URAD = 20.0
_BETTER = 4.0  # the stated orientation must leave more than another one by this factor
_EQUAL = 2.0  # orientations within this factor of the best one explain the slopes equally well
_BINS = 1500  # that are fitted: more change nothing, and 15 fits of them take 0.1 s
_LEAST_BINS = 200  # for the surface's parameters; any surface would fit fewer
_TOLERANCE_MM = 1e-3  # of the height: slopes are then known to a microradian
# Least bins on the mirror in another orientation, over those in the stated one; a picture turned by
# 90 degrees keeps the middle.
_LEAST_SEEN = 0.5
# Least share of the mirror's bins whose phase is known. Overexposed pictures leave a few per cent,
# at the edges, where another orientation may fit by chance.
_LEAST_KNOWN = 0.25

# How pictures and the pattern may be turned (what to print of each), and the matrix that turns
# columns and rows, or x and y of the pattern, back about the middle.
_TURNS = (
    ("rotated by 180 degrees", "rotated by 180 degrees", ((-1, 0), (0, -1))),
    ("mirrored left to right", "mirrored left to right", ((-1, 0), (0, 1))),
    ("mirrored top to bottom", "mirrored top to bottom", ((1, 0), (0, -1))),
    ("rotated by 90 degrees clockwise", "rotated by 90 degrees", ((0, 1), (-1, 0))),
    ("rotated by 90 degrees counter-clockwise", "rotated by -90 degrees", ((0, -1), (1, 0))),
    ("shown with columns and rows exchanged", "shown with x and y exchanged", ((0, 1), (1, 0))),
    (
        "rotated by 180 degrees and shown with columns and rows exchanged",
        "rotated by 180 degrees and shown with x and y exchanged",
        ((0, -1), (-1, 0)),
    ),
)


@dataclass(frozen=True)
class Orientation:
    """An orientation of pictures or pattern that explains what the stated one does not.

    Attributes
    ----------
    what : tuple of str
        What is turned, and how; several if they explain the slopes equally well.
    stated_urad, found_urad : float
        RMS of the slopes that the fit leaves in the stated orientation, and in this one.
    """

    what: tuple[str, ...]
    stated_urad: float
    found_urad: float

    def describe(self) -> str:
        """One sentence with the cause, its evidence and the remedy."""
        return (
            f"{', or '.join(self.what)}: with that undone the slopes that the fit leaves fall from "
            f"{self.stated_urad:.0f} to {self.found_urad:.0f} µrad; turn it back, or state the "
            "poses of camera and screen as they are"
        )


def find_orientation(
    optics: OpticsConfig, vertex_z_mm: float, places_px: FloatArray, phase_rad: FloatArray
) -> Orientation | None:
    """Look for an orientation that explains the phases better than the stated one.

    Parameters
    ----------
    optics : OpticsConfig
        The stated bench.
    vertex_z_mm : float
        Height of the vertex in world.
    places_px : (2, n) array
        Columns and rows of the bins.
    phase_rad : (2, n) array
        Their absolute phases; NaN where unknown.

    Returns
    -------
    Orientation or None
        None if the stated one is not suspicious, or if no other is clearly better.
    """
    # Bins with a phase, about as many as change the answer.
    tracer = Tracer(Geometry.from_config(optics), optics.mirror.radius_mm, vertex_z_mm)
    of_mirror = np.count_nonzero(_find_on_mirror(optics, tracer, tracer.geometry.rays(*places_px)))
    known = np.flatnonzero(np.isfinite(phase_rad).all(axis=0))
    if known.size < max(_LEAST_BINS, _LEAST_KNOWN * of_mirror):
        return None
    known = known[:: max(1, known.size // _BINS)]
    places_px = places_px[:, known]
    screen_mm = screen_scale.screen_mm(phase_rad[:, known], optics.pattern)

    # The stated orientation.
    stated_urad, stated_count = _residual_urad(optics, tracer, places_px, screen_mm)
    if stated_urad <= SUSPICIOUS_URAD:
        return None

    # All others: first pictures turned back, then the pattern turned back.
    camera = optics.camera
    middle_px = np.array([[camera.width_px - 1], [camera.height_px - 1]]) / 2
    tried: list[tuple[str, FloatArray, FloatArray]] = []
    for of_pictures, of_pattern, turn in _TURNS:
        turned_px = middle_px + np.array(turn) @ (places_px - middle_px)
        turned_mm = np.array(turn) @ screen_mm
        tried.append((f"the pictures are {of_pictures}", turned_px, screen_mm))
        tried.append((f"the pattern on the screen is {of_pattern}", places_px, turned_mm))
    residuals_urad: dict[str, float] = {}
    for name, places, points in tried:
        residual_urad, count = _residual_urad(optics, tracer, places, points)
        if count >= _LEAST_SEEN * stated_count:
            residuals_urad[name] = residual_urad

    # The best one counts if it is much better than the stated one.
    best_urad = min(residuals_urad.values(), default=math.inf)
    if not best_urad * _BETTER < stated_urad:
        return None
    equal = tuple(name for name, urad in residuals_urad.items() if urad <= _EQUAL * best_urad)
    return Orientation(equal, stated_urad, best_urad)


def _residual_urad(
    optics: OpticsConfig, tracer: Tracer, places_px: FloatArray, screen_mm: FloatArray
) -> tuple[float, int]:
    """RMS of measured minus fitted slopes, µrad (infinite without a fit), and the number of bins
    on the mirror.

    `places_px` (2, n) are columns and rows of the bins, `screen_mm` (2, n) their screen points.
    """
    rays = tracer.geometry.rays(*places_px)
    inside = _find_on_mirror(optics, tracer, rays)
    count = int(np.count_nonzero(inside))
    if count < _LEAST_BINS:
        return math.inf, count

    # A fit from the paper's parabola (equation 20), with the tolerance that the comparison needs.
    points = Points.from_rays(rays[:, inside], screen_mm[:, inside])
    start = make_parabola(optics.mirror.sag_mm, tracer.radius_mm)
    try:
        fit = surface_fit.fit_surface(tracer, points, start, tolerance_mm=_TOLERANCE_MM)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError):
        return math.inf, count
    if not fit.converged:
        return math.inf, count
    return 1e6 * math.hypot(fit.residual_x, fit.residual_y) / math.sqrt(2), count


def _find_on_mirror(optics: OpticsConfig, tracer: Tracer, rays: FloatArray) -> BoolArray:
    """Whether rays (3, n) meet the plane through the vertex inside the analysed radius."""
    path_mm = (tracer.vertex_z_mm - tracer.geometry.pinhole_mm[2]) / rays[2]
    x_mm, y_mm = (tracer.geometry.pinhole_mm[:, None] + path_mm * rays)[:2]
    return np.asarray(np.hypot(x_mm, y_mm) <= optics.mirror.analysis_radius_mm)
