"""Which sensors are compared in which state, and what is reset when."""

from __future__ import annotations

import math
from dataclasses import replace

from firmware_iface.roles import BenchReading
from membrane_ctrl.config.schema import Config, EstimatorConfig
from membrane_ctrl.controller.hold_status import HoldStatus
from membrane_ctrl.controller.sensor_consistency import SensorConsistency
from membrane_ctrl.controller.tick import TickInputs
from membrane_ctrl.model.events import Event
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.telemetry import State
from tests.worlds.sound_figure import SOUND_FIGURE

SAG_UM = 37_100.0


class Seconds:
    """A held mirror, a tick a second."""

    def __init__(self, config: Config = Config()) -> None:  # noqa: B008 (frozen)
        self.consistency = SensorConsistency(config)
        self.now_s = 0.0
        self.camera_stuck = False
        self.events: list[Event] = []

    def pass_by(
        self,
        seconds: int,
        leak_um_per_s: float = 1.2,
        bleed: float = 0.0,
        camera: bool = False,
        state: State = State.HOLD,
        gauge_pa: float = 600.0,
        ambient_pa: float = 101_325.0,
    ) -> None:
        for _ in range(seconds):
            self.now_s += 1.0
            reading = BenchReading(
                0.0, 0, gauge_pa, ambient_pa, 20.0, 20.0, 0.3, 0.0, 1, self.now_s, False, 0
            )
            figure = self._shape() if camera else None
            inputs = TickInputs(self.now_s, 1.0, reading, estimate=figure)
            held = HoldStatus(
                laser_um=0.0,
                gauge_pressure_pa=gauge_pa,
                setpoint_um=0.0,
                trim_um=0.0,
                ramp_left_um=0.0,
                leak_um_per_s=leak_um_per_s,
                flow_um_per_s=leak_um_per_s,
                bleed_fraction=bleed,
                sag_um=math.nan if figure is None else figure.sag_um,
                figure=figure,
            )
            self.events += self.consistency.compare_sensors(inputs, state, 1.0, held)

    def _shape(self) -> ShapeEstimate:
        sag_um = SAG_UM if self.camera_stuck else SAG_UM + 0.001 * (self.now_s % 7)
        return replace(SOUND_FIGURE, time_s=self.now_s, sag_um=sag_um)


def test_unexplained_gas_consumption_is_reported_until_the_hold_ends() -> None:
    mirror = Seconds()
    mirror.pass_by(600)
    mirror.pass_by(90, leak_um_per_s=3.0)
    assert "3.0 µm/s of gas; before it took 1.2 µm/s" in mirror.consistency.gas_excess
    mirror.pass_by(1, leak_um_per_s=3.0, state=State.FAULT)
    assert mirror.consistency.gas_excess == ""
    mirror.pass_by(600, leak_um_per_s=3.0)
    assert mirror.consistency.gas_excess == ""


def test_an_opened_bleed_explains_the_gas_consumption() -> None:
    mirror = Seconds()
    mirror.pass_by(600)
    mirror.pass_by(600, leak_um_per_s=3.0, bleed=0.02)
    assert mirror.consistency.gas_excess == ""


def test_a_camera_that_shows_the_film_at_rest_explains_the_gas_until_it_is_lost() -> None:
    mirror = Seconds()
    mirror.pass_by(600)
    mirror.pass_by(300, leak_um_per_s=3.0, camera=True)
    assert mirror.consistency.gas_excess == ""
    mirror.pass_by(100, leak_um_per_s=6.7)
    assert mirror.consistency.gas_excess != ""


def test_a_camera_used_as_process_value_does_not_explain_the_gas() -> None:
    """Optics that drift make the loop pump against them, as a laser that creeps does."""
    mirror = Seconds(Config(estimator=EstimatorConfig(process_value="optics")))
    mirror.pass_by(600, camera=True)
    mirror.pass_by(300, leak_um_per_s=3.0, camera=True)
    assert mirror.consistency.gas_excess != ""
    mirror.pass_by(60, gauge_pa=605.0, camera=True)
    assert mirror.consistency.laser_gauge_apart.startswith("optics ")


def test_laser_and_gauge_are_compared_wherever_the_pump_may_run() -> None:
    mirror = Seconds()
    for state in (State.CHECK, State.INFLATE, State.SETTLE, State.HOLD, State.MANUAL, State.TUNE):
        mirror.pass_by(60, state=state)
        mirror.pass_by(40, state=state, gauge_pa=605.0)
        assert mirror.consistency.laser_gauge_apart != "", state
        mirror.pass_by(1, state=State.STANDBY, gauge_pa=605.0)
        assert mirror.consistency.laser_gauge_apart == ""


def test_a_barometer_in_a_wrong_unit_is_reported_once_and_cleared_once() -> None:
    mirror = Seconds()
    mirror.pass_by(100, ambient_pa=1013.25)
    mirror.pass_by(100)
    mirror.pass_by(5, ambient_pa=1013.25)
    kinds = [
        event.kind for event in mirror.events if getattr(event, "name", "") == "weather_sensor"
    ]
    assert kinds == ["maintenance", "maintenance_over"]


def test_a_frozen_camera_is_used_neither_for_the_shape_nor_for_the_gas() -> None:
    mirror = Seconds()
    mirror.pass_by(600, camera=True)
    assert mirror.consistency.camera_fault_text == ""
    mirror.camera_stuck = True
    mirror.pass_by(100, leak_um_per_s=6.7, camera=True)
    assert "repeats" in mirror.consistency.camera_fault_text
    assert mirror.consistency.gas_excess != ""
    mirror.camera_stuck = False
    mirror.pass_by(2, camera=True)
    assert mirror.consistency.camera_fault_text == ""


def test_a_gauge_that_drifts_for_hours_against_the_laser_raises_one_notice_and_its_end() -> None:
    mirror = Seconds()
    mirror.pass_by(100)
    for tenth in range(130):  # 0.1 Pa, 2 µm, in 100 s: by 260 µm
        mirror.pass_by(100, gauge_pa=600.0 + 0.1 * tenth)
    notices = [event for event in mirror.events if getattr(event, "name", "") == "slow_drift"]
    assert [event.kind for event in notices] == ["maintenance"]
    assert "connect a film thermometer" in getattr(notices[0], "message", "")
    assert mirror.consistency.laser_gauge_apart == ""
    for tenth in range(130, 60, -1):
        mirror.pass_by(100, gauge_pa=600.0 + 0.1 * tenth)
    notices = [event for event in mirror.events if getattr(event, "name", "") == "slow_drift"]
    assert [event.kind for event in notices] == ["maintenance", "maintenance_over"]
