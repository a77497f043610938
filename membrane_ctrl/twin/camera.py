"""Screen and camera of the twin: what the screen shows, seen in the film as it stands at the moment of exposure."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from firmware_iface.roles import Frame, LinkError, Pattern
from membrane_ctrl.config import OpticsConfig, TwinConfig
from membrane_ctrl.twin.film_shape import FilmShape, typical_film
from membrane_ctrl.twin.render import OpticsRenderer, Pixels


class FilmPosition(Protocol):
    """Where the film truly is; `membrane_ctrl.twin.truth.Truth` is one."""

    @property
    def displacement_um(self) -> float:
        """Of the centre, positive when the bowl is deeper."""
        ...

    @property
    def sag_mm(self) -> float:
        """Depth of the bowl."""
        ...


class Clock(Protocol):
    """The run's clock."""

    def now(self) -> float:
        """Seconds since the run's start."""
        ...


class TwinOptics:
    """The optical half of the simulated bench: one film, one screen, one camera.

    The film is a Hencky bowl with the figure of `typical_film` drawn from the twin's seed, unless `film` is given.
    Bowl and rim follow the truth: only the sag at displacement 0 is taken from it, once, at the first look.

    Parameters
    ----------
    optics : OpticsConfig
        The bench's optics, taken as true but for the geometry if `twin` has its own. Without a reference displacement
        in the geometry, it holds for the film as it was at the first look.
    twin : TwinConfig
        For its seed and its true geometry.
    truth : callable
        Gives the film's true position now.
    clock : Clock
        Gives the time of exposure.
    film : FilmShape, optional
        Another film; its sag belongs to displacement 0.

    Attributes
    ----------
    screen : TwinScreen
    camera : TwinCamera
    """

    def __init__(
        self,
        optics: OpticsConfig,
        twin: TwinConfig,
        truth: Callable[[], FilmPosition],
        clock: Clock,
        film: FilmShape | None = None,
    ) -> None:
        self._optics = optics if twin.geometry is None else optics.model_copy(update={"geometry": twin.geometry})
        self._seed = twin.seed
        self._truth = truth
        self._clock = clock
        self._film = film
        self._renderer: OpticsRenderer | None = None
        self.screen = TwinScreen()
        self.camera = TwinCamera(self)

    def prepare(self) -> None:
        """Trace the film where it is and take one picture, so that the first real one comes at the usual speed."""
        self._expose(Pattern("black"), None)

    @property
    def film(self) -> FilmShape:
        """The film; its sag belongs to displacement 0."""
        return self._looked().film

    def expose(self, out: Pixels | None) -> Frame:
        """Take one picture of what the screen shows, now."""
        if self.screen.shown is None:
            raise LinkError("twin camera: the screen shows nothing: show a pattern first")
        return self._expose(self.screen.shown, out)

    def _expose(self, pattern: Pattern, out: Pixels | None) -> Frame:
        renderer = self._looked()
        time_s = self._clock.now()
        return Frame(renderer.render(pattern, self._truth().displacement_um, out), time_s)

    def _looked(self) -> OpticsRenderer:
        if self._renderer is None:
            position = self._truth()
            sag_mm = position.sag_mm - position.displacement_um / 1000.0
            film = self._film or typical_film(sag_mm, self._optics.mirror.radius_mm, self._seed)
            stated = self._optics.geometry.reference_displacement_um
            reference_um = position.displacement_um if stated is None else stated
            self._renderer = OpticsRenderer(self._optics, film, reference_um=reference_um, seed=self._seed)
        return self._renderer


class TwinScreen:
    """Role Screen: lit and settled at once.

    Attributes
    ----------
    shown : Pattern or None
        What it shows.
    """

    def __init__(self) -> None:
        self.shown: Pattern | None = None

    def show(self, pattern: Pattern) -> None:
        """Show the pattern."""
        self.shown = pattern

    def close(self) -> None:
        """Go dark."""
        self.shown = None


class TwinCamera:
    """Role Camera: renders what a camera would have taken."""

    def __init__(self, optics: TwinOptics) -> None:
        self._optics = optics
        self._open = True

    def grab(self, out: Pixels | None = None) -> Frame:
        """One exposure; the picture lands in `out` (H, W) if given, else in a new array.

        Raises
        ------
        LinkError
            If the camera is closed or the screen shows nothing.
        """
        if not self._open:
            raise LinkError("twin camera: closed")
        return self._optics.expose(out)

    def close(self) -> None:
        """No more pictures."""
        self._open = False
