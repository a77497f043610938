"""Whether camera, screen, lens or mirror have moved since the reference of a tracked set.

A frame is fitted with the reference's geometry. A camera that turns by 5 µrad looks like a film
with other coma. Each frame is therefore compared with the signatures of all small motions
(`motion_evidence`): the ring's tilt since the reference, its saddle since the first frames, and the
light that the fit leaves along slopes that no surface has. Five steps of the pattern make new
phases for the bins; what they take for the bins' own is added to the evidence, so that a motion is
not lost in a new anchor.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from membrane_ctrl.metrology.numerics.grouped_sums import sum_by_group
from membrane_ctrl.metrology.rays import bench_motions, ray_tracing
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.tracking.crossed_scene import CrossedScene
from membrane_ctrl.metrology.tracking.frame_fit import FrameFit, FrameFitter, Shifts
from membrane_ctrl.metrology.tracking.step_solution import ENOUGH_STEPS
from membrane_ctrl.metrology.uncertainty.motion_evidence import (
    MotionEffects,
    MotionFinding,
    MotionTest,
    SlopeEvidence,
    ring_saddle,
    ring_tilt,
    ring_tilt_urad,
)
from membrane_ctrl.model.arrays import AnyArray, FloatArray

_RENEWED_EVERY_S = 0.4
# Variance of a frame's saddle since the first frames over that of a frame's saddle: the mean of the
# first frames has errors.
_SADDLE_VARIANCE = 1.5
_BLOCKS = 14  # squares along the diameter whose errors count as independent, as in `FrameFitter`


@dataclass(frozen=True)
class _Scores:
    """Products of phase errors with the slopes of motions that no surface has.

    Attributes
    ----------
    left : (components,) array
        q.
    covariance : (components, components) array
        Covariance of q, from the scatter of squares of the mirror.
    gram : (components, components) array
        G.
    """

    left: FloatArray
    covariance: FloatArray
    gram: FloatArray


@dataclass
class _FirstSaddle:
    """Saddle of the ring in the first frames.

    An error of the reference is a saddle of all frames: they are compared with the first ones.

    Attributes
    ----------
    mean_mm : (2,) array
        Mean saddle of the first frames since the reference.
    count : int
        Frames in the mean.
    is_settled : bool
        Whether the first five steps have given the bins their phases.
    """

    mean_mm: FloatArray = field(default_factory=lambda: np.zeros(2))
    count: int = 0
    is_settled: bool = False

    def subtract_first(self, saddle_mm: FloatArray) -> FloatArray:
        """Change (2,) since the first frames of a saddle since the reference (2,)."""
        if not self.is_settled and self.count < ENOUGH_STEPS:
            self.count += 1
            self.mean_mm = self.mean_mm + (saddle_mm - self.mean_mm) / self.count
        return saddle_mm - self.mean_mm

    def end_first_frames(self, moved_mm: FloatArray) -> None:
        """Take no more frames: the first five steps have moved the saddles (2,) of their figures by
        `moved_mm`.
        """
        if not self.is_settled:
            self.mean_mm = self.mean_mm + moved_mm
            self.is_settled = True


@dataclass
class BenchWatch:
    """Compares frames with the signatures of motions.

    Parameters
    ----------
    fitter : FrameFitter
        Of the reference's scene.
    """

    fitter: FrameFitter
    _effects: MotionEffects = field(init=False)
    _reference: CrossedScene = field(init=False)
    _anchor: _Scores = field(init=False)  # the part that the bins' own phases contain

    def __post_init__(self) -> None:
        scene = self.fitter.scene
        cells = scene.cells
        self._reference = scene

        # Signatures of the motions. They vary slowly over the mirror: one ray in the middle of each
        # cell is enough.
        rays = cells.fit_planes(scene.points.rays)[:, 0].astype(float)
        rays /= np.linalg.norm(rays, axis=0)
        points = ray_tracing.Points.from_rays(rays, np.zeros((2, rays.shape[1])))
        scene.tracer.place_on_shape(points, scene.surface.height)
        scene.tracer.intersect(points, scene.surface, newton=2)
        changes_mm = bench_motions.screen_changes(
            scene.tracer.geometry,
            points.rays,
            points.t_mm,
            scene.surface,
            scene.tracer.vertex_z_mm,
        )
        jacobian = self.fitter.jacobian[:, :, 0].astype(float)
        weights = cells.sum_cells(self._bin_weights(scene)).astype(float)
        self._effects = MotionEffects.from_changes(scene.rad_per_mm * changes_mm, jacobian, weights)

        # The square of the mirror that each cell is in.
        place = (scene.position_mm / scene.surface.radius_mm + 1) / 2 * _BLOCKS
        column, row = np.floor(cells.fit_planes(place)[:, 0]).astype(int)
        self._square = (row + 1) * (_BLOCKS + 2) + column + 1

        # What is known of the frames so far: nothing.
        none = np.zeros(bench_motions.COMPONENTS)
        no_scatter = np.zeros((none.size, none.size))
        self._saddle = _FirstSaddle()
        self._test: MotionTest | None = None
        self._tested_s = math.nan
        self._anchor_left = none
        self._anchor = _Scores(none, no_scatter, self._effects.gram(weights))

    @staticmethod
    def _bin_weights(scene: CrossedScene) -> FloatArray:
        """Weights (2, n) of the phases of x and y: mean squares of the light's derivatives."""
        return np.asarray(scene.light_adu[1:] ** 2 * scene.edge / 2)

    def take_scene(self, scene: CrossedScene, moved_mm: FloatArray) -> None:
        """Keep the evidence that the bins' own phases of a new scene contain.

        Parameters
        ----------
        scene : CrossedScene
            The new scene.
        moved_mm : (parameters,) array
            Change of the figures of its steps.
        """
        self._saddle.end_first_frames(ring_saddle() @ moved_mm)
        weights = self._bin_weights(scene)
        moved_rad = (scene.beyond_mm - self._reference.beyond_mm) * scene.rad_per_mm
        self._anchor = self._scores(weights * moved_rad, weights)
        self._test = None

    def _scores(self, values: AnyArray, weights: AnyArray) -> _Scores:
        """Scores of weighted phase errors (2, n) of the bins, with their weights (2, n)."""
        cells = self._reference.cells
        sums = cells.sum_cells(values).astype(float)
        parts = np.einsum("kan,an->kn", self._effects.left, sums)
        squares = sum_by_group(self._square, parts, (_BLOCKS + 2) ** 2)
        gram = self._effects.gram(cells.sum_cells(weights).astype(float))
        return _Scores(parts.sum(axis=1), squares @ squares.T, gram)

    def find(
        self,
        fit: FrameFit,
        shifts_rad: Shifts,
        fitter: FrameFitter,
        covariance_mm2: FloatArray,
        time_s: float,
    ) -> MotionFinding:
        """Find the motions that explain a frame.

        The covariances of the test are renewed twice a second: they cost a fifth of a fit.

        Parameters
        ----------
        fit : FrameFit
            The frame's solution.
        shifts_rad : (float, float)
            Its phase steps.
        fitter : FrameFitter
            Which made the fit.
        covariance_mm2 : (parameters, parameters) array
            Covariance of the fit.
        time_s : float
            Time of the frame.
        """
        errors, weights = fitter.phase_errors(fit, shifts_rad)
        if self._test is None or not abs(time_s - self._tested_s) < _RENEWED_EVERY_S:
            self._tested_s = time_s
            self._renew_test(self._scores(errors, weights), covariance_mm2)
        assert self._test is not None

        # Evidence of the slopes that no surface has: of this frame, and of the bins' own phases.
        sums = self._reference.cells.sum_cells(errors).astype(float)
        signatures = self._effects.left.reshape(len(self._anchor_left), -1)
        left = signatures @ sums.ravel() + self._anchor_left

        # Evidence of the ring: its tilt since the reference, its saddle since the first frames.
        moved_mm = fit.surface.parameters - self._reference.surface.parameters
        saddle_mm = self._saddle.subtract_first(ring_saddle() @ moved_mm)
        return self._test.find_motions(ring_tilt() @ moved_mm, saddle_mm, left)

    def _renew_test(self, of_frame: _Scores, covariance_mm2: FloatArray) -> None:
        """Renew the covariances of ring and slopes from a frame.

        `covariance_mm2` (parameters, parameters) is that of its fit.
        """
        tilt = ring_tilt()
        saddle = ring_saddle()
        # A hand may cover bins of this frame that the five steps saw: both count with the frame's
        # weights.
        share = float(np.trace(of_frame.gram) / np.trace(self._anchor.gram))
        self._anchor_left = share * self._anchor.left
        slopes_covariance = of_frame.covariance + share**2 * self._anchor.covariance
        self._test = MotionTest(
            self._effects,
            tilt @ covariance_mm2 @ tilt.T,
            SlopeEvidence(slopes_covariance, of_frame.gram),
            _SADDLE_VARIANCE * (saddle @ covariance_mm2 @ saddle.T),
        )

    def tilt_urad(self, shape: Surface) -> float:
        """Tilt of the ring since the reference."""
        return ring_tilt_urad(self._reference.surface, shape)
