"""One fit of a surface to the bins of a capture set, without given frames."""

from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.frame_checks import bin_view, image_lag
from membrane_ctrl.metrology.frame_checks.bin_orders import absolute_phases_of_bins
from membrane_ctrl.metrology.frame_checks.checked_set import Anchor, vertex_z_mm
from membrane_ctrl.metrology.frame_checks.sampled_bins import SampledBins
from membrane_ctrl.metrology.phase import frame_stack
from membrane_ctrl.metrology.phase.screen_scale import centre_phase_rad, mm_per_rad
from membrane_ctrl.metrology.rays import ray_tracing
from membrane_ctrl.metrology.rays.film_reflections import find_reflecting_rays
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.reconstruction import bin_grid, tracked_points
from membrane_ctrl.model.arrays import BoolArray, FloatArray

# A ray meets the film this far at most from where it crosses the ring's plane.
_FILM_BESIDE_PLANE_MM = 25.0


@dataclass(frozen=True)
class SetBench:
    """What all fits of a set share.

    Attributes
    ----------
    optics : OpticsConfig
        The stated bench.
    geometry : Geometry
        Its poses and lens.
    grid : BinGrid
        Bins of the sensor and their rays.
    near : (bins,) bool array
        Bins whose rays may meet the mirror.
    reflecting : (bins,) bool array
        Bins in which a front film may show the pattern again: the surface is fitted without them.
    anchor : Anchor or None
        Fringe orders of another set, for a set of fringes alone.
    """

    optics: OpticsConfig
    geometry: Geometry
    grid: bin_grid.BinGrid
    near: BoolArray
    reflecting: BoolArray
    anchor: Anchor | None

    @classmethod
    def from_optics(cls, optics: OpticsConfig, bin_px: int, anchor: Anchor | None) -> "SetBench":
        """Return the bench of sets with bins of this side.

        Parameters
        ----------
        optics : OpticsConfig
            The stated bench.
        bin_px : int
            Side of the bins.
        anchor : Anchor or None
            Fringe orders of another set.
        """
        geometry = Geometry.from_config(optics)
        grid = bin_grid.BinGrid(geometry, optics.camera, bin_px)
        near = grid.near_mirror(optics.mirror.analysis_radius_mm + _FILM_BESIDE_PLANE_MM)
        reflecting = find_reflecting_rays(geometry, optics, grid.rays)
        return cls(optics, geometry, grid, near, reflecting, anchor)


@dataclass(frozen=True)
class SetFit:
    """One fit of the bins.

    Attributes
    ----------
    view : BinView
        What the usable frames show of each bin.
    phase_rad : (2, rows, columns) array
        Absolute phases of the bins.
    tracer : Tracer
        The bench.
    state : TrackedPoints
        The bins on the mirror, and their surface.
    scene : SampledBins
        The same bins, with the phases that this surface predicts.
    """

    view: bin_view.BinView
    phase_rad: FloatArray
    tracer: ray_tracing.Tracer
    state: tracked_points.TrackedPoints
    scene: SampledBins


def fit_without_lag(
    stack: frame_stack.FrameStack,
    taken: frame_stack.Binned,
    bench: SetBench,
    excluded: set[int],
) -> tuple[frame_stack.FrameStack, frame_stack.Binned, SetFit, image_lag.ImageLag]:
    """Fit the bins without what the frames still show of the previous pictures.

    Parameters
    ----------
    stack : FrameStack
        The set.
    taken : Binned
        Its frames as the camera took them, as means over bins.
    bench : SetBench
        The bench.
    excluded : set of int
        Frames that the fit does not use.

    Returns
    -------
    stack : FrameStack
        The set with the shares of the previous pictures stated.
    binned : Binned
        The bins without these shares.
    fit : SetFit
        The fit of them.
    lag : ImageLag
        The shares.

    Raises
    ------
    NoFigureError, ValueError
        There is no fit.
    """
    stack = replace(stack, lag_shares=(0.0, 0.0))
    binned = taken
    lag = image_lag.ImageLag.unknown()
    fit = fit_set(stack, binned, bench, excluded)
    for _ in range(image_lag.ROUNDS):
        # The light and the phases to compare with contain the lag, too: each fit finds a part of
        # it.
        found = image_lag.estimate_image_lag(stack, binned, fit.scene, excluded)
        lag = image_lag.add_image_lag(lag, found)
        if not lag.corrected or not image_lag.is_worth_another_round(found):
            break
        if not any(stack.lag_shares):
            stack = image_lag.add_first_predecessor(stack, taken, fit.scene, lag)
        stack = replace(stack, lag_shares=(lag.rise, lag.fall))
        binned = image_lag.remove_image_lag(stack, taken, lag)
        fit = fit_set(stack, binned, bench, excluded)
    return stack, binned, fit, lag


def fit_set(
    stack: frame_stack.FrameStack,
    binned: frame_stack.Binned,
    bench: SetBench,
    excluded: set[int],
) -> SetFit:
    """Fit a surface to the bins, without the excluded frames.

    Parameters
    ----------
    stack, binned : FrameStack, Binned
        The set, and its frames as means over bins.
    bench : SetBench
        The bench.
    excluded : set of int
        Frames that the fit does not use.

    Returns
    -------
    SetFit

    Raises
    ------
    NoFigureError, ValueError
        There is no fit.
    """
    optics = bench.optics
    anchor = bench.anchor
    vertex_mm = vertex_z_mm(optics, stack.mean_reading_um)
    tracer = ray_tracing.Tracer(bench.geometry, optics.mirror.radius_mm, vertex_mm)

    # Light, wrapped and absolute phases of the bins.
    light_of_anchor = None
    if anchor is not None:
        light_of_anchor = anchor.light
    view = bin_view.combine_frames(stack, binned, excluded, light_of_anchor)
    phase_rad = absolute_phases_of_bins(stack, binned, view, anchor, optics)

    # The surface that explains them.
    candidates = np.flatnonzero(bench.near & ~bench.reflecting)
    phase_of_candidates_rad = phase_rad.reshape(2, -1)[:, candidates]
    state = tracked_points.select_points(
        bench.grid,
        tracer,
        candidates,
        phase_of_candidates_rad,
        optics.pattern,
        optics.mirror.analysis_radius_mm,
    )

    # What it predicts.
    screen_mm = tracer.predict_screen(state.points, state.surface)
    predicted_rad = screen_mm / mm_per_rad(optics.pattern) + centre_phase_rad(optics.pattern)
    light = view.light.reshape(-1)[state.index]
    places_px = np.stack([bench.grid.column_px, bench.grid.row_px])[:, state.index]
    scene = SampledBins(state.index, light, predicted_rad, state.sensitivity_rad_per_um, places_px)
    return SetFit(view, phase_rad, tracer, state, scene)
