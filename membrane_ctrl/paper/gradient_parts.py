"""Part: the paper's equations from phase to slope against an exact ray trace."""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.paper import pictures
from membrane_ctrl.paper.aperture_grid import ApertureGrid
from membrane_ctrl.paper.bench import PaperBench
from membrane_ctrl.paper.comparison import Agreement, PaperStatement, PartResult
from membrane_ctrl.paper.reference_pmd import Reflection, YReading, compute_slopes

_SIDE = 121  # points along a map of the aperture
_STEP_MM = 1e-3  # of the differences that give the truth's slopes: exact to 1e-10
# The equations count as exact below this, far above the rounding of the slopes' differences.
_EXACT_URAD = 0.01


@dataclass(frozen=True, slots=True)
class _TrueRays:
    """Points of the film, with what is seen there.

    Attributes
    ----------
    points_mm : (3, n) array
    slopes : (2, n) array
    screen_mm : (2, n) array
    rays : Reflection
    """

    points_mm: FloatArray
    slopes: FloatArray
    screen_mm: FloatArray
    rays: Reflection


def compare_gradients(bench: PaperBench) -> PartResult:
    """Slopes by the paper's equations for a known film, less the film's own."""
    # Points over the aperture, with their true slopes and what the camera sees there.
    grid = ApertureGrid.over_disc(bench.optics.mirror.analysis_radius_mm, _SIDE)
    true = _trace(bench, *grid.places_mm)

    # Error of the slopes in each reading of the equations, and without their correction
    rows: dict[str, FloatArray] = {}
    for reading in YReading:
        found = compute_slopes(bench.geometry, true.points_mm, true.screen_mm, true.rays, reading)
        rows[reading.name] = 1e6 * (found - true.slopes)
    plain = compute_slopes(bench.geometry, true.points_mm, true.screen_mm, None)
    rows["NO_CORRECTION"] = 1e6 * (plain - true.slopes)

    exact = rows[YReading.HEIGHT_OF_POINT.name]
    comparisons = [
        PaperStatement(
            "x slope by equations 3 to 14 less that of the film, µrad",
            "rigorous",
            _state(exact[0]),
            Agreement.REPRODUCED if np.max(np.abs(exact[0])) < _EXACT_URAD else Agreement.DIFFERS,
            "height and normal of the film known; tan(theta) of equation 12 is -dh/dx",
        ),
        PaperStatement(
            "y slope, with b the height of each point of the screen, µrad",
            "follows the same principle",
            _state(exact[1]),
            Agreement.REPRODUCED if np.max(np.abs(exact[1])) < _EXACT_URAD else Agreement.DIFFERS,
            "the paper does not give the y equations; equation 14 needs angles with signs here",
        ),
        PaperStatement(
            "y slope, with b sin(alpha), µrad",
            "",
            _state(rows[YReading.HEIGHT_OF_CENTRE.name][1]),
            Agreement.UNSTATED,
            "another reading of the y equations: the screen as level in y",
        ),
        PaperStatement(
            "y slope, with a and b along the chief ray, µrad",
            "",
            _state(rows[YReading.CHIEF_RAY.name][1]),
            Agreement.UNSTATED,
            "the plainest reading of the y equations",
        ),
        PaperStatement(
            "slopes without the correction delta theta of equation 14, µrad",
            "",
            f"x {_state(rows['NO_CORRECTION'][0])}; y {_state(rows['NO_CORRECTION'][1])}",
            Agreement.UNSTATED,
            "what the projection effects amount to",
        ),
    ]
    numbers = {
        name: {
            f"{axis}_{kind}_urad": _without_rounding(value)
            for axis, values in zip("xy", error, strict=True)
            for kind, value in (
                ("rms", _compute_rms(values)),
                ("max", float(np.max(np.abs(values)))),
            )
        }
        for name, error in rows.items()
    }

    # Maps of the errors that are not rounding.
    maps = {
        "x without delta theta": grid.fill_map(rows["NO_CORRECTION"][0]),
        "y without delta theta": grid.fill_map(rows["NO_CORRECTION"][1]),
        "y with b sin(alpha)": grid.fill_map(rows[YReading.HEIGHT_OF_CENTRE.name][1]),
    }
    title = "errors of the slope over the aperture"
    drawn = {title: pictures.draw_maps(maps, grid.axis_mm, "µrad")}
    return PartResult(comparisons, numbers, drawn)


def _trace(bench: PaperBench, x_mm: FloatArray, y_mm: FloatArray) -> _TrueRays:
    """Reflect the camera's rays at points of the film, and follow them to the screen's plane."""
    # Slopes by central differences: the film's formulas are not used.
    film = bench.film
    height_mm = film.height_mm(x_mm, y_mm)
    slope_x = film.height_mm(x_mm + _STEP_MM, y_mm) - film.height_mm(x_mm - _STEP_MM, y_mm)
    slope_y = film.height_mm(x_mm, y_mm + _STEP_MM) - film.height_mm(x_mm, y_mm - _STEP_MM)
    slopes = np.stack([slope_x, slope_y]) / (2 * _STEP_MM)

    # The law of reflection: v = u - 2 (u n) n with the normal n ~ (-dh/dx, -dh/dy, 1).
    points_mm = np.stack([x_mm, y_mm, height_mm])
    normal = np.stack([-slopes[0], -slopes[1], np.ones_like(x_mm)], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    incident = points_mm.T - bench.geometry.pinhole_mm
    incident /= np.linalg.norm(incident, axis=1, keepdims=True)
    towards = np.sum(incident * normal, axis=1, keepdims=True)
    reflected = incident - 2.0 * towards * normal

    # O' = b (-cos alpha, 0, sin alpha), and the directions on the screen, which is across O O'.
    alpha_rad = bench.geometry.alpha_rad
    to_centre = np.array([-math.cos(alpha_rad), 0.0, math.sin(alpha_rad)])
    centre_mm = bench.geometry.b_mm * to_centre
    along_x = np.array([-math.sin(alpha_rad), 0.0, -math.cos(alpha_rad)])
    along_y = np.array([0.0, 1.0, 0.0])
    face = np.cross(along_x, along_y)

    # Where the reflected ray meets the screen's plane, from O'.
    reach_mm = ((centre_mm - points_mm.T) @ face) / (reflected @ face)
    on_screen_mm = points_mm.T + reach_mm[:, None] * reflected - centre_mm
    screen_mm = np.stack([on_screen_mm @ along_x, on_screen_mm @ along_y])
    return _TrueRays(points_mm, slopes, screen_mm, Reflection(normal, incident, reflected))


def _state(error_urad: FloatArray) -> str:
    return f"RMS {_compute_rms(error_urad):.3g}, largest {np.max(np.abs(error_urad)):.3g}"


def _compute_rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _without_rounding(error_urad: float) -> float:
    """An error, 0 if it is rounding, which differs between machines."""
    return 0.0 if error_urad < _EXACT_URAD else error_urad
