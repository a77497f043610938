"""Which measured figures show the film now, and the displacement of the centre that they give.
Pure.

Loop, estimator and protections use the same figures: one that cannot be used counts as missing for
all of them.
"""

import math
from dataclasses import dataclass, field
from enum import Enum

from membrane_ctrl.config.schema import Config
from membrane_ctrl.control.filters import LowPass
from membrane_ctrl.controller.jumps import JumpGate
from membrane_ctrl.model.reason import NO_REASON, Reason, WhyCode, make_reason
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.state_tree import Count, StateNode

# The loop needs a figure younger than this, or than so many intervals of the tracking.
_LOOP_AGE_S, _LOOP_INTERVALS = 1.0, 5
# Range and limits may be judged by an older one: two cycles, in which the pump lifts the film by at
# most 26 µm.
_GUARD_AGE_S = 5.0
_JUMPED = 5  # figures in a row that no film can show; one or two are bad figures
_REPEATS = 3  # no two figures have the same noise
# Compiling on a slow machine, and the self-test of screen and camera.
_CAMERA_STARTS_S = 900.0
# The configured sag is known within this factor; a wrong unit or sign is further off.
_SAG_FACTOR = 2.0
# The optics' zero against the laser's reading is a mean over this: a mount at 2 µm/min is 2 µm
# ahead of it.
_ALIGN_S = 60.0


class FigureDefect(Enum):
    """Why a figure cannot be used; the value is a phrase for people."""

    REJECTED = "it was rejected"
    ANCHOR = "it has only been anchored"
    NOT_FINITE = "it is not finite"
    OTHER_MIRROR = "its sag is not this mirror's"
    SIGMA = "its standard deviation is unusable"
    TIME = "its time is wrong"
    JUMP = "the sag jumped"


class FilmUnseen(Enum):
    """Why the figures show no displacement; the value is a phrase for people."""

    NO_FIGURE_YET = "no figure of the mirror yet"
    NO_FIGURE = "no figure of the mirror"
    REPEATS = "the camera repeats one figure to the last bit"
    NOT_ALIGNED = "the optics have not been compared with the laser yet"


@dataclass(slots=True)
class FigureGateState(StateNode):
    """The newest usable figure, and the zero that its sag counts from."""

    zero_um: LowPass = field(default_factory=LowPass.with_early_mean)
    jumps: JumpGate = field(default_factory=JumpGate)
    newest_sag_um: float = math.nan
    newest_s: float = math.nan
    first_tick_s: float = math.nan
    now_s: float = math.nan
    repeats: Count = 0
    defect: FigureDefect | None = None  # of the newest figure
    defect_detail: str = ""
    waited_s: float = 0.0  # for the first figure


class FigureGate:
    """Accepts figures, and derives the displacement that the laser would read.

    Without a laser displacement 0 is a sag of `optics.mirror.sag_mm`. With one the difference of
    sag and laser is followed while both are there, so that the optics continue at the laser's last
    reading when it is lost.

    Attributes
    ----------
    accepted : ShapeEstimate or None
        This tick's figure, if it can be used.
    sag_um : float
        Sag by the newest figure; NaN if that is older than range and limits may be judged by.
    unseen_reason : FilmUnseen or None
        Why there is no displacement for the loop; None if there is one.
    """

    def __init__(self, config: Config, memory: FigureGateState | None = None) -> None:
        self.memory = memory or FigureGateState()
        self._tracks = config.shape.mode == "track"
        self._by_optics = config.by_optics
        self._sag_um = 1e3 * config.optics.mirror.sag_mm
        self._loop_age_s = (
            max(_LOOP_AGE_S, _LOOP_INTERVALS / config.shape.track_rate_hz) if self._tracks else 0.0
        )
        self._guard_age_s = self._loop_age_s if config.by_optics else _GUARD_AGE_S
        # A figure less certain than the band cannot hold the mirror within it.
        self._sigma_max_um = config.limits.band_um
        if config.by_optics:
            self.memory.zero_um.reset(1e3 * config.optics.mirror.sag_mm)
        self._step_max_um = config.limits.step_max_um
        self.accepted: ShapeEstimate | None = None

    def judge_figure(self, now_s: float, figure: ShapeEstimate | None, laser_um: float) -> None:
        """Judge this tick's figure.

        Parameters
        ----------
        now_s : float
            Time of the tick, by which the figure's age counts.
        figure : ShapeEstimate or None
            None without a new one.
        laser_um : float
            NaN without a good reading.
        """
        self.memory.now_s = now_s
        self.accepted = None
        if math.isnan(self.memory.first_tick_s):
            self.memory.first_tick_s = now_s
        if math.isnan(self.memory.newest_sag_um):
            self.memory.waited_s = min(now_s - self.memory.first_tick_s, _CAMERA_STARTS_S)
        if figure is None:
            return
        self.memory.defect = self._find_defect(figure, now_s, laser_um)
        if self.memory.defect is None:
            self._accept_figure(figure, laser_um)

    def _find_defect(
        self, figure: ShapeEstimate, now_s: float, laser_um: float
    ) -> FigureDefect | None:
        """Why a figure cannot be used; the first reason that applies."""
        self.memory.defect_detail = ""
        if figure.verdict == "rejected":
            self.memory.defect_detail = figure.reason
            return FigureDefect.REJECTED
        if figure.kind == "full" and self._tracks:  # shows another sag than the frames after it
            return FigureDefect.ANCHOR
        # Is it a figure of this mirror, with an error bar, newer than the last one?
        if not math.isfinite(figure.sag_um):
            return FigureDefect.NOT_FINITE
        if not self._sag_um / _SAG_FACTOR <= figure.sag_um <= _SAG_FACTOR * self._sag_um:
            return FigureDefect.OTHER_MIRROR
        if not 0.0 <= figure.sag_change_sigma_um <= self._sigma_max_um:
            return FigureDefect.SIGMA
        if not figure.time_s <= now_s or figure.time_s <= self.memory.newest_s:
            return FigureDefect.TIME
        # A jump that no film makes; after a gap the film may have moved.
        if now_s - self.memory.newest_s > _GUARD_AGE_S and math.isfinite(laser_um):
            self.memory.jumps.reset()  # the film may have moved meanwhile; the laser judges
        if self.memory.jumps.is_jump(figure.sag_um, self._step_max_um):
            self.memory.defect_detail = f"by {figure.sag_um - self.memory.newest_sag_um:+.0f} µm"
            return FigureDefect.JUMP
        return None

    def _accept_figure(self, figure: ShapeEstimate, laser_um: float) -> None:
        """Keep the figure, and follow the difference of its sag and the laser."""
        self.accepted = figure
        # A frozen camera gives one sag again and again, to the last bit
        self.memory.repeats = (
            self.memory.repeats + 1 if figure.sag_um == self.memory.newest_sag_um else 0
        )
        interval_s = figure.time_s - self.memory.newest_s
        self.memory.newest_sag_um = figure.sag_um
        self.memory.newest_s = figure.time_s
        if self._by_optics or self.memory.repeats >= _REPEATS or not math.isfinite(laser_um):
            return
        # Compared with the laser at the time of the exposure, if that was recorded
        at_exposure_um = (
            figure.displacement_um if math.isfinite(figure.displacement_um) else laser_um
        )
        over_s = interval_s if math.isfinite(interval_s) else 0.0
        self.memory.zero_um.update(figure.sag_um - at_exposure_um, over_s, _ALIGN_S)

    @property
    def waited_s(self) -> float:
        """How long the first figure has taken, so far."""
        return self.memory.waited_s

    @property
    def newest_age_s(self) -> float:
        """Age of the newest accepted figure; NaN before the first."""
        return self.memory.now_s - self.memory.newest_s

    @property
    def _sound(self) -> bool:
        return self.memory.repeats < _REPEATS and self.memory.jumps.count < _JUMPED

    @property
    def sag_um(self) -> float:
        """Sag by the newest figure, µm; NaN if it is too old for range and limits, or repeats
        itself.
        """
        return (
            self.memory.newest_sag_um
            if self._sound and self.newest_age_s <= self._guard_age_s
            else math.nan
        )

    @property
    def zero_um(self) -> float:
        """Sag at displacement 0, µm; NaN until sag and laser have been compared."""
        return self.memory.zero_um.value

    @property
    def guard_um(self) -> float:
        """Displacement by which range and limits may be judged, µm; NaN without one."""
        return self.sag_um - self.memory.zero_um.value

    @property
    def loop_um(self) -> float:
        """Displacement that a loop may follow, µm; NaN without one."""
        return self.guard_um if self.newest_age_s <= self._loop_age_s else math.nan

    @property
    def unseen_reason(self) -> FilmUnseen | None:
        """Why `loop_um` is NaN; None if it is not."""
        if math.isfinite(self.loop_um):
            return None
        if self.memory.repeats >= _REPEATS:
            return FilmUnseen.REPEATS
        if math.isnan(self.memory.newest_s):
            return FilmUnseen.NO_FIGURE_YET
        return (
            FilmUnseen.NOT_ALIGNED
            if math.isnan(self.memory.zero_um.value)
            else FilmUnseen.NO_FIGURE
        )

    def explain_unseen(self) -> Reason:
        """Why `loop_um` is NaN; `NO_REASON` if it is not."""
        unseen, defect = self.unseen_reason, self.memory.defect
        if unseen is None:
            return NO_REASON
        defect_name = "" if defect is None else defect.name.lower()
        return make_reason(
            WhyCode.NO_READING, self._describe_unseen(unseen), unseen.name.lower(), defect_name
        )

    def _describe_unseen(self, unseen: FilmUnseen) -> str:
        age = f" for {self.newest_age_s:.1f} s" if unseen is FilmUnseen.NO_FIGURE else ""
        if self.memory.defect is None or unseen in (FilmUnseen.REPEATS, FilmUnseen.NOT_ALIGNED):
            return f"{unseen.value}{age}"
        phrase = (
            self.memory.defect_detail
            if self.memory.defect is FigureDefect.REJECTED
            else self.memory.defect.value
        )
        detail = f" {self.memory.defect_detail}" if self.memory.defect is FigureDefect.JUMP else ""
        return f"{unseen.value}{age}: {phrase}{detail}"
