"""Which measured figures show the film now, and the displacement of the centre that they give. Pure.

Loop, estimator and protections use the same figures: one that cannot be used counts as missing for all of them.
"""

import math
from enum import Enum

from membrane_ctrl.config.schema import Config
from membrane_ctrl.control.filters import LowPass
from membrane_ctrl.controller.jumps import JumpGate
from membrane_ctrl.model.shape_estimate import ShapeEstimate

# The loop needs a figure younger than this, or than so many intervals of the tracking.
_LOOP_AGE_S, _LOOP_INTERVALS = 1.0, 5
# Range and limits may be judged by an older one: two cycles, in which the pump lifts the film by at most 26 um.
_GUARD_AGE_S = 5.0
_JUMPED = 5  # figures in a row that no film can show; one or two are bad figures
_REPEATS = 3  # no two figures have the same noise
# Compiling on a slow machine, and the self-test of screen and camera.
_CAMERA_STARTS_S = 900.0
# The configured sag is known within this factor; a wrong unit or sign is further off.
_SAG_FACTOR = 2.0
# The optics' zero against the laser's reading is a mean over this: a mount at 2 um/min is 2 um ahead of it.
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


class FigureGate:
    """Accepts figures, and derives the displacement that the laser would read.

    Without a laser displacement 0 is a sag of `optics.mirror.sag_mm`. With one the difference of sag and laser is
    followed while both are there, so that the optics continue at the laser's last reading when it is lost.

    Attributes
    ----------
    accepted : ShapeEstimate or None
        This tick's figure, if it can be used.
    sag_um : float
        Sag by the newest figure; NaN if that is older than range and limits may be judged by.
    unseen : FilmUnseen or None
        Why there is no displacement for the loop; None if there is one.
    """

    def __init__(self, config: Config) -> None:
        self._tracks = config.shape.mode == "track"
        self._by_optics = config.by_optics
        self._sag_um = 1e3 * config.optics.mirror.sag_mm
        self._loop_age_s = max(_LOOP_AGE_S, _LOOP_INTERVALS / config.shape.track_rate_hz) if self._tracks else 0.0
        self._guard_age_s = self._loop_age_s if config.by_optics else _GUARD_AGE_S
        # A figure less certain than the band cannot hold the mirror within it.
        self._sigma_max_um = config.limits.band_um
        self._zero_um = LowPass(_ALIGN_S, early_mean=True)
        if config.by_optics:
            self._zero_um.reset(1e3 * config.optics.mirror.sag_mm)
        self._jumps = JumpGate(config.limits.step_max_um)
        self._newest_sag_um = self._newest_s = self._first_tick_s = math.nan
        self._now_s = math.nan
        self._repeats = 0
        self._defect: FigureDefect | None = None
        self._defect_detail = ""
        self.waited_s = 0.0  # for the first figure
        self.accepted: ShapeEstimate | None = None

    def take(self, now_s: float, figure: ShapeEstimate | None, laser_um: float) -> None:
        """Judge this tick's figure, if there is one; `laser_um` is NaN without a good reading."""
        self._now_s = now_s
        self.accepted = None
        if math.isnan(self._first_tick_s):
            self._first_tick_s = now_s
        if math.isnan(self._newest_sag_um):
            self.waited_s = min(now_s - self._first_tick_s, _CAMERA_STARTS_S)
        if figure is None:
            return
        self._defect = self._find_defect(figure, now_s, laser_um)
        if self._defect is None:
            self._accept(figure, laser_um)

    def _find_defect(self, figure: ShapeEstimate, now_s: float, laser_um: float) -> FigureDefect | None:
        self._defect_detail = ""
        if figure.verdict == "rejected":
            self._defect_detail = figure.reason
            return FigureDefect.REJECTED
        if figure.kind == "full" and self._tracks:  # shows another sag than the frames after it
            return FigureDefect.ANCHOR
        if not math.isfinite(figure.sag_um):
            return FigureDefect.NOT_FINITE
        if not self._sag_um / _SAG_FACTOR <= figure.sag_um <= _SAG_FACTOR * self._sag_um:
            return FigureDefect.OTHER_MIRROR
        if not 0.0 <= figure.sag_sigma_um <= self._sigma_max_um:
            return FigureDefect.SIGMA
        if not figure.time_s <= now_s or figure.time_s <= self._newest_s:
            return FigureDefect.TIME
        if now_s - self._newest_s > _GUARD_AGE_S and math.isfinite(laser_um):
            self._jumps.forget()  # the film may have moved meanwhile; the laser judges
        if self._jumps.refuse(figure.sag_um):
            self._defect_detail = f"by {figure.sag_um - self._newest_sag_um:+.0f} um"
            return FigureDefect.JUMP
        return None

    def _accept(self, figure: ShapeEstimate, laser_um: float) -> None:
        self.accepted = figure
        self._repeats = self._repeats + 1 if figure.sag_um == self._newest_sag_um else 0
        interval_s = figure.time_s - self._newest_s
        self._newest_sag_um, self._newest_s = figure.sag_um, figure.time_s
        if self._by_optics or self._repeats >= _REPEATS or not math.isfinite(laser_um):
            return
        at_exposure_um = figure.displacement_um if math.isfinite(figure.displacement_um) else laser_um
        self._zero_um.update(figure.sag_um - at_exposure_um, interval_s if math.isfinite(interval_s) else 0.0)

    @property
    def newest_age_s(self) -> float:
        """Age of the newest accepted figure; NaN before the first."""
        return self._now_s - self._newest_s

    @property
    def _sound(self) -> bool:
        return self._repeats < _REPEATS and self._jumps.count < _JUMPED

    @property
    def sag_um(self) -> float:
        """Sag by the newest figure, um; NaN if it is too old for range and limits, or repeats itself."""
        return self._newest_sag_um if self._sound and self.newest_age_s <= self._guard_age_s else math.nan

    @property
    def zero_um(self) -> float:
        """Sag at displacement 0, um; NaN until sag and laser have been compared."""
        return self._zero_um.value

    @property
    def guard_um(self) -> float:
        """Displacement by which range and limits may be judged, um; NaN without one."""
        return self.sag_um - self._zero_um.value

    @property
    def loop_um(self) -> float:
        """Displacement that a loop may follow, um; NaN without one."""
        return self.guard_um if self.newest_age_s <= self._loop_age_s else math.nan

    @property
    def unseen(self) -> FilmUnseen | None:
        """Why `loop_um` is NaN; None if it is not."""
        if math.isfinite(self.loop_um):
            return None
        if self._repeats >= _REPEATS:
            return FilmUnseen.REPEATS
        if math.isnan(self._newest_s):
            return FilmUnseen.NO_FIGURE_YET
        return FilmUnseen.NOT_ALIGNED if math.isnan(self._zero_um.value) else FilmUnseen.NO_FIGURE

    def describe_unseen(self) -> str:
        """One phrase on why `loop_um` is NaN; empty if it is not."""
        unseen = self.unseen
        if unseen is None:
            return ""
        age = f" for {self.newest_age_s:.1f} s" if unseen is FilmUnseen.NO_FIGURE else ""
        if self._defect is None or unseen in (FilmUnseen.REPEATS, FilmUnseen.NOT_ALIGNED):
            return f"{unseen.value}{age}"
        phrase = self._defect_detail if self._defect is FigureDefect.REJECTED else self._defect.value
        detail = f" {self._defect_detail}" if self._defect is FigureDefect.JUMP else ""
        return f"{unseen.value}{age}: {phrase}{detail}"
