"""How far the estimate may let the laser's mount drift, and when optics are too unsteady to use."""

from collections.abc import Collection
from dataclasses import dataclass, field

from membrane_ctrl.config.schema import ShapeConfig
from membrane_ctrl.control.centre_estimate import Sensor
from membrane_ctrl.controller.recent_count import RecentCount
from membrane_ctrl.model.events import (
    Event,
    Maintenance,
)
from membrane_ctrl.model.state_tree import StateNode

_OPTICS_JUMPS_MAX = 5

_UNSTEADY_MESSAGE = (
    "the optics have jumped against the laser again and again; they are left out, and the "
    "mirror follows the laser. "
    "Look for vibration, reflections or a loose camera, then `ctl shape off` and `on` use "
    "them again"
)
_UNSTEADY_ALONE_MESSAGE = (
    "the optics have jumped again and again, and no laser shows which jumps are the film's; they "
    "are left out. Look for vibration, reflections, a loose camera or wrong times of its frames, "
    "then restart the hold"
)
_JUMP_TAKES_S = 2.0  # until the estimate has followed a jump of the laser


@dataclass(slots=True)
class MountDriftState(StateNode):
    """How far the mount has drifted."""

    last_um: float = 0.0
    drift_um: float = 0.0
    optics_jumps: RecentCount = field(default_factory=RecentCount)
    jump_left_s: float = 0.0  # until the estimate has followed a jump of the laser
    beyond_limit: bool = False


class MountDrift:
    """How far the estimate lets the laser's mount drift: as far as the shape loop's trim,
    `shape.trim_max_um`.

    Laser and optics that drift apart do not show which of them drifts. Beyond the limit the optics
    are left out, the mirror follows the laser, and a person decides. A jump that the estimate found
    to be the laser's is no drift.
    """

    def __init__(self, shape: ShapeConfig, memory: MountDriftState | None = None) -> None:
        self._most_um = shape.trim_max_um
        self.memory = memory or MountDriftState()

    def start(self, mount_um: float) -> None:
        """Count from a place of the mount, in µm."""
        self.memory.start_afresh()
        self.memory.last_um = mount_um

    @property
    def beyond_limit(self) -> bool:
        """The limit is passed."""
        return self.memory.beyond_limit

    def step(
        self,
        mount_um: float,
        jumped: Collection[Sensor],
        now_s: float,
        dt_s: float,
        has_laser: bool,
    ) -> list[Event]:
        """Follow the laser's mount; return the notice once it has drifted beyond the limit.

        Only `start` takes the notice back.

        Parameters
        ----------
        mount_um : float
            Displacement of the mount, from the estimate.
        jumped : collection of Sensor
            Sensors of which the estimate has found a jump in this tick.
        now_s, dt_s : float
            The run's clock, and the time since the last tick.
        has_laser : bool
            Whether the estimate follows the laser.
        """
        memory = self.memory
        moved_um = mount_um - memory.last_um
        memory.last_um = mount_um
        if memory.beyond_limit:
            return []
        # Optics that jump again and again lead the estimate away in steps that each look like a
        # knock: they are left out
        if Sensor.OPTICS in jumped:
            memory.optics_jumps.add(now_s, _OPTICS_JUMPS_MAX)
            if memory.optics_jumps.too_many(now_s, _OPTICS_JUMPS_MAX):
                memory.beyond_limit = True
                message = _UNSTEADY_MESSAGE if has_laser else _UNSTEADY_ALONE_MESSAGE
                return [Maintenance("optics_unsteady", message)]
        # A knock of the laser moves its mount at once, and is no drift
        laser_jumped = Sensor.LASER in jumped
        memory.jump_left_s = _JUMP_TAKES_S if laser_jumped else max(0.0, memory.jump_left_s - dt_s)
        if memory.jump_left_s == 0.0:
            memory.drift_um += moved_um
        memory.beyond_limit = abs(memory.drift_um) > self._most_um
        if not memory.beyond_limit:
            return []
        message = (
            f"laser and optics have drifted {self._most_um:g} µm apart; which of them is not "
            "known, and the mirror "
            "follows the laser. Check its mount and the optics, then `ctl shape off` and "
            "`on` accept the figure"
        )
        return [Maintenance("trim_limit", message)]
