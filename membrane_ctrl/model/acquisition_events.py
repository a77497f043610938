"""Events of the acquisition: its state, the geometry in use, captures, vibrations, frames."""

from typing import Any

from membrane_ctrl.model.event_base import Event, LogLevel


class AcquisitionState(Event, kind="acquisition", sentence="Acquisition {state}[: {message}]"):
    """The acquisition's state, in words."""

    state: str
    message: str
    cycle: int | None = None
    traceback: str | None = None

    @property
    def level(self) -> LogLevel:
        """A failure is an error; a camera that does not answer yet is a warning."""
        return {"failed": LogLevel.ERROR, "retrying": LogLevel.WARNING}.get(
            self.state, LogLevel.INFO
        )

    @property
    def notable(self) -> bool:
        """Whether it differs from the usual state."""
        return self.state != "running"


class GeometryInUse(
    Event,
    kind="geometry",
    sentence="The figures use the geometry of {source}[, calibrated {calibrated_utc}]"
    "[; {changes}][; {message}]",
    notable=True,
):
    """The geometry that the cycles use, and what has changed in it since the run before."""

    hash: str
    file: str | None
    calibrated_utc: str | None
    message: str
    run_before: str | None = None
    changed: str | None = None

    @property
    def source(self) -> str:
        """Where it is stated."""
        return self.file or "the configuration"

    @property
    def changes(self) -> str:
        """What has changed; empty without a run before."""
        if self.run_before is None:
            return ""
        if self.changed is None:
            return f"as in {self.run_before}"
        return f"changed since {self.run_before}: {self.changed}"


class GeometryKnown(
    Event,
    kind="geometry_known",
    sentence="Geometry {state}: {source}[; {why}][; {next_step}]; the bars allow since the "
    "reference cycle, at 1 sigma: {assumed}",
    notable=True,
):
    """How well the geometry is known: calibrated, uncalibrated, or contradicted by full cycles."""

    state: str
    source: str
    assumed: str
    next_step: str | None = None
    why: str | None = None

    @property
    def level(self) -> LogLevel:
        """A geometry that the frames contradict is a warning."""
        if self.why is None:
            return LogLevel.INFO
        return LogLevel.WARNING


class Capture(
    Event,
    kind="capture",
    sentence="Capture[ of cycle {cycle}][ in {set}][, {verdict}][: {reason}][. Failed: {failed}]",
    notable=True,
):
    """The result of `capture`: the set's folder, or the reason for its absence."""

    cycle: int | None = None
    set: str | None = None
    displacement_um: float | None = None
    verdict: str | None = None
    reason: str | None = None
    failed: str | None = None


class Vibrations(Event, kind="vibrations", sentence="Vibrations of the mirror: {message}"):
    """The mirror's vibrations in a minute of tracked frames; a mode keeps its place, None where it
    was not found.
    """

    frequency_hz: Any  # list of numbers and None
    amplitude_nm: Any  # as above, RMS over the mirror
    message: str


class FramesLeftOut(Event, kind="raw_frames", level=LogLevel.WARNING):
    """Frames around a fault are not kept."""

    left_out: int
    message: str
