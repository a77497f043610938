"""Tests whether a display driver does what a screen needs, against an emulated display.

A package's tests extend `DisplayBench` and run each check of `list_checks`. A check that needs a
fault which the emulated display cannot bring about is left out; docs/how-to/new-camera.md lists the
requirements.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from firmware_iface.display_patterns import make_checkerboard
from firmware_iface.optical_roles import Display, Levels
from firmware_iface.requirement import overrides, require, require_error, require_identity
from firmware_iface.roles import DeviceRefusedError, LinkDownError, LinkError

_REPEATS = 3
Check = Callable[["DisplayBench"], None]


class DisplayBench:
    """An emulated display and its driver. Override `make`, and `unplug` and `plug_in` if they can
    be brought about.

    Attributes
    ----------
    width_px, height_px : int
        The panel's size.
    lit : ndarray or None
        The picture on the panel, (height, width); the emulator gives it to `light`.
    """

    width_px, height_px = 64, 48

    def __init__(self) -> None:
        self._random = np.random.default_rng(2)
        self.lit: Levels | None = None

    def make(self, width_px: int, height_px: int) -> Display:
        """Make a driver that is configured for a panel of this size, not yet connected.

        Parameters
        ----------
        width_px, height_px : int
            Size in the configuration. A check also gives another one than the panel's, which `open`
            must refuse.
        """
        raise NotImplementedError

    def unplug(self) -> None:
        """Take the display away, with all pictures that were sent to it."""
        raise NotImplementedError

    def plug_in(self) -> None:
        """Bring it back."""
        raise NotImplementedError

    def light(self, levels: Levels) -> None:
        """The panel shows this picture: for the emulator."""
        self.lit = levels.copy()

    def make_picture(self) -> Levels:
        """Make a picture unlike all others."""
        return self._random.integers(0, 256, (self.height_px, self.width_px)).astype(np.uint8)


def list_checks(bench: type[DisplayBench]) -> list[Check]:
    """List the checks for which a bench can bring about the faults."""
    faults_of: dict[Check, tuple[str, ...]] = {
        check_identity: (),
        check_pictures: (),
        check_prepared_pictures: (),
        check_unplugged: ("unplug", "plug_in"),
        check_other_size: (),
        check_closing: (),
    }
    return [check for check, faults in faults_of.items() if overrides(bench, DisplayBench, faults)]


def check_identity(bench: DisplayBench) -> None:
    """Opening gives the identity; the description names port and settings."""
    with _open_display(bench) as display:
        require_identity(display)


def check_pictures(bench: DisplayBench) -> None:
    """Every pixel has the level that was sent: no scaling, no smoothing, no correction."""
    shape = bench.height_px, bench.width_px
    greys = [np.full(shape, level, np.uint8) for level in (0, 1, 127, 254, 255)]
    pictures = [*greys, make_checkerboard(bench.width_px, bench.height_px), bench.make_picture()]
    with _open_display(bench) as display:
        display.open()
        for picture in pictures:
            display.show(display.prepare(picture.copy()))
            _require_lit(bench, picture, "the picture")


def check_prepared_pictures(bench: DisplayBench) -> None:
    """A prepared picture can be shown any number of times, whatever became of the array that it was
    made from.
    """
    pictures = [bench.make_picture() for _ in range(_REPEATS)]
    with _open_display(bench) as display:
        display.open()
        sources = [picture.copy() for picture in pictures]
        prepared = [display.prepare(source) for source in sources]
        for source in sources:
            source[...] = 0
        for _ in range(_REPEATS):
            for picture, shown in zip(pictures, prepared, strict=True):
                display.show(shown)
                _require_lit(bench, picture, "a picture that was prepared before")


def check_unplugged(bench: DisplayBench) -> None:
    """A display that is gone is a LinkDownError, and is opened again once it is back."""
    picture = bench.make_picture()
    with _open_display(bench) as display:
        display.open()
        shown = display.prepare(picture)
        bench.unplug()
        require_error(lambda: display.show(shown), LinkError)
        display.close()
        require_error(display.open, LinkDownError)
        bench.plug_in()
        display.open()
        display.show(display.prepare(picture))
        _require_lit(bench, picture, "a picture after the display came back")


def check_other_size(bench: DisplayBench) -> None:
    """A panel of another size is refused, with both sizes."""
    other_px = bench.width_px + 16
    with _open_display(bench, other_px) as display:
        message = require_error(display.open, DeviceRefusedError)
        for width_px in (bench.width_px, other_px):
            require(
                str(width_px) in message,
                f"{message!r} does not name the width of {width_px} pixels",
            )


def check_closing(bench: DisplayBench) -> None:
    """Closing never raises, closed or open, and a closed display can be opened again."""
    with _open_display(bench) as display:
        display.close()
        for _ in range(_REPEATS):
            display.open()
            picture = bench.make_picture()
            display.show(display.prepare(picture))
            _require_lit(bench, picture, "a picture after the display was closed and opened")
            display.close()
            display.close()


@contextmanager
def _open_display(bench: DisplayBench, width_px: int | None = None) -> Iterator[Display]:
    display = bench.make(width_px or bench.width_px, bench.height_px)
    try:
        yield display
    finally:
        display.close()


def _require_lit(bench: DisplayBench, picture: Levels, what: str) -> None:
    require(
        bench.lit is not None and np.array_equal(bench.lit, picture),
        f"the panel does not show {what} as sent",
    )
