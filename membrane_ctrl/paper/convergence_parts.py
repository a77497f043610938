"""Parts: how fast the iteration converges, and whether the start matters."""

import numpy as np

from membrane_ctrl.metrology.rays.ray_tracing import HeightFunction
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.reconstruction.surface_fit import fit_surface
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.paper import pictures
from membrane_ctrl.paper.aperture_grid import ApertureGrid
from membrane_ctrl.paper.bench import MeasuredBench
from membrane_ctrl.paper.comparison import Agreement, PaperStatement, PartResult, judge_within
from membrane_ctrl.paper.reference_iteration import (
    ReferenceSolution,
    SeenPoints,
    StartShape,
    make_cone,
    make_parabola,
    make_v_fold,
    reconstruct,
)

_THRESHOLD_MM = 1e-6  # the paper's
_ITERATIONS = 12
_STARTS_MM = (10.0, 20.0, 40.0, 60.0, 80.0, 100.0)  # depths of paraboloids
_PAPER_START = "paraboloid 40 mm"  # equation 20
_LAST_CHANGE_MM = 1e-9  # that `measure` leaves to come
_NINE = 9  # iterations after which the paper compares the starting shapes
_POINTS = 4000  # determine the 36 terms; more only cost time
_SIDE = 101  # points along a map
# Two solutions that differ by less are the same: heights of 16 to 32 mm have units of the last
# place of 4e-15 mm, and the least squares multiply the rounding by up to a hundred.
_ROUNDING_MM = 1e-12


def make_seen_points(bench: MeasuredBench, count: int = _POINTS) -> SeenPoints:
    """Thin out the bins of a set: more points than `count` only cost time.

    Parameters
    ----------
    bench : MeasuredBench
        The set.
    count : int
        About how many bins to keep, evenly over the mirror.
    """
    points = bench.checked.state.points
    every = max(1, points.t_mm.size // count)
    return SeenPoints(points.rays[:, ::every], points.screen_mm[:, ::every])


def solve_by_paper(
    bench: MeasuredBench, start: StartShape, iterations: int, count: int = _POINTS
) -> ReferenceSolution:
    """Solve the paper's own iteration (its section 2.4) on bins of the set.

    Parameters
    ----------
    bench : MeasuredBench
        The set, and a, b and alpha of its geometry.
    start : StartShape
        h^(0).
    iterations : int
        Number of iterations; there is no other end.
    count : int
        About how many bins to use.
    """
    mirror = bench.optics.mirror
    return reconstruct(
        bench.geometry,
        make_seen_points(bench, count),
        start,
        mirror.radius_mm,
        mirror.analysis_radius_mm,
        iterations,
    )


def compare_convergence(bench: MeasuredBench) -> PartResult:
    """Largest change of the height in each iteration."""
    radius_mm = bench.optics.mirror.radius_mm
    reference = solve_by_paper(bench, make_parabola(40.0, radius_mm), _ITERATIONS)
    needed = _count_iterations(reference.changes_mm)

    # `changes_mm` of `measure`: its bins from the start, then its pixels from the bins' surface.
    ours_mm = list(bench.full.fit.changes_mm)
    comparisons = [
        PaperStatement(
            "iterations until the largest change is below 1e-6 mm, paper's iteration",
            "5",
            str(needed),
            judge_within(needed, 1, 5),
            "the paper's equations, here with h = 0 at the vertex",
        ),
        PaperStatement(
            "the same, of `measure`",
            "",
            str(_count_iterations(ours_mm)),
            Agreement.UNSTATED,
            "it counts the change that is still to come, and ends at 1e-9 mm",
        ),
    ]
    curves = {
        "the paper's iteration": (np.arange(1.0, _ITERATIONS + 1), np.array(reference.changes_mm)),
        "measure: its bins, then all pixels": (np.arange(1.0, len(ours_mm) + 1), np.array(ours_mm)),
    }
    drawn = pictures.draw_curves(
        curves, "iteration", "largest change of height, mm", logarithmic=True, level=_THRESHOLD_MM
    )
    numbers = {
        "iterations_to_threshold": needed,
        # What is below the rounding of the heights differs between machines.
        "changes_mm": [change for change in reference.changes_mm if change > _ROUNDING_MM],
        "measure_changes_mm": [change for change in ours_mm if change > _ROUNDING_MM],
    }
    return PartResult(comparisons, numbers, {"convergence": drawn})


def compare_starts(bench: MeasuredBench) -> PartResult:
    """Paraboloids of 10 to 100 mm, a cone and a V-fold, each to its solution."""
    radius_mm = bench.optics.mirror.radius_mm
    starts = {f"paraboloid {depth:g} mm": make_parabola(depth, radius_mm) for depth in _STARTS_MM}
    starts |= {"cone": make_cone(40.0, radius_mm), "V-fold": make_v_fold(40.0, radius_mm)}
    grid = ApertureGrid.over_disc(bench.optics.mirror.analysis_radius_mm, _SIDE)
    x_mm = grid.x_mm
    y_mm = grid.y_mm

    # Each start to its solution, by the paper's iteration and by that of `measure`.
    heights_mm = {}
    ours_mm = {}
    curves = {}
    for name, start in starts.items():
        found = solve_by_paper(bench, start, _NINE)
        heights_mm[name] = found.surface.height_mm(x_mm.ravel(), y_mm.ravel()).reshape(x_mm.shape)
        curves[name] = (np.arange(1.0, _NINE + 1), np.array(found.changes_mm))
        ours_mm[name] = _solve_by_measure(bench, start.height_mm).height(x_mm, y_mm)

    # The largest difference between the solutions.
    reference = heights_mm[_PAPER_START]
    own = ours_mm[_PAPER_START]
    spread_mm = max(_find_largest(grid.clip_map(each - reference)) for each in heights_mm.values())
    own_spread_mm = max(_find_largest(grid.clip_map(each - own)) for each in ours_mm.values())
    largest_mm = _find_largest(grid.clip_map(reference))
    comparisons = [
        PaperStatement(
            "largest difference between the solutions after nine iterations, mm",
            "<= 1e-16",
            f"{spread_mm:.1e}",
            Agreement.REPRODUCED if spread_mm < _ROUNDING_MM else Agreement.DIFFERS,
            f"the same to the rounding, if below {_ROUNDING_MM:g} mm: at the edge, "
            f"{largest_mm:.0f} mm high, double precision resolves {np.spacing(largest_mm):.0e} mm, "
            "and 1e-16 mm cannot be a difference of two heights",
        ),
        PaperStatement(
            "the same, of `measure`, mm",
            "",
            f"{own_spread_mm:.1e}",
            Agreement.UNSTATED,
            "it ends where the change that is still to come is below 1e-9 mm",
        ),
    ]

    # Pictures: starting shapes, solutions and convergence.
    shapes = {
        name: grid.clip_map(starts[name].height_mm(x_mm, y_mm))
        for name in (_PAPER_START, "cone", "V-fold")
    }
    residuals = {
        f"{name}, solution less that of the paraboloid": grid.clip_map(heights_mm[name] - reference)
        for name in ("cone", "V-fold")
    }
    drawn = {
        "starting shapes": pictures.draw_maps(shapes, grid.axis_mm, "mm"),
        "solutions": pictures.draw_maps(residuals, grid.axis_mm, "mm"),
        "convergence from each start": pictures.draw_curves(
            curves, "iteration", "largest change of height, mm", logarithmic=True
        ),
    }
    numbers = {
        "starts": list(starts),
        "same_to_rounding": bool(spread_mm < _ROUNDING_MM),
        "measure_within_1e-9_mm": bool(own_spread_mm < 1e-9),
    }
    return PartResult(comparisons, numbers, drawn)


def _solve_by_measure(bench: MeasuredBench, start: HeightFunction) -> Surface:
    """The solution of `measure` on the bins of the set."""
    state = bench.checked.state
    points = state.points.subset(np.ones(state.index.size, bool))
    fit = fit_surface(bench.checked.tracer, points, start, tolerance_mm=_LAST_CHANGE_MM)
    return fit.surface


def _count_iterations(changes_mm: list[float]) -> int:
    """Number of the first iteration with a change below the threshold; 0 if there is none."""
    below = [number for number, change in enumerate(changes_mm, 1) if change < _THRESHOLD_MM]
    return below[0] if below else 0


def _find_largest(difference_mm: FloatArray) -> float:
    return float(np.nanmax(np.abs(difference_mm)))
