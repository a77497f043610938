"""Measures one capture set on disk in full, for `measure` and every analysis of many sets."""

import math
import time
from dataclasses import dataclass, replace
from pathlib import Path

from membrane_ctrl.geometry.file import GeometryFile
from membrane_ctrl.geometry.run_geometry import require_plausible
from membrane_ctrl.measure.capture_set import CaptureHead, CaptureSet, anchor_head, read_set
from membrane_ctrl.metrology.figure.bin_figure import BinFigure, bin_figure
from membrane_ctrl.metrology.figure.pixel_figure import FullResult, measure_pixels, reconstruct_full
from membrane_ctrl.metrology.frame_checks import frame_faults
from membrane_ctrl.metrology.frame_checks.checked_set import Anchor, Checked, RejectedSetError
from membrane_ctrl.metrology.frame_checks.multi_frequency import check_frequencies
from membrane_ctrl.metrology.frame_checks.set_check import check_set
from membrane_ctrl.metrology.phase import frame_stack
from membrane_ctrl.metrology.rays.artefacts import Artefact
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench
from membrane_ctrl.model import errors, shape_estimate


@dataclass(frozen=True)
class Measurement:
    """Result of a capture set.

    Attributes
    ----------
    head : CaptureHead
        The set.
    verdict : "ok", "degraded" or "rejected"
        By the worst finding.
    reason : str
        That finding, for people; empty if the verdict is "ok".
    flags : tuple of Flag
        Frames that do not belong to the set.
    checked, full : Checked, FullResult or None
        None where the frames gave no figure.
    displacement_um : float
        Mean laser reading during the sinusoids, to which the figure belongs; NaN without readings.
    timing_s : dict
        Seconds for "load", "phase" and "reconstruct".
    rejected_saturated_fraction : float
        Share of bins clipped at white in a set without a figure; NaN if it was not determined.
    """

    head: CaptureHead
    verdict: shape_estimate.Verdict
    reason: str
    flags: tuple[frame_faults.Flag, ...]
    checked: Checked | None
    full: FullResult | None
    displacement_um: float
    timing_s: dict[str, float]
    rejected_saturated_fraction: float = math.nan

    def flagged_files(self) -> list[dict[str, str]]:
        """The flagged frames by file name."""
        return [{"file": self.head.files[flag.frame], "reason": flag.reason} for flag in self.flags]


def measure_set(folder: str | Path, geometry: GeometryFile | None = None) -> Measurement:
    """Measure one set, whatever its frames show.

    Parameters
    ----------
    folder : str or Path
        The set.
    geometry : GeometryFile or None
        Replaces the set's own.

    Returns
    -------
    Measurement
        With the verdict; a set that gives no figure is `rejected`, which is no error.

    Raises
    ------
    InputError
        The set or its reference is invalid.
    """
    # The set, and the one that has its fringe orders. It need not state its film's depth.
    begin = time.perf_counter()
    capture = read_set(folder, geometry)
    where = capture.head.folder / "capture.toml"
    if geometry is not None:
        where = geometry.path
    require_plausible(capture.head.optics, where, depth_known=False)
    anchor = None
    if capture.head.reference is not None:
        reference, anchor = read_anchor(capture.head.reference, geometry)
        capture = replace(capture, head=anchor_head(capture.head, reference))
    optics = capture.head.optics
    loaded = time.perf_counter()

    # Its frames, without those that do not belong.
    try:
        checked = checked_set(capture, anchor)
    except RejectedSetError as error:
        timing = {"load": loaded - begin, "phase": time.perf_counter() - loaded, "reconstruct": 0.0}
        mean_um = capture.head.mean_reading_um
        return Measurement(
            capture.head,
            "rejected",
            str(error),
            error.flags,
            None,
            None,
            mean_um,
            timing,
            error.saturated_fraction,
        )

    # The figure from every pixel, and its verdict. After the pixels' phases no frames are needed:
    # they are large.
    pixels = measure_pixels(optics, checked)
    head = capture.head
    del capture
    checked = replace(checked, stack=checked.stack.drop_frames())
    middle = time.perf_counter()
    full = reconstruct_full(optics, checked, pixels)
    end = time.perf_counter()
    verdict, reason = shape_estimate.judge_quality(full.quality)
    if verdict == "ok":
        verdict, reason = checked.verdict
    reflections = full.reflections
    if reflections is not None and reflections.doubt and verdict != "rejected":
        reasons = [part for part in (reason, reflections.doubt) if part]
        verdict = "degraded"
        reason = "; ".join(reasons)
    timing = {"load": loaded - begin, "phase": middle - loaded, "reconstruct": end - middle}

    mean_um = checked.stack.mean_reading_um
    return Measurement(head, verdict, reason, checked.flags, checked, full, mean_um, timing)


def read_anchor(
    folder: str | Path, geometry: GeometryFile | None = None
) -> tuple[CaptureHead, Anchor]:
    """Read and check the reference of a set of fringes alone.

    Parameters
    ----------
    folder : str or Path
        The reference, a set with Gray code or with several frequencies.
    geometry : GeometryFile or None
        Replaces the reference's own geometry.

    Returns
    -------
    head : CaptureHead
        Of the reference.
    anchor : Anchor
        Its phases, from which the fringe orders of the other set follow.

    Raises
    ------
    InputError
        It is no valid set, has fringes alone, or gives no figure.
    """
    capture = read_set(folder, geometry)
    if capture.head.kind == "fringes":
        where = capture.head.folder / "capture.toml"
        raise errors.InputError(
            f"{where}: kind: a reference must be a full set or one of several frequencies"
        )
    try:
        return capture.head, checked_set(capture, None).make_anchor()
    except RejectedSetError as error:
        raise errors.InputError(f"{folder}: cannot be a reference: {error}") from None


def stack_of(capture: CaptureSet) -> frame_stack.FrameStack:
    """The frames for the metrology.

    Raises RejectedSetError if a picture is missing or unreadable. The others would often suffice,
    but an incomplete set is not reliable.
    """
    if capture.lost:
        flags = tuple(frame_faults.flag_unreadable(k, capture.unusable[k]) for k in capture.lost)
        first = capture.lost[0]
        raise RejectedSetError(f"{capture.head.files[first]} is {capture.unusable[first]}", flags)
    return frame_stack.FrameStack(
        capture.frames,
        capture.head.patterns,
        capture.head.displacement_um,
        capture.unusable,
        before=frame_stack.find_frames_before(capture.head.time_s),
    )


def checked_set(capture: CaptureSet, anchor: Anchor | None) -> Checked:
    """Check the frames of a set and fit its bins.

    Parameters
    ----------
    capture : CaptureSet
        The set.
    anchor : Anchor or None
        Fringe orders of another set, for a set of fringes alone.

    Returns
    -------
    Checked

    Raises
    ------
    RejectedSetError
        The frames give no figure.
    """
    stack = stack_of(capture)
    optics = capture.head.optics
    if capture.head.kind == "frequencies":
        return check_frequencies(stack, optics)
    return check_set(stack, optics, anchor)


def noise_seen_adu(measurement: Measurement) -> float:
    """Noise of a pixel, ADU, estimated from the phase steps; NaN for three steps, which always
    agree.
    """
    return math.nan if measurement.full is None else measurement.full.noise_adu


@dataclass(frozen=True)
class SetFigure:
    """A set that gave a figure.

    Attributes
    ----------
    head : CaptureHead
        The set's own description.
    checked, figure : Checked, BinFigure
        Its frames and its surface.
    verdict : "ok" or "degraded"
        The verdict.
    reason : str
        Why it is degraded; empty if it is not.
    time_s, displacement_um : float
        Means over the sinusoids; NaN where the set states none.
    """

    head: CaptureHead
    checked: Checked
    figure: BinFigure
    verdict: shape_estimate.Verdict
    reason: str
    time_s: float
    displacement_um: float

    @property
    def artefact(self) -> Artefact | None:
        """The known surface in the mirror's place; None: the film, or the screen itself."""
        if self.head.artefact == "screen":
            return None
        return self.head.artefact

    def make_trial_bench(self) -> TrialBench:
        """The set's bench for Monte Carlo trials."""
        return TrialBench.from_set(self.head.optics, self.checked, self.figure)


class Figures:
    """Figures of sets, one after the other, optionally with another geometry than their own.

    Caches the last reference, which most sets of a run share.
    """

    def __init__(self, geometry: GeometryFile | None = None) -> None:
        self._geometry = geometry
        self._reference: Path | None = None
        self._anchor: tuple[CaptureHead, Anchor] | errors.CommandError = errors.CommandError(
            "no reference read yet"
        )

    def measure_folder(self, folder: str | Path) -> SetFigure:
        """Read and measure a set.

        Raises InputError if the set or its reference is invalid; RejectedError if its frames give
        no usable figure.
        """
        # The set, and the one that has its fringe orders.
        capture = read_set(folder, self._geometry)
        anchor = None
        if capture.head.reference is not None:
            reference, anchor = self._anchored_by(capture.head.reference)
            capture = replace(capture, head=anchor_head(capture.head, reference))

        # Its frames, without those that do not belong.
        optics = capture.head.optics
        try:
            checked = checked_set(capture, anchor)
        except RejectedSetError as error:
            raise errors.RejectedError(f"{folder}: rejected: {error}") from None

        # The figure of its bins, and its verdict.
        figure = bin_figure(optics, checked)
        verdict, reason = shape_estimate.judge_quality(figure.quality)
        if verdict == "rejected":
            raise errors.RejectedError(f"{folder}: rejected: {reason}")
        if verdict == "ok":
            verdict, reason = checked.verdict
        head = capture.head
        middle_s = float(head.time_s[head.finest_frames].mean())
        return SetFigure(head, checked, figure, verdict, reason, middle_s, head.mean_reading_um)

    def _anchored_by(self, reference: Path) -> tuple[CaptureHead, Anchor]:
        """A reference, read once; a failure is raised again for each set that names it."""
        if reference != self._reference:
            self._reference = reference
            try:
                self._anchor = read_anchor(reference, self._geometry)
            except errors.CommandError as error:
                self._anchor = error
        if isinstance(self._anchor, errors.CommandError):
            raise self._anchor
        return self._anchor
