"""What one tick shows of the bench and of the program: what the safety table judges."""

import math
from dataclasses import dataclass, field

from firmware_iface.roles import NO_READING, BenchReading
from membrane_ctrl.controller.link_report import LinkReport
from membrane_ctrl.model.telemetry import SafeLevel


@dataclass(frozen=True, slots=True)
class Observation:
    """What one tick shows of the bench and of the program; NaN and None mean "not seen", never
    "fine".
    """

    link_up: bool  # the device link is connected
    reading_age_s: float  # since the last answer of the device
    advance_age_s: (
        float  # since its sample counter and time last advanced; a repeated answer does not count
    )
    displacement_um: (
        float  # raw laser reading, or by figures on a bench without a laser; NaN if bad or absent
    )
    displacement_valid: (
        bool  # known as well as the state needs it: new, of good quality, not a jump
    )
    jumps: int  # consecutive readings refused as jumps
    error_um: float  # setpoint minus reading; NaN outside the loop, and in a pause
    gauge_pressure_pa: float
    pump_mismatch: float  # |command - read-back|, the smaller of the last two commands'
    watchdog_tripped: bool
    board_faults: int
    lateness_ms: float
    dead_tasks: tuple[str, ...] = ()  # supervised tasks of the control process that ended
    tick_error: str = ""  # exception of a handler, if any
    overdue: str = ""  # what the present state has waited for too long, if anything
    unfit: str = ""  # what the actuator test found, if anything
    same_s: float = 0.0  # how long the valid readings have been bit-identical
    laser_fault_text: str = ""  # readings of laser, gauge and camera, if the laser is wrong
    runs_on: str = ""  # the read-back of a pump that should have stopped
    inflow: str = ""  # how the mirror rises although the pump is commanded off
    locked: str = ""  # the locks that people have set, in words
    foreign: int = 0  # changes by another program: claim, watchdog (`roles.FOREIGN_...`)
    gauge_same_s: float = 0.0  # how long a taut film's gauge readings have been bit-identical
    gauge_jumps: int = 0  # consecutive readings that no film can cause
    # readings of laser (or optics) and gauge, if they contradict each other
    laser_gauge_apart: str = ""
    held_by_optics: bool = False  # the optics show the centre, or must: the laser may be missing
    unseen_film: str = ""  # on a bench held without a laser: why the film is not seen, if so
    # the displacement by the optics, with or without a laser, where the loop may follow them
    optics_guard_um: float = math.nan
    # excess gas the film takes, unless an independent sensor shows it standing still
    gas_excess: str = ""
    open_interlocks: int = 0  # bit i: interlock i of the configuration is open, or its signal lost
    interlock_level: SafeLevel = SafeLevel.NONE  # the deepest level of the open ones
    interlock_words: str = ""  # the open ones with their texts
    # all sensors as they answered in this tick, for properties without memory
    reading: BenchReading = NO_READING
    answered: bool = True  # the device that shows the displacement gave a valid answer
    link: LinkReport = field(default_factory=LinkReport)

    @property
    def vent_fraction(self) -> float:
        """The vent's read-back; NaN without one."""
        return self.reading.vent_fraction

    @property
    def is_unanswered(self) -> bool:
        """There is no displacement, because its device gave no valid answer."""
        return not self.displacement_valid and not self.answered

    def is_late_by_link(self, lateness_max_ms: float) -> bool:
        """The tick is late, and without the last one's waiting for the devices it would not be."""
        late_by_itself_ms = self.lateness_ms - self.link.wait_ms
        return self.lateness_ms > lateness_max_ms >= late_by_itself_ms

    @property
    def deepest_um(self) -> float:
        """The largest displacement that a sensor shows, µm; NaN without one.

        A laser that fails may repeat an old value with noise, which no check of the laser alone
        recognises. Each limit therefore judges the sensor that is nearest to it.
        """
        return max(self._shown_um, default=math.nan)

    @property
    def shallowest_um(self) -> float:
        """The smallest displacement that a sensor shows, µm; NaN without one."""
        return min(self._shown_um, default=math.nan)

    @property
    def _shown_um(self) -> list[float]:
        """Displacements by laser and optics, without those that are missing."""
        shown_um = (self.displacement_um, self.optics_guard_um)
        return [um for um in shown_um if not math.isnan(um)]
