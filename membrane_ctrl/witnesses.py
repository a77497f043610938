"""What a held mirror's sensors say about each other and about the film: who lies, and what wears out."""

from __future__ import annotations

import math

from membrane_ctrl.config import Config
from membrane_ctrl.control.film_health import FilmHealth
from membrane_ctrl.control.plausibility import Liar, Plausibility
from membrane_ctrl.names import State
from membrane_ctrl.tick import Event, TickInputs


class Witnesses:
    """Asked on every tick, before safety judges.

    Attributes
    ----------
    laser_lies : str
        What the three witnesses of the sag have seen, if it is the laser that does not fit.
    camera_lies : str
        The same of the camera, as a reason for the shape loop.
    """

    def __init__(self, config: Config) -> None:
        self._plausibility = Plausibility(config.shape.disagreement_max_um)
        self._far_um = config.shape.disagreement_max_um
        self._health = FilmHealth(min(config.loop.flow_max_um_per_s, config.pump.flow_full_um_per_s))
        self._setpoint_um = config.loop.setpoint_um
        self._liar = Liar.NOBODY
        self.laser_lies = self.camera_lies = ""

    def ask(
        self,
        inputs: TickInputs,
        state: State,
        dt_s: float,
        setpoint_um: float,
        ramp_left_um: float,
        leak_um_per_s: float,
    ) -> list[Event]:
        """One tick.

        Parameters
        ----------
        inputs : TickInputs
        state : State
            Only a held mirror is judged.
        dt_s : float
        setpoint_um : float
            What it is held at, without the trim.
        ramp_left_um : float
            How far the setpoint's ramp has still to go. A camera sees the film of a cycle ago, and the gauge is
            linear only about its reference: on a long way they would contradict a laser that is right.
        leak_um_per_s : float
            As the inner loop estimates it, NaN without.

        Returns
        -------
        list of Event
            What is new.
        """
        if setpoint_um != self._setpoint_um:
            self._setpoint_um = setpoint_um
            self._health.setpoint_moved()
        if state != State.HOLD or abs(ramp_left_um) > self._far_um:
            if self._plausibility.watching:
                self._plausibility.reset()
            return self._judge(Liar.NOBODY)
        reading = inputs.reading
        good = reading is not None and reading.displacement_quality == 0
        laser_um = reading.displacement_um if reading is not None and good else math.nan
        gauge_pa = reading.gauge_pressure_pa if reading is not None else math.nan
        events = self._judge(self._plausibility.step(dt_s, laser_um, gauge_pa, inputs.estimate))
        for warning in self._health.step(dt_s, leak_um_per_s, gauge_pa):
            kind = "maintenance" if warning.bad else "maintenance_over"
            events.append({"kind": kind, "name": warning.name, "message": warning.message})
        return events

    def _judge(self, liar: Liar) -> list[Event]:
        seen = str(self._plausibility.changes) if liar in (Liar.LASER, Liar.OPTICS) else ""
        self.laser_lies = seen if liar == Liar.LASER else ""
        if liar != Liar.OPTICS:
            self.camera_lies = ""
        elif not self.camera_lies:  # the words stay: a reason whose numbers change is no new one
            self.camera_lies = f"laser and gauge agree that the camera is wrong: {seen}"
        if liar == self._liar:
            return []
        self._liar = liar
        return [{"kind": "plausibility", "liar": liar.name.lower(), "seen": str(self._plausibility.changes)}]
