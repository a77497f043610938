"""Focus or best fit held on the twin while the film's figure changes at a constant vertex."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from membrane_ctrl.config.schema import (
    Config,
    EstimatorConfig,
    LoopConfig,
    PumpConfig,
    ShapeConfig,
    TwinConfig,
)
from membrane_ctrl.control.held_offset import HeldOffset, HeldState
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.controller.cross_check import cross_check
from membrane_ctrl.controller.snapshot import continue_from, take_snapshot
from membrane_ctrl.hold.virtual_run import VirtualRun, VirtualTick
from membrane_ctrl.metrology.figure.held_quantities import find_held_weights
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.events import Fault, HeldScalarState, Maintenance, MaintenanceOver
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.sim.film import NOMINAL_SAG_MM
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench
from tests.worlds.changing_film import (
    ChangingFilm,
    figure_change,
    hencky_profile,
    true_focus_mm,
)

RATE_HZ = 10.0
SAG_UM = 1e3 * NOMINAL_SAG_MM  # of the twin at displacement 0
TWIN = TwinConfig(start_error_um=-1.0, scenario="quiet", laser_noise_um=0.2)
SHAPE = ShapeConfig(mode="track", time_constant_s=5.0, trim_rate_max_um_per_s=0.5)
STARTS_S, RAMP_S, SPHERICAL_UM = 40.0, 30.0, -1.5
Alter = Callable[[float, ShapeEstimate], ShapeEstimate | None]


def config_of(holds: str, process_value: str = "estimate", **loop: object) -> Config:
    """A twin that is held by a scalar."""
    return Config(
        twin=TWIN,
        loop=LoopConfig.model_validate({"rate_hz": RATE_HZ, "holds": holds} | loop),
        shape=SHAPE,
        estimator=EstimatorConfig.model_validate({"process_value": process_value}),
    )


def spherical_at(now_s: float) -> float:
    """Spherical aberration that the film gains within half a minute, µm."""
    return SPHERICAL_UM * min(max(now_s - STARTS_S, 0.0) / RAMP_S, 1.0)


def run_hold(
    config: Config,
    until_s: float,
    alter: Alter | None = None,
    commands: dict[int, Command] | None = None,
    continued_at_s: float = math.inf,
    figures_s: float = 0.5,
) -> list[VirtualTick]:
    """A hold with two figures a second of a film that changes."""
    bench = VirtualBench(Plant(config.twin, config.pump))
    film = ChangingFilm(bench, config, 3, spherical_at, alter)
    run = VirtualRun(config, bench, zernike_projection(), film)
    run._shape_period_s = figures_s
    asked = {1: Command("hold", "a test", "it runs")} | (commands or {})
    ticks: list[VirtualTick] = []
    while run.now_s < until_s:
        if run.now_s >= continued_at_s:
            continued_at_s = math.inf
            snapshot = take_snapshot(run._supervisor._controller)
            run._supervisor._controller = continue_from(
                snapshot, config, zernike_projection(), find_held_weights(config)
            )
        number = len(ticks) + 1
        tick = run.run_tick((asked[number],) if number in asked else ())
        assert tick is not None
        ticks.append(tick)
    return ticks


@cache
def kept_hold(holds: str, process_value: str = "estimate") -> list[VirtualTick]:
    """A hold that several tests look at."""
    return run_hold(config_of(holds, process_value), 100.0)


def sag_um(tick: VirtualTick) -> float:
    """True sag of the twin."""
    return SAG_UM + tick.inputs.truth_displacement_um


def focus_change_mm(ticks: list[VirtualTick]) -> float:
    """How far the true focus has moved from the reference to the end."""
    means = []
    for begin_s, end_s in ((STARTS_S - 5.0, STARTS_S), (95.0, 100.0)):
        part = [tick for tick in ticks if begin_s <= tick.row.mono_s < end_s]
        mean_sag_um = float(np.mean([sag_um(tick) for tick in part]))
        means.append(true_focus_mm(mean_sag_um, spherical_at(part[-1].row.mono_s)))
    return means[1] - means[0]


def states_of(ticks: list[VirtualTick]) -> list[str]:
    """States of the held scalar, in order."""
    return [
        event.state for tick in ticks for event in tick.events if isinstance(event, HeldScalarState)
    ]


@pytest.mark.parametrize("process_value", ["laser", "estimate"])
def test_focus_stays_where_a_held_vertex_lets_it_wander(process_value: str) -> None:
    """1.5 µm of spherical aberration move the focus by 93 µm at a constant vertex."""
    held = focus_change_mm(kept_hold("focus", process_value))
    assert abs(held) < 0.012
    last = kept_hold("focus", process_value)[-1].row
    assert last.held_offset_um == pytest.approx(1.354 * SPHERICAL_UM, abs=0.3)


def test_a_held_vertex_lets_the_focus_wander() -> None:
    wandered = focus_change_mm(kept_hold("vertex"))
    assert abs(wandered) == pytest.approx(0.093, abs=0.012)
    assert math.isnan(kept_hold("vertex")[-1].row.held_offset_um)


def test_focus_stays_without_a_laser() -> None:
    config = config_of("focus", "optics").model_copy(
        update={"twin": TWIN.model_copy(update={"laser": False})}
    )
    ticks = run_hold(config, 100.0, figures_s=0.2)
    assert ticks[-1].row.state == State.HOLD
    assert abs(focus_change_mm(ticks)) < 0.012


def test_best_fit_has_the_least_rms() -> None:
    """At the held depth the RMS against the first figure is less than at any other."""
    ticks = kept_hold("best_fit")
    part = [tick for tick in ticks if tick.row.mono_s >= 95.0]
    before = [tick for tick in ticks if STARTS_S - 5.0 <= tick.row.mono_s < STARTS_S]
    moved_um = float(np.mean([sag_um(tick) for tick in part])) - float(
        np.mean([sag_um(tick) for tick in before])
    )
    # The least squares by a dense grid of the used aperture
    axis = np.linspace(-0.95, 0.95, 201)
    x, y = np.meshgrid(axis, axis)
    used = x**2 + y**2 <= 0.95**2
    rho2 = (x**2 + y**2)[used]
    change = SPHERICAL_UM * math.sqrt(5) * (6 * rho2**2 - 6 * rho2)
    bowl = hencky_profile(rho2)
    bowl, change = bowl - bowl.mean(), change - change.mean()
    best_um = -float(bowl @ change / (bowl @ bowl))
    assert moved_um == pytest.approx(best_um, abs=0.15)


def test_a_stored_figure_defines_the_setpoint_0() -> None:
    """The mirror moves to where it comes closest to a figure that is 3 µm deeper."""
    stored = (SAG_UM + 3.0) * zernike_projection()
    config = config_of("best_fit", reference_figure_um=tuple(stored.tolist()))
    ticks = run_hold(config, STARTS_S)
    assert sag_um(ticks[-1]) == pytest.approx(SAG_UM + 3.0, abs=0.2)
    assert ticks[-1].row.held_offset_um == pytest.approx(3.0, abs=0.3)


def test_lost_optics_leave_the_last_offset_with_events() -> None:
    lost: Alter = lambda now_s, figure: None if 75.0 <= now_s < 115.0 else figure  # noqa: E731
    ticks = run_hold(config_of("focus", "laser", held_keep_s=20.0), 125.0, lost)
    offsets = [tick.row.held_offset_um for tick in ticks if 80.0 <= tick.row.mono_s < 115.0]
    assert np.ptp(offsets[200:]) == 0.0
    assert states_of(ticks)[-4:] == ["tracking", "kept", "expired", "tracking"]
    opened = [e for tick in ticks for e in tick.events if isinstance(e, Maintenance)]
    closed = [e for tick in ticks for e in tick.events if isinstance(e, MaintenanceOver)]
    assert [e.name for e in opened].count("held_offset") == 1
    assert [e.name for e in closed].count("held_offset") == 1
    assert ticks[-1].row.state == State.HOLD
    steps = np.diff([tick.row.held_offset_um for tick in ticks])
    assert np.abs(steps).max() <= 1.01 * SHAPE.trim_rate_max_um_per_s / RATE_HZ


def test_frozen_optics_do_not_move_the_offset() -> None:
    kept: list[ShapeEstimate] = []

    def freeze(now_s: float, figure: ShapeEstimate) -> ShapeEstimate:
        if now_s < 50.0:
            kept[:] = [figure]
            return figure
        return replace(kept[0], time_s=figure.time_s, displacement_um=figure.displacement_um)

    ticks = run_hold(config_of("focus", "laser"), 80.0, freeze)
    late = [tick.row.held_offset_um for tick in ticks if tick.row.mono_s > 55.0]
    assert np.ptp(late) == 0.0
    events = [e for tick in ticks for e in tick.events if isinstance(e, HeldScalarState)]
    assert (events[-1].state, events[-1].code) == ("kept", "camera_repeats")


@pytest.mark.parametrize(
    ("fault", "code"),
    [("nan", "not_finite"), ("jump", "figure_jump")],
)
def test_bad_figures_do_not_move_the_offset(fault: str, code: str) -> None:
    def spoil(now_s: float, figure: ShapeEstimate) -> ShapeEstimate:
        if now_s < 50.0:
            return figure
        if fault == "nan":
            return replace(figure, coeffs_um=np.full_like(figure.coeffs_um, math.nan))
        return replace(figure, coeffs_um=figure.coeffs_um + figure_change(12.0))

    ticks = run_hold(config_of("focus", "laser"), 70.0, spoil)
    late = [tick.row.held_offset_um for tick in ticks if tick.row.mono_s > 51.0]
    assert np.ptp(late) == 0.0
    events = [e for tick in ticks for e in tick.events if isinstance(e, HeldScalarState)]
    assert events[-1].code == code
    assert ticks[-1].row.state == State.HOLD


def test_after_an_error_the_offset_stays_until_the_fault_of_the_next_tick(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = VirtualBench(Plant(TWIN, PumpConfig()))
    config = config_of("focus", "laser")
    film = ChangingFilm(bench, config, 3, spherical_at, None)
    run = VirtualRun(config, bench, zernike_projection(), film)
    context = run._supervisor._controller._context
    run.run_tick((Command("hold", "a test", "it runs"),))
    while run.now_s < STARTS_S or context.held_offset_um == 0.0:
        assert run.run_tick() is not None
    before_um = context.held_offset_um

    def fail(*_: object) -> float:
        raise ValueError("an error")

    monkeypatch.setattr(HeldOffset, "step", fail)
    tick = run.run_tick()
    assert tick is not None
    assert tick.row.state == State.HOLD
    assert context.held_offset_um == before_um
    tick = run.run_tick()
    assert tick is not None
    assert [e.name for e in tick.events if isinstance(e, Fault)] == ["tick_error"]
    assert tick.row.state == State.FAULT
    assert context.held_offset_um == 0.0  # not applied in a fault
    assert tick.row.held_offset_um == before_um  # but kept for the next hold


def test_a_start_without_a_figure_holds_the_vertex() -> None:
    ticks = run_hold(config_of("focus", "laser"), 40.0, lambda now_s, figure: None)
    assert ticks[-1].row.state == State.HOLD
    assert ticks[-1].row.held_offset_um == 0.0
    assert "tracking" not in states_of(ticks)
    assert abs(ticks[-1].inputs.truth_displacement_um) < 1.0


def test_the_offset_is_bounded_with_a_notice() -> None:
    config = config_of("focus", "laser", held_offset_max_um=1.0)
    ticks = run_hold(config, 90.0)
    assert max(abs(tick.row.held_offset_um) for tick in ticks) <= 1.0
    notices = [e for tick in ticks for e in tick.events if isinstance(e, Maintenance)]
    assert [e.name for e in notices] == ["held_offset"]


def test_off_and_on_accept_the_present_figure() -> None:
    """The mirror stays where it is; later changes count from there."""
    commands = {850: Command("shape_off", "ann"), 860: Command("shape_on", "ann")}
    ticks = run_hold(config_of("focus", "laser"), 100.0, commands=commands)
    offsets = np.array([tick.row.held_offset_um for tick in ticks])
    assert np.ptp(offsets[850:]) < 0.1
    assert abs(offsets[-1]) > 1.5


def test_a_replayed_hold_is_the_same_to_the_last_bit() -> None:
    config = config_of("focus", "laser")
    ticks = run_hold(config, 60.0)
    controller = Controller(config, zernike_projection(), held_weights=find_held_weights(config))
    for tick in ticks:
        outputs = controller.tick(tick.inputs)
        assert outputs.row == tick.row or repr(outputs.row) == repr(tick.row)
        assert outputs.events == tick.events
    continued = run_hold(config, 60.0, continued_at_s=47.0)
    assert [repr(tick.row) for tick in continued] == [repr(tick.row) for tick in ticks]


def test_a_hold_of_the_vertex_is_as_without_the_key() -> None:
    """The default does nothing: no event, no offset, no state."""
    ticks = kept_hold("vertex")
    assert states_of(ticks) == []
    assert all(math.isnan(tick.row.held_offset_sigma_um) for tick in ticks)
    assert HeldState.OFF == 0


def test_what_cannot_be_held_is_refused() -> None:
    config = config_of("focus").model_copy(update={"shape": ShapeConfig(enabled=False)})
    assert "loop.holds" in {f.field for f in cross_check(config) if f.severity == "error"}
    with pytest.raises(ValueError, match="give all 36"):
        LoopConfig(reference_figure_um=(1.0, 2.0))
