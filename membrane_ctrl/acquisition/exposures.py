"""Takes the frames of a cycle with the greatest possible overlap.

While a pattern settles on the screen, the previous frame is transferred and stored; while the first
pattern of the next cycle settles, this cycle is reconstructed. The producer is the camera's own
thread (aravis fills buffers outside Python), the consumer is the cycle.

    screen   | settle 1     | expose 1 | settle 2             | expose 2 | settle 1 (ahead)
    camera   |              |          | transfer 1 | store 1 |          | transfer 2 | store 2
    cycle    |                                                                       | reconstruct
"""

from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

from firmware_iface.optical_roles import (
    TRIES,
    Camera,
    ExposingCamera,
    Frame,
    FrameLostError,
    Pattern,
    Pixels,
    Screen,
)
from membrane_ctrl.acquisition.stage_errors import StageError, convert_stage_errors
from membrane_ctrl.processes.frames import FrameSlot, FrameWriter


class CycleClock(Protocol):
    """The run's clock, and a way to wait on it."""

    def now(self) -> float:
        """Seconds since the run's start."""

    def sleep(self, duration_s: float) -> None:
        """Return after `duration_s` on this clock."""


@runtime_checkable
class SettlingScreen(Protocol):
    """A screen that leaves its caller free while a pattern settles
    (`firmware_iface.drivers.screen_pygame`).
    """

    def begin(self, pattern: Pattern) -> None:
        """Send the pattern to the display. Raises LinkError."""

    def wait(self) -> None:
        """Return when the pattern is displayed and settled."""


class Laser(Protocol):
    """Gives the displacement at a recent time."""

    def at(self, time_s: float) -> float:
        """Displacement in µm, NaN if unknown."""


class Exposures:
    """Takes the frames of a cycle into the ring of frames.

    A camera or screen with only the plain role is used step by step.

    Parameters
    ----------
    camera, screen : Camera, Screen
        Open.
    frames : FrameWriter
        The ring.
    clock : CycleClock
        The run's clock.
    laser : Laser
        The displacement at each frame, which is stored with it.
    interval_s : float
        Least time from the start of one exposure to that of the next.
    """

    def __init__(
        self,
        camera: Camera,
        screen: Screen,
        frames: FrameWriter,
        clock: CycleClock,
        laser: Laser,
        interval_s: float,
    ) -> None:
        self._camera: ExposingCamera = _Grabbing(camera)
        if isinstance(camera, ExposingCamera):
            self._camera = camera
        self._screen: SettlingScreen = _Showing(screen)
        if isinstance(screen, SettlingScreen):
            self._screen = screen
        # Only such a screen shows the next pattern while this cycle is reconstructed.
        self._shows_ahead = isinstance(screen, SettlingScreen)
        self._frames = frames
        self._clock = clock
        self._laser = laser
        self._interval_s = interval_s
        self._shown: Pattern | None = None

    def expose_patterns(
        self, patterns: Sequence[Pattern], cycle: int, stopping: Callable[[], bool]
    ) -> list[Frame] | None:
        """Take frames of patterns, in order.

        Parameters
        ----------
        patterns : sequence of Pattern
        cycle : int
            Number that the frames carry.
        stopping : callable
            Whether to give up, asked before each exposure.

        Returns
        -------
        list of Frame or None
            None if it was stopped.

        Raises
        ------
        StageError
            "screen" or "camera", and the failure.
        """
        try:
            return self._expose_in_order(patterns, cycle, stopping)
        except StageError:
            self._shown = None
            raise
        finally:
            if isinstance(self._camera, _Grabbing):  # frames left by a cycle that ended early
                self._camera.discard_frame()

    def _expose_in_order(
        self, patterns: Sequence[Pattern], cycle: int, stopping: Callable[[], bool]
    ) -> list[Frame] | None:
        """Take the frames; the exposure before is fetched while the next pattern settles."""
        taken: list[Frame] = []
        pending: tuple[Pattern, FrameSlot] | None = None
        exposed_s = -self._interval_s
        for pattern in patterns:
            if stopping():
                return None
            self._show_pattern(pattern)
            if pending is not None:
                taken.append(self._store_frame(*pending, cycle, then=pattern))
                exposed_s = taken[-1].time_s
            with convert_stage_errors("screen"):
                self._screen.wait()
            due_s = exposed_s + self._interval_s
            self._clock.sleep(max(0.0, due_s - self._clock.now()))
            slot = self._frames.begin()
            with convert_stage_errors("camera"):
                self._camera.expose(slot.pixels)
            pending = pattern, slot
        if pending is not None:
            # Both kinds of cycle begin with the same pattern.
            ahead = None
            if self._shows_ahead:
                ahead = patterns[0]
            if ahead is not None:
                self._show_pattern(ahead)
            taken.append(self._store_frame(*pending, cycle, then=ahead))
        return taken

    def _show_pattern(self, pattern: Pattern) -> None:
        """Send a pattern to the screen, unless it is shown already."""
        if pattern != self._shown:
            with convert_stage_errors("screen"):
                self._screen.begin(pattern)
            self._shown = pattern

    def _store_frame(
        self, pattern: Pattern, slot: FrameSlot, cycle: int, then: Pattern | None
    ) -> Frame:
        """Fetch the exposure of `pattern` into its slot;
        the screen shows `then` before and after.
        """
        frame = self._fetch_frame(pattern, slot, then)
        if frame.pixels is not slot.pixels:
            slot.pixels[...] = frame.pixels
        slot.commit(pattern.name, frame.time_s, self._laser.at(frame.time_s), cycle)
        return Frame(slot.pixels, frame.time_s)

    def _fetch_frame(self, pattern: Pattern, slot: FrameSlot, then: Pattern | None) -> Frame:
        """Fetch the frame; retake a lost one with its own pattern on the screen."""
        for tried in range(1, TRIES + 1):
            with convert_stage_errors("camera"):
                try:
                    frame = self._camera.fetch()
                    break
                except FrameLostError:
                    if tried == TRIES:
                        raise
            with convert_stage_errors("screen"):
                self._screen.begin(pattern)
                self._screen.wait()
            with convert_stage_errors("camera"):
                self._camera.expose(slot.pixels)
        if tried > 1 and then is not None:
            with convert_stage_errors("screen"):
                self._screen.begin(then)
        return frame


class _Grabbing:
    """A camera that triggers and reads in one call."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._frame: Frame | None = None

    def expose(self, out: Pixels | None = None) -> None:
        self._frame = self._camera.grab(out=out)

    def fetch(self) -> Frame:
        frame = self._frame
        assert frame is not None  # after an exposure
        self._frame = None
        return frame

    def discard_frame(self) -> None:
        self._frame = None


class _Showing:
    """A screen that returns once the pattern has settled."""

    def __init__(self, screen: Screen) -> None:
        self._screen = screen

    def begin(self, pattern: Pattern) -> None:
        self._screen.show(pattern)

    def wait(self) -> None:
        return
