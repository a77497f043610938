"""A held mirror in virtual time whose sets are rendered on a bench that differs from the stated
one.
"""

from __future__ import annotations

import signal
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from membrane_ctrl.config.schema import (
    CameraConfig,
    Config,
    GeometryConfig,
    LimitsConfig,
    LoopConfig,
    OpticsConfig,
    PumpConfig,
    ShapeConfig,
    TwinConfig,
)
from membrane_ctrl.controller.command import Command
from membrane_ctrl.model.acquisition_events import Capture
from membrane_ctrl.model.events import Event
from membrane_ctrl.sessions.live_hold import News
from membrane_ctrl.sim.optics.film_shape import typical_film
from membrane_ctrl.sim.optics.simulate import simulate_set
from membrane_ctrl.sim.optics.simulation_spec import Motion, SimulationSpec
from tuning.twin_hold import TwinHold

# 16-bit frames of large pixels with the noise of the 144 that each stands for
SHRINK = 12
NOISE = 256 * float(np.hypot(0.4, np.sqrt(1 / 12))) / SHRINK
CAMERA = CameraConfig(
    width_px=2448 // SHRINK,
    height_px=2048 // SHRINK,
    pixel_um=3.45 * SHRINK,
    bits=16,
    noise_adu=NOISE,
)
TRUE = GeometryConfig(a_mm=2674.0, b_mm=2869.0, alpha_deg=81.2, reference_displacement_um=0.0)
FILM = typical_film(37.1, 500.0, seed=4)


def config(place: Path | None = None, **limits: float) -> Config:
    """A mirror that loses and gains gas twenty times as fast as a real one: a minute instead of
    twenty.
    """
    return Config(
        twin=TwinConfig(scenario="quiet", start_error_um=-3.0, leak_time_constant_s=500.0),
        pump=PumpConfig(flow_full_um_per_s=60.0),
        loop=LoopConfig(rate_hz=20.0, flow_max_um_per_s=60.0, setpoint_ramp_um_per_s=40.0),
        limits=LimitsConfig(
            **{"displacement_min_um": -4500.0, "displacement_max_um": 4500.0, **limits}
        ),
        shape=ShapeConfig(period_s=2.0),
        optics=OpticsConfig(camera=CAMERA, geometry_file=place),
    )


@dataclass
class LiveBench:
    """A `CaptureLink`.

    Attributes
    ----------
    run_dir : Path
        Where the sets are.
    fails : list of str
        What the next captures say instead of taking a set.
    interrupt_at : int
        Ctrl-C while this capture is under way.
    interrupts_again : bool
        And once more on the way back.
    dark_at : int
        The laser is lost for good after this capture.
    meddles_at : int
        After so many commands somebody else moves the setpoint.
    blind : bool
        No shapes come.
    asked : list of Command
        Everything so far.
    """

    run_dir: Path
    config: Config
    fails: list[str] = field(default_factory=list)
    interrupt_at: int = -1
    interrupts_again: bool = False
    dark_at: int = -1
    meddles_at: int = -1
    blind: bool = False
    asked: list[Command] = field(default_factory=list)
    captures: int = 0

    def __post_init__(self) -> None:
        self.hold = TwinHold(self.config)
        self.name = self.run_dir.name
        self._pending_events: tuple[Event, ...] = ()

    def send_command(self, command: Command) -> None:
        self.asked.append(command)
        self.hold.send_command(command)
        if command.kind == "capture":
            self._capture()
        if self.interrupts_again and self.captures and command.kind == "setpoint":
            signal.raise_signal(signal.SIGINT)
        if len(self.asked) == self.meddles_at:
            self.hold.send_command(Command("setpoint", "another", value=77.0))

    def read_news(self) -> News:
        pending, self._pending_events = self._pending_events, ()
        news = self.hold.read_news()
        return News(news.rows, news.events + pending, () if self.blind else news.shapes)

    def close(self) -> None:
        pass

    def _capture(self) -> None:
        self.captures += 1
        if self.captures == self.interrupt_at:
            signal.raise_signal(signal.SIGINT)
        self.hold.bench.wrong.no_light = self.captures == self.dark_at
        if self.fails and (failed := self.fails.pop(0)):
            self._pending_events = (Capture(failed=failed),)
            return
        spec = SimulationSpec(
            self.config.optics.model_copy(update={"geometry": TRUE}),
            FILM,
            motion=Motion(start_um=self.hold.bench.plant.truth().displacement_um),
            laser_noise_um=1.0,
            stated_geometry=self.config.optics.geometry.model_copy(
                update={"reference_displacement_um": 0.0}
            ),
            seed=self.captures,
        )
        simulate_set(self.run_dir / "raw" / f"cycle-{self.captures}", spec)
        self._pending_events = (Capture(set=f"raw/cycle-{self.captures}", verdict="ok", reason=""),)
