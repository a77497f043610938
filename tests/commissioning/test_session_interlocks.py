"""A circuit that opens while the session moves gas: the session stops in one line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import pytest

from membrane_ctrl.commissioning.guide.bench_access import HandAct, HandMotion
from membrane_ctrl.commissioning.guide.session_state import CONFIGURATION
from membrane_ctrl.config.schema import Config
from membrane_ctrl.config.toml_file import load_toml
from membrane_ctrl.controller.command import Command
from membrane_ctrl.hold.virtual_hold import VirtualHold
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.sessions.live_hold import News
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench
from tests.commissioning.guided import SHORT, Person, QuickBench, run_stages

DESK = ("mirror", "devices")
BOARD = {"driver": "board_input", "input": "0"}
MODULE = {"driver": "modbus_input", "link": "tcp://192.168.1.50", "address": "7"}
LINE = {"driver": "gpio_line", "chip": "/dev/gpiochip0", "line": "4"}
STATED = "emergency_stop is open: turn the red button"


def person_with(interlock: dict[str, str]) -> Person:
    return Person(**{f"interlock1.{key}": value for key, value in interlock.items()})


class OpeningHold(VirtualHold):
    """A hold during which a person acts, once it holds."""

    act: Callable[[], None] | None = None

    def read_news(self) -> News:
        news = super().read_news()
        if OpeningHold.act is not None and news.rows[-1].state == State.HOLD:
            act, OpeningHold.act = OpeningHold.act, None
            act()
        return news


def use_filled_mirror(folder: Path, bench: QuickBench) -> None:
    config = load_toml(folder / CONFIGURATION, Config)
    bench.use_mirror(VirtualBench(Plant(config.twin, config.pump)))


@pytest.mark.parametrize(
    ("stage", "interlock", "act"),
    [
        ("inflation", BOARD, HandAct.OPEN_CIRCUIT),
        ("leak", MODULE, HandAct.LOSE_SIGNAL),
        ("hold", LINE, HandAct.OPEN_CIRCUIT),
    ],
    ids=["inflation", "leak", "hold"],
)
def test_a_circuit_that_opens_during_a_hold(
    tmp_path: Path, stage: str, interlock: dict[str, str], act: HandAct
) -> None:
    bench = QuickBench(OpeningHold)
    run_stages(tmp_path, bench, person_with(interlock), *DESK)
    use_filled_mirror(tmp_path, bench)
    OpeningHold.act = lambda: bench.move_hand(HandMotion(act, "emergency_stop"))
    person = Person()
    assert run_stages(tmp_path, bench, person, stage) == Exit.INTERRUPTED
    (stopped,) = [line for line in person.shown if line.startswith("  stopped safely:")]
    assert STATED in stopped
    assert "Do: follow the interlock's text, close its circuit" in stopped
    assert bench.bench.board.pump_fraction == 0.0


class WaitingHold(VirtualHold):
    """A hold that continues while a question is open."""

    present: ClassVar[WaitingHold | None] = None
    unread: News | None = None

    def let_time_pass(self) -> None:
        self.unread = super().read_news()

    def read_news(self) -> News:
        WaitingHold.present = self
        if self.unread is None:
            return super().read_news()
        unread, self.unread = self.unread, None
        return unread


class ThinkingPerson(Person):
    """Lets a second pass before the second step of the inflation, in which a circuit opens."""

    def __init__(self, bench: QuickBench) -> None:
        super().__init__()
        self._bench = bench

    def read_line(self, key: str, prompt: str) -> str:
        steps = [asked for asked in self.asked if asked.startswith("fill_")]
        if key.startswith("fill_") and steps and WaitingHold.present is not None:
            self._bench.move_hand(HandMotion(HandAct.OPEN_CIRCUIT, "emergency_stop"))
            WaitingHold.present.let_time_pass()
            WaitingHold.present = None
        return super().read_line(key, prompt)


def test_a_circuit_that_opens_while_a_question_is_open_is_named(tmp_path: Path) -> None:
    """Not the command that the fault refuses."""
    bench = QuickBench(WaitingHold)
    run_stages(tmp_path, bench, person_with(BOARD), *DESK)
    use_filled_mirror(tmp_path, bench)
    WaitingHold.present = None
    person = ThinkingPerson(bench)
    plan = replace(SHORT, inflation_shares=(1.0, 1.0005))
    assert run_stages(tmp_path, bench, person, "inflation", plan=plan) == Exit.INTERRUPTED
    (stopped,) = [line for line in person.shown if line.startswith("  stopped safely:")]
    assert STATED in stopped
    assert "refused" not in stopped


class OpeningBench(QuickBench):
    """A person opens a circuit while the pump runs."""

    highest = 0.0

    async def _sleep(self, duration_s: float) -> None:
        await super()._sleep(duration_s)
        self.highest = max(self.highest, self.bench.board.pump_fraction)
        if self.bench.board.pump_fraction > 0.0:
            self.move_hand(HandMotion(HandAct.OPEN_CIRCUIT, "emergency_stop"))


@pytest.mark.parametrize("stage", ["outputs", "watchdog", "cable"])
def test_a_circuit_that_opens_while_the_wiring_is_tried(tmp_path: Path, stage: str) -> None:
    bench = OpeningBench()
    run_stages(tmp_path, bench, Person(), *DESK, "probe")
    person = Person()
    assert run_stages(tmp_path, bench, person, stage) == Exit.INTERRUPTED
    assert bench.highest > 0.0
    assert STATED in person.text
    assert "Close the circuit, then run this stage again" in person.text
    assert bench.bench.board.pump_fraction == 0.0
    # The circuit is still open: the pump does not start.
    bench.highest = 0.0
    again = Person()
    run_stages(tmp_path, bench, again, stage)
    assert STATED in again.text
    assert bench.highest == 0.0


class LatchedBench(QuickBench):
    """An earlier hold has latched a fault."""

    latched = "interlock_open: a circuit is open"

    def find_latched_fault(self, folder: Path) -> str:
        return self.latched


class AcknowledgedHold(VirtualHold):
    """A hold that lists its commands."""

    sent: ClassVar[list[str]] = []

    def send_command(self, command: Command) -> None:
        self.sent.append(command.kind)
        super().send_command(command)


@pytest.mark.parametrize(("answer", "sent"), [("y", ["ack", "hold"]), ("n", [])])
def test_the_fault_of_an_earlier_hold_is_acknowledged_by_a_person(
    tmp_path: Path, answer: str, sent: list[str]
) -> None:
    bench = LatchedBench(AcknowledgedHold)
    run_stages(tmp_path, bench, Person(), *DESK)
    use_filled_mirror(tmp_path, bench)
    AcknowledgedHold.sent.clear()
    person = Person(acknowledge=answer)
    run_stages(tmp_path, bench, person, "inflation")
    assert "an earlier hold ended by a fault: interlock_open" in person.text
    assert [kind for kind in AcknowledgedHold.sent if kind in ("ack", "hold")] == sent
