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

from membrane_ctrl.metrology.numerics.grouped_sums import sums_by
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
)
from membrane_ctrl.model.arrays import AnyArray, FloatArray

_RENEWED_EVERY_S = 0.4
# variance of a frame's saddle since the first frames, over that of a frame: their mean has errors
_SADDLE_VARIANCE = 1.5
_BLOCKS = 14  # squares along the diameter whose errors count as independent, as in `FrameFitter`


@dataclass(frozen=True)
class _Scores:
    """Products with the slopes that no surface has."""

    left: FloatArray  # q (components,)
    covariance: FloatArray  # (components, components): from the scatter of squares of the mirror
    gram: FloatArray  # G (components, components)


@dataclass
class _FirstSaddle:
    """Saddle of the ring in the first frames.

    An error of the reference is a saddle of all frames: they are compared with the first ones.
    """

    mean_mm: FloatArray = field(default_factory=lambda: np.zeros(2))  # since the reference
    count: int = 0  # frames in it
    is_settled: bool = False  # the first five steps have given the bins their phases

    def compare(self, saddle_mm: FloatArray) -> FloatArray:
        """Change (2,) since the first frames of a saddle since the reference (2,)."""
        if not self.is_settled and self.count < ENOUGH_STEPS:
            self.count += 1
            self.mean_mm = self.mean_mm + (saddle_mm - self.mean_mm) / self.count
        return saddle_mm - self.mean_mm

    def settle(self, moved_mm: FloatArray) -> None:
        """Take no more frames; the first five steps have moved their figures."""
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
    _anchor: _Scores = field(init=False)  # what the bins' own phases took

    def __post_init__(self) -> None:
        scene = self._reference = self.fitter.scene
        cells = scene.cells
        # Motions vary slowly over the mirror: one ray in the middle of each cell is enough.
        rays = cells.planes(scene.points.rays)[:, 0].astype(float)
        rays /= np.linalg.norm(rays, axis=0)
        points = ray_tracing.Points.of(rays, np.zeros((2, rays.shape[1])))
        scene.tracer.start(points, scene.surface.height)
        scene.tracer.intersect(points, scene.surface, newton=2)
        changes_mm = bench_motions.screen_changes(
            scene.tracer.geometry,
            points.rays,
            points.t_mm,
            scene.surface,
            scene.tracer.vertex_z_mm,
        )
        jacobian = self.fitter.jacobian[:, :, 0].astype(float)
        weights = cells.sums(self._bin_weights(scene)).astype(float)
        self._effects = MotionEffects.of(scene.rad_per_mm * changes_mm, jacobian, weights)
        place = (scene.position_mm / scene.surface.radius_mm + 1) / 2 * _BLOCKS
        column, row = np.floor(cells.planes(place)[:, 0]).astype(int)
        self._square = (row + 1) * (_BLOCKS + 2) + column + 1
        self._saddle = _FirstSaddle()
        self._test: MotionTest | None = None
        self._tested_s = math.nan
        self._before = none = np.zeros(bench_motions.COMPONENTS)
        square = np.zeros((none.size, none.size))
        self._anchor = _Scores(none, square, self._effects.gram(weights))

    @staticmethod
    def _bin_weights(scene: CrossedScene) -> FloatArray:
        """Weights (2, n) of the phases of x and y: mean squares of the light's derivatives."""
        return np.asarray(scene.light_adu[1:] ** 2 * scene.edge / 2)

    def take_scene(self, scene: CrossedScene, moved_mm: FloatArray) -> None:
        """Keep what the bins' own phases of a new scene have taken since the reference.

        `moved_mm` (parameters,) is by how much the figures of its steps move with it.
        """
        self._saddle.settle(ring_saddle() @ moved_mm)
        weights = self._bin_weights(scene)
        moved_rad = (scene.beyond_mm - self._reference.beyond_mm) * scene.rad_per_mm
        self._anchor = self._scores(weights * moved_rad, weights)
        self._test = None

    def _scores(self, values: AnyArray, weights: AnyArray) -> _Scores:
        """Of weighted phase errors (2, n) of the bins and their weights (2, n)."""
        cells = self._reference.cells
        sums = cells.sums(values).astype(float)
        left = self._effects.left
        parts = np.einsum("kan,an->kn", left, sums)
        squares = sums_by(self._square, parts, (_BLOCKS + 2) ** 2)
        gram = self._effects.gram(cells.sums(weights).astype(float))
        return _Scores(parts.sum(axis=1), squares @ squares.T, gram)

    def find(
        self,
        fit: FrameFit,
        shifts_rad: Shifts,
        fitter: FrameFitter,
        covariance_mm2: FloatArray,
        time_s: float,
    ) -> MotionFinding:
        """The motions that explain a frame.

        `fitter` is that of the frame, `covariance_mm2` (parameters, parameters) that of its fit.
        How well all is known is renewed twice a second: it costs a fifth of a fit.
        """
        errors, weights = fitter.phase_errors(fit, shifts_rad)
        if self._test is None or not abs(time_s - self._tested_s) < _RENEWED_EVERY_S:
            self._tested_s = time_s
            self._renew_test(self._scores(errors, weights), covariance_mm2)
        assert self._test is not None
        sums = self._reference.cells.sums(errors).astype(float)
        signatures = self._effects.left.reshape(len(self._before), -1)
        left = signatures @ sums.ravel() + self._before
        moved_mm = fit.surface.parameters - self._reference.surface.parameters
        saddle_mm = self._saddle.compare(ring_saddle() @ moved_mm)
        return self._test.find(ring_tilt() @ moved_mm, saddle_mm, left)

    def _renew_test(self, now: _Scores, covariance_mm2: FloatArray) -> None:
        """Take from a frame how well ring and slopes are known."""
        before, ring, saddle = self._anchor, ring_tilt(), ring_saddle()
        # A frame shows less than five steps where a hand covers it: both in the frame's weights.
        share = float(np.trace(now.gram) / np.trace(before.gram))
        self._before = share * before.left
        self._test = MotionTest(
            self._effects,
            ring @ covariance_mm2 @ ring.T,
            SlopeEvidence(now.covariance + share**2 * before.covariance, now.gram),
            _SADDLE_VARIANCE * (saddle @ covariance_mm2 @ saddle.T),
        )

    def tilt_urad(self, shape: Surface) -> float:
        """Tilt of the ring since the reference."""
        moved_mm = shape.parameters - self._reference.surface.parameters
        return 1e6 * math.hypot(*(ring_tilt() @ moved_mm)) / shape.radius_mm
