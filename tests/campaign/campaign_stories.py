"""Stories of commands: what people send, in what order, and what the controller does.

Each story returns its violations; it judges the true mirror, as the matrix does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from campaign_run import relay_about
from campaign_stage import Stage
from campaign_times import DISPLACEMENT_MAX_UM, TICK_S
from campaign_world import World

from membrane_ctrl.controller import state_handlers
from membrane_ctrl.controller.command import Command, Kind
from membrane_ctrl.controller.tick_context import TickContext
from membrane_ctrl.model.telemetry import State


def an_acknowledgement_counts_once() -> list[str]:
    """A fault, its acknowledgement, a second hold and a second fault: the second fault stays."""
    stage = Stage().held()
    for last in (False, True):
        stage.bench.wrong.late_ms = 150.0
        stage.until(State.FAULT)
        stage.bench.wrong.late_ms = 0.0
        stage.wait(15.0)
        stage.must(stage.state == State.FAULT, "the fault went away by itself")
        if not last:
            stage.ask("ack")
            stage.until(State.STANDBY, 10.0)
            stage.wait(20.0, stage.still)
            stage.held()
    stage.wait(20.0, stage.still)
    return stage.violations


def an_acknowledgement_before_the_fault() -> list[str]:
    """An acknowledgement in standby or in a hold does not clear a later fault."""
    stage = Stage()
    stage.wait(1.0)
    stage.ask("ack")
    stage.held()
    stage.ask("ack")
    stage.bench.wrong.late_ms = 150.0
    stage.until(State.FAULT)
    stage.bench.wrong.late_ms = 0.0
    stage.wait(15.0)
    stage.wait(30.0, stage.still)
    stage.must(stage.state == State.FAULT, "acknowledged before it came")
    return stage.violations


def a_lock_during_a_fault_that_may_resume() -> list[str]:
    """A person locks the mirror while the resume rule waits: nothing resumes."""
    stage = Stage(resumes=True).held()
    stage.bench.wrong.late_ms = 150.0
    stage.until(State.FAULT)
    stage.bench.wrong.late_ms = 0.0
    stage.wait(1.0)
    stage.ask("latch")
    stage.wait(10.0)
    stage.wait(60.0, stage.still)
    return stage.violations


def a_lock_while_it_vents() -> list[str]:
    """Over-pressure has opened the vent, then a person locks the mirror: the vent stays open."""
    stage = Stage().held()
    stage.bench.wrong.gauge_offset_pa = 60.0
    stage.until(State.FAULT)
    stage.wait(2.0)
    stage.bench.wrong.gauge_offset_pa = 0.0
    stage.wait(1.0)
    stage.ask("latch")
    stage.wait(
        8.0,
        lambda: (
            stage.still() or ("" if stage.plant.vent_given == 1.0 else "the lock has shut the vent")
        ),
    )
    return stage.violations


def manual_once_is_not_manual_again() -> list[str]:
    """`manual`, then `hold`: the mirror is held again."""
    stage = Stage().held()
    stage.ask("manual", value=stage.world.holding_flow_um_per_s)
    stage.wait(3.0)
    stage.held()
    stage.wait(
        10.0, lambda: "manual again, and nobody has asked" if stage.state == State.MANUAL else ""
    )
    stage.near()
    return stage.violations


def a_cause_that_lasts_is_acknowledged() -> list[str]:
    """An acknowledgement while the cause lasts brings no gas: the next hold trips again."""
    stage = Stage().held()
    stage.bench.wrong.gauge_offset_pa = 50.0
    stage.until(State.FAULT)
    stage.wait(5.0)
    stage.ask("ack")
    stage.wait(5.0, stage.still)
    stage.ask("hold")
    stage.wait(30.0)
    stage.must(not stage.still() and stage.plant.vent_given == 1.0, "inflates under over-pressure")
    return stage.violations


def a_lock_forbids_the_hold() -> list[str]:
    """`latch` in standby, alone or in one tick with `hold`: no gas before an acknowledgement."""
    violations = []
    for order in (("latch",), ("latch", "hold"), ("hold", "latch")):
        stage = Stage()
        stage.wait(1.0)
        stage.ask(*order)
        stage.wait(1.0)
        stage.ask("hold")
        stage.wait(8.0, stage.still)
        violations += [f"{' + '.join(order)}: {what}" for what in stage.violations]
    return violations


def two_orders_in_one_tick() -> list[str]:
    """A lowering command and another one in one tick, in both orders and in four states: lowering
    wins.
    """
    violations = []
    others: tuple[Kind, ...] = ("hold", "resume", "manual", "setpoint", "ack")
    for way in ("latch", "vent", "stop", "lower"):
        for other in others:
            for asked in ((way, other), (other, way)):
                stage = Stage().held()
                stage.tick(*(Command(kind, "story", value=1.0) for kind in asked))  # type: ignore[arg-type]
                stage.wait(12.0 if way == "latch" else 2 * TICK_S)
                stage.wait(3.0, stage.still)
                violations += [f"{' + '.join(asked)}: {what}" for what in stage.violations]
    return violations


def vent_and_stop_from_everywhere() -> list[str]:
    """`vent`, `lower` and `stop` from manual, tune and pause:
    the pump stops at once and stays off.
    """
    violations = []
    for way in ("vent", "lower", "stop"):
        for situation in ("manual", "pause", "tune", "hold"):
            stage = Stage().held()
            flow_um_per_s = stage.world.holding_flow_um_per_s
            if situation != "hold":
                relay = relay_about(flow_um_per_s) if situation == "tune" else None
                stage.tick(Command(situation, "story", value=flow_um_per_s, experiment=relay))  # type: ignore[arg-type]
                stage.wait(2.0)
            stage.ask(way)  # type: ignore[arg-type]
            stage.wait(2 * TICK_S)
            if way == "vent":
                stage.must(stage.plant.vent_given == 1.0, "the vent stays shut")
            stage.wait(10.0, stage.still)
            violations += [f"{way} in {situation}: {what}" for what in stage.violations]
    return violations


def venting_to_the_end() -> list[str]:
    """`vent` empties the mirror, and only then enters standby."""
    stage = Stage().held()
    stage.ask("vent")
    for _ in range(round(1200.0 / TICK_S)):
        if stage.state == State.STANDBY:
            break
        stage.must(
            stage.plant.vent_given == 1.0 or stage.run.now_s < 30.0, "the vent shuts on the way"
        )
        stage.tick()
    pressure_pa = stage.plant.truth().gauge_pressure_pa
    stage.must(stage.state == State.STANDBY and pressure_pa < 110.0, f"{pressure_pa:.0f} Pa left")
    return stage.violations


def a_vent_that_was_stopped_goes_on_as_stop() -> list[str]:
    """`stop` and then `vent`: the run ends."""
    stage = Stage().held()
    stage.ask("stop", "vent")
    stage.wait(1.0)
    stage.wait(700.0, stage.still)
    stage.must(stage.run.finished is not None, "the stop was forgotten")
    return stage.violations


def orders_beyond_the_limits() -> list[str]:
    """A setpoint or flow beyond the limits moves nothing."""
    stage = Stage().held()
    for value in (math.nan, math.inf, -math.inf, 1e6, DISPLACEMENT_MAX_UM + 1.0):
        stage.ask("setpoint", value=value)
        stage.wait(8.0)
        stage.near()
    for value in (math.nan, math.inf, -1.0, 1e6):
        stage.ask("manual", value=value)
        stage.wait(4.0)
        stage.must(stage.state == State.HOLD, f"manual with {value:g} µm/s was taken")
        stage.near()
    return stage.violations


def a_pause_ends() -> list[str]:
    """A pause that nobody ends lapses, and the mirror returns to its setpoint."""
    stage = Stage(world=World(leak=1.2)).held()
    stage.wait(20.0)
    stage.ask("pause")
    stage.plant._leak_ml_per_s_per_pa *= 1.2  # the mean flow no longer suffices
    stage.wait(50.0)
    stage.near()
    return stage.violations


def manual_has_an_end() -> list[str]:
    """An operator sets a flow and leaves: the mirror does not go far, and is held again."""
    violations = []
    for share in (0.3, 1.0, 2.0):
        stage = Stage().held()
        stage.ask("manual", value=share * stage.world.holding_flow_um_per_s)

        def far(at: Stage = stage) -> str:
            way_um = at.plant.truth().displacement_um
            return f"in manual, and the mirror went {way_um:.0f} µm" if abs(way_um) > 30.0 else ""

        stage.wait(150.0, far)
        stage.must(stage.state == State.HOLD, "the operator has left, and nobody holds the mirror")
        violations += [f"{share} of the mean flow: {what}" for what in stage.violations]
    return violations


def manual_without_light() -> list[str]:
    """No laser in manual: the pump keeps its mean flow, whatever the operator had set."""
    stage = Stage().held()
    stage.wait(20.0)
    stage.ask("manual", value=5.0)
    stage.tick()
    stage.bench.wrong.no_light = True
    before_um = stage.plant.truth().displacement_um
    stage.wait(10.0)
    went_um = stage.plant.truth().displacement_um - before_um
    stage.must(went_um < 12.0, f"blind in manual, and the bowl went {went_um:.0f} µm deeper")
    return stage.violations


def resumes_of_a_day() -> list[str]:
    """A cause comes and goes for an hour: the hold resumes as often as a day allows,
    and no more.
    """
    stage = Stage(resumes=True).held()
    begun = 0
    for _ in range(5):
        stage.bench.wrong.unreachable = True
        stage.wait(2.0)
        stage.bench.wrong.unreachable = False
        was = stage.state
        stage.wait(70.0)
        begun += was == State.FAULT and stage.state != State.FAULT
    stage.must(begun <= 2, f"resumed {begun} times")
    return stage.violations


def a_handler_that_gives_nonsense() -> list[str]:
    """A state's code computes NaN, 2 or -1 for the pump: 0 is written."""
    violations = []
    before = state_handlers.HANDLERS[State.HOLD]
    for nonsense in (math.nan, 2.0, -1.0, math.inf):
        stage = Stage().held()

        def wrong(context: TickContext, value: float = nonsense) -> State:
            context.pump_fraction = value
            return State.HOLD

        state_handlers.HANDLERS[State.HOLD] = wrong
        try:
            stage.tick()
            stage.must(not stage.still(), f"{nonsense} for the pump, and it is driven")
            stage.wait(5.0, stage.still)
        except Exception as error:
            stage.must(False, f"{nonsense} for the pump: {error!r}")
        finally:
            state_handlers.HANDLERS[State.HOLD] = before
        violations += stage.violations
    return violations


STORIES: Sequence[Callable[[], list[str]]] = (
    an_acknowledgement_counts_once,
    an_acknowledgement_before_the_fault,
    a_lock_during_a_fault_that_may_resume,
    a_lock_while_it_vents,
    manual_once_is_not_manual_again,
    a_cause_that_lasts_is_acknowledged,
    a_lock_forbids_the_hold,
    two_orders_in_one_tick,
    vent_and_stop_from_everywhere,
    venting_to_the_end,
    a_vent_that_was_stopped_goes_on_as_stop,
    orders_beyond_the_limits,
    a_pause_ends,
    manual_has_an_end,
    manual_without_light,
    resumes_of_a_day,
    a_handler_that_gives_nonsense,
)
