"""The figure of one capture set on disk from its bins: what the analyses of many sets call."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from membrane_ctrl.calibration.geometry_file import GeometryFile
from membrane_ctrl.errors import CommandError, RejectedError
from membrane_ctrl.estimate import Verdict
from membrane_ctrl.metrology.bin_figure import BinFigure, bin_figure
from membrane_ctrl.metrology.checked import Anchor, Checked, RejectedSetError, check
from membrane_ctrl.metrology.monte_carlo import TrialBench
from membrane_ctrl.metrology.quality import judge
from membrane_ctrl.sets.capture_set import CaptureHead, anchored, read_set
from membrane_ctrl.sets.measurement import read_anchor, stack_of


@dataclass(frozen=True)
class SetFigure:
    """A set that gave a figure.

    Attributes
    ----------
    head : CaptureHead
        What the set says of itself.
    checked, figure : Checked, BinFigure
        Its frames and its surface.
    verdict : "ok" or "degraded"
        With its reason.
    time_s, displacement_um : float
        Means over the sinusoids; NaN where the set says nothing.
    """

    head: CaptureHead
    checked: Checked
    figure: BinFigure
    verdict: Verdict
    reason: str
    time_s: float
    displacement_um: float

    def bench(self) -> TrialBench:
        """For Monte Carlo trials."""
        return TrialBench.of(self.head.optics, self.checked, self.figure)


class Figures:
    """Figures of sets, one after the other; remembers the last reference, which most sets of a run share.

    Parameters
    ----------
    geometry : GeometryFile, optional
        Used instead of the sets' own.
    """

    def __init__(self, geometry: GeometryFile | None = None) -> None:
        self._geometry = geometry
        self._reference: Path | None = None
        self._anchor: tuple[CaptureHead, Anchor] | CommandError = CommandError("no reference read yet")

    def of(self, folder: Path) -> SetFigure:
        """Read and measure a set.

        Raises
        ------
        InputError
            If the set or its reference is not one.
        RejectedError
            If its frames give no figure that may be used.
        """
        capture = read_set(folder, self._geometry)
        anchor = None
        if capture.head.reference is not None:
            reference, anchor = self._anchored_by(capture.head.reference)
            capture = replace(capture, head=anchored(capture.head, reference))
        optics = capture.head.optics
        try:
            stack = stack_of(capture)
            checked = check(stack, optics, anchor)
        except RejectedSetError as error:
            raise RejectedError(f"{folder}: rejected: {error}") from None
        figure = bin_figure(optics, checked)
        verdict, reason = judge(figure.quality)
        if verdict == "rejected":
            raise RejectedError(f"{folder}: rejected: {reason}")
        if verdict == "ok":
            verdict, reason = checked.verdict
        return SetFigure(
            capture.head, checked, figure, verdict, reason, _middle_s(capture.head), stack.mean_reading_um
        )

    def _anchored_by(self, reference: Path) -> tuple[CaptureHead, Anchor]:
        if reference != self._reference:
            self._reference = reference
            try:
                self._anchor = read_anchor(reference, self._geometry)
            except CommandError as error:
                self._anchor = error
        if isinstance(self._anchor, CommandError):
            raise self._anchor
        return self._anchor


def _middle_s(head: CaptureHead) -> float:
    """Mean start of exposure of the sinusoids."""
    times = np.array([t for t, pattern in zip(head.time_s, head.patterns, strict=True) if pattern.role == "sin"])
    return float(times.mean()) if times.size else math.nan
