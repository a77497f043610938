"""What a session does to a bench, whether real or emulated."""

from collections.abc import Awaitable, Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Protocol, TypeVar

from firmware_iface import roles
from membrane_ctrl.acquisition.mirror_pictures import MirrorPictures
from membrane_ctrl.commissioning.check import DeviceProbe
from membrane_ctrl.commissioning.devices import FoundDevice
from membrane_ctrl.config.schema import Config
from membrane_ctrl.sessions.live_hold import HoldLink

T = TypeVar("T")


class HandAct(Enum):
    """What the person does to the bench; an emulated bench does it by itself."""

    PRESS_FILM = "press film"
    RELEASE_FILM = "release film"
    MOVE_CARD = "move card"  # by a distance in µm, the way a deeper bowl moves the film
    REMOVE_CARD = "remove card"
    PULL_CABLE = "pull cable"
    PLUG_CABLE = "plug cable"
    OPEN_CIRCUIT = "open circuit"  # of a named interlock
    LOSE_SIGNAL = "lose signal"
    CLOSE_CIRCUIT = "close circuit"
    TURN_FOCUS = "turn focus ring"


@dataclass(frozen=True, slots=True)
class HandMotion:
    """An act with its object."""

    act: HandAct
    name: str = ""
    distance_um: float = 0.0


@dataclass(frozen=True, slots=True)
class OpenBench:
    """A bench that is open: devices claimed, watchdog armed.

    Attributes
    ----------
    bench : Bench
        Opened; its watchdog runs, so it must be written to while the pump runs.
    identity : BenchIdentity
        What its devices state, with the watchdog's period.
    sleep : callable
        Waits, in the bench's time.
    now : callable
        The bench's time in s.
    """

    bench: roles.Bench
    identity: roles.BenchIdentity
    sleep: Callable[[float], Awaitable[None]]
    now: Callable[[], float]


Action = Callable[[OpenBench], Awaitable[T]]


class BenchAccess(Protocol):
    """The bench as the session's stages use it."""

    @property
    def simulated(self) -> bool:
        """Whether the bench is emulated."""
        ...

    def find_devices(self) -> list[FoundDevice]:
        """What is connected to this machine."""
        ...

    def probe_devices(self, config: Config) -> list[DeviceProbe]:
        """Probe the configured devices without writing to them."""
        ...

    def probe_optics(self, config: Config) -> list[DeviceProbe]:
        """Probe camera and screen: exposure, pattern, settling; empty without one."""
        ...

    def photograph(self, config: Config) -> MirrorPictures:
        """Take the mirror with the screen white and black. Raises DeviceError."""
        ...

    def act(self, config: Config, action: Action[T]) -> T:
        """Open the bench, do something with it, and leave it with the pump off.

        Parameters
        ----------
        config : Config
            With the devices.
        action : Action[T]
            Gets the opened bench.

        Returns
        -------
        T
            What the action returns.

        Raises
        ------
        DeviceError
            The bench does not open.
        LinkError
            It fails meanwhile.
        """
        ...

    def move_hand(self, motion: HandMotion) -> None:
        """Let an emulated bench follow what the person has been asked to do."""
        ...

    def start_hold(
        self, folder: Path, config: Config, name: str, by_frames: bool = False
    ) -> AbstractContextManager[HoldLink]:
        """Start the controller in standby; it is stopped at the end of the block.

        Parameters
        ----------
        folder : Path
            Of the session.
        config : Config
            The configuration of the hold.
        name : str
            Of the run.
        by_frames : bool
            Measure figures from rendered frames; an emulated bench does so only if this is set,
            because they cost seconds of processor time.

        Returns
        -------
        AbstractContextManager[HoldLink]

        Raises
        ------
        DeviceError
            It does not start.
        """
        ...

    def find_latched_fault(self, folder: Path) -> str:
        """The fault of an earlier hold that is not acknowledged; empty if there is none."""
        ...

    def run_tuning(
        self, folder: Path, config: Config, command: str, show: Callable[[str], None]
    ) -> int:
        """Run `tune` on the hold that runs, or on the twin.

        Parameters
        ----------
        folder : Path
            Of the session.
        config : Config
            The configuration of the hold.
        command : str
            `run` or `pump`.
        show : callable
            Receives each printed line.

        Returns
        -------
        int
            The exit code.
        """
        ...
