"""The console's content, and that it fits."""

from __future__ import annotations

import io
import math
import socket
from dataclasses import replace
from pathlib import Path

import pytest
from console_feed import FAULT, HOLDING, NOTHING, event, rows, shape
from rich.console import Console

from membrane_ctrl.config.schema import Config
from membrane_ctrl.console.model import ConsoleModel, event_line
from membrane_ctrl.console.page_link import PageLink
from membrane_ctrl.console.process import format_line
from membrane_ctrl.console.view import ConsolePage, full_scale, level_bar, signed_bars
from membrane_ctrl.console.why import format_duration, format_number, format_percent
from membrane_ctrl.control_port.service_link import publish_address
from membrane_ctrl.model.event_lines import from_dict
from membrane_ctrl.model.telemetry import SafeLevel, ShapeState, State

CONFIG = Config()


def held(duration_s: float | None = 120.0) -> ConsoleModel:
    model = ConsoleModel(CONFIG, duration_s)
    for row in rows(75.0):
        model.add_row(row)
    model.add_shape(shape(6.0))
    model.add_shape(shape(73.8, sag_um=37100.03, cycle=2))
    return model


def drawn(
    model: ConsoleModel,
    now_s: float = 75.0,
    width: int = 80,
    height: int = 24,
    foot: str = "",
    help_: bool = False,
    link: str = "",
) -> list[str]:
    console = Console(width=width, height=height, record=True, file=io.StringIO())
    view = model.make_view(now_s)
    console.print(
        ConsolePage(view, CONFIG, "logs/20261121T031200Z-demo", foot, help_=help_, link=link)
    )
    return console.export_text().rstrip("\n").splitlines()


def test_everything_a_person_wants_is_there() -> None:
    page = "\n".join(drawn(held()))
    for words in (
        "hold for 1:15",
        "pump gives 1.14 µm/s: +1.24 integral, -0.11 feed-forward",
        "within ±2",
        "truth +0.03 µm (laser",
        "29 %, 1.140 of 5.3 µm/s",
        "leak 1.240 µm/s  gauge 600.0 Pa  ambient 101325.0 Pa  air 20.01 °C",
        "tracking  trim +0.12 µm  sag +0.030 ± 0.017 µm since 6 s",
        "ok  1 s ago, fringes, residual 3.1 µrad, in 31 ms  0/2 rejected",
        "worst of the minute",
        "faults none",
        "run 1:15, 45 s left · logs/20261121T031200Z-demo",
    ):
        assert words in page


def test_real_bench_shows_no_truth_and_an_open_run_no_end() -> None:
    model = held(duration_s=None)
    model.add_row(replace(HOLDING, mono_s=75.0, truth_displacement_um=math.nan))
    page = "\n".join(drawn(model))
    assert "truth" not in page
    assert "until stopped" in page


def test_the_held_scalar_is_shown_with_its_offset() -> None:
    model = held()
    assert not any("scalar" in line for line in drawn(model))
    model.add_row(replace(rows(76.0)[-1], held_offset_um=-3.21, held_offset_sigma_um=0.04))
    model.add_event(event(70.0, "held", holds="focus", state="tracking", offset_um=0.0, reason=""))
    page = "\n".join(drawn(model, width=120))
    assert "scalar focus is held; the centre stands -3.21 ± 0.040 µm from the setpoint" in page


def everything_wrong() -> ConsoleModel:
    model = held()
    model.add_event(event(75.0, "fault", **FAULT))
    model.add_event(
        event(
            75.0,
            "shape",
            state="suspended",
            reason="no fresh estimate for 15 s: the last trim is held",
        )
    )
    model.add_shape(
        shape(70.0, verdict="rejected", reason="tracking lost: the film moved by 5 mrad")
    )
    model.add_event(
        event(75.0, "recorder_error", what="recording", message="events.jsonl: No space left " * 20)
    )
    row = replace(
        HOLDING,
        state=State.FAULT,
        shape_state=ShapeState.SUSPENDED,
        safe_level=SafeLevel.VENT,
        fault=30.0,
    )
    model.add_row(
        replace(row, mono_s=75.0, tick=3e6, missed_ticks=12.0, vent_fraction=1.0, leak_um_per_s=0.1)
    )
    return model


@pytest.mark.parametrize("width", [80, 100, 160])
@pytest.mark.parametrize("wrong", [False, True])
def test_it_fits(width: int, wrong: bool) -> None:
    page = drawn(everything_wrong() if wrong else held(), width=width)
    assert len(page) <= 24
    assert all(len(row) == width for row in page)


@pytest.mark.parametrize(("width", "height"), [(60, 15), (70, 18), (80, 24), (132, 43), (250, 70)])
@pytest.mark.parametrize("wrong", [False, True])
@pytest.mark.parametrize("help_", [False, True])
def test_every_terminal_is_used_and_none_overflows(
    width: int, height: int, wrong: bool, help_: bool
) -> None:
    page = drawn(
        everything_wrong() if wrong else held(),
        width=width,
        height=height,
        foot="h hold",
        help_=help_,
    )
    assert len(page) <= height
    assert all(len(row) == width for row in page)
    assert page[-2][2:].startswith("h hold")  # the last line inside
    assert any("error" in row for row in page)
    assert any("faults" in row for row in page)
    if height >= 43 and not help_:
        assert len(page) == height
        assert sum("█" in row or "▇" in row for row in page) >= 4  # higher bars
    if (height, wrong) != (15, True):  # a fault takes the space of the help
        assert any("start to hold" in row for row in page) == help_


def test_a_wide_terminal_shows_a_longer_trend() -> None:
    model = ConsoleModel(CONFIG)
    for row in rows(150.0):
        model.add_row(row)
    page = drawn(model, now_s=150.0, width=160)
    upper, lower = (
        next(row for row in page if f"{sign}1 µm" in row or f"{sign}2 µm" in row) for sign in "+-"
    )
    both = [a != " " or b != " " for a, b in zip(upper[12:-2], lower[12:-2], strict=True)]
    assert sum(both) > 140


def test_a_large_terminal_lists_the_last_events_with_those_who_caused_them() -> None:
    model = held()
    for k in range(70):
        model.add_event(event(70.0, "command", command="setpoint", who="unix:ann", why=f"step {k}"))
    model.add_event(
        event(70.0, "command", command="hold", who="unix:tom", why="", refused="not now")
    )
    model.add_event(event(70.0, "why", why="only the headline says this"))
    page = "\n".join(drawn(model, width=100, height=40))
    assert "03:12:00  Command setpoint by unix:ann: step 69" in page
    assert "Command hold by unix:tom. Refused: not now" in page
    assert "step 20" not in page
    assert "only the headline" not in page


def test_a_state_that_waits_for_a_person_shows_the_next_command() -> None:
    model = ConsoleModel(CONFIG, ctl="membrane-ctrl ctl --socket x/control.sock", keys=True)
    model.add_row(replace(HOLDING, state=State.STANDBY))
    assert any(
        "next: `membrane-ctrl ctl --socket x/control.sock hold` or key h" in row
        for row in drawn(model, 0.0)
    )
    model.add_event(
        event(0.0, "command", command="latched", who="command line", why="", text="over_pressure")
    )
    view = model.make_view(0.0)
    assert view.next_step == "next: `membrane-ctrl ctl --socket x/control.sock ack`"
    assert format_line(view).endswith(view.next_step)
    model.add_row(HOLDING)
    assert model.make_view(0.0).next_step == ""
    model.add_event(
        event(0.0, "why", why="held up by ann: the pump keeps its mean flow", code="paused")
    )
    assert model.make_view(0.0).paused
    assert model.make_view(0.0).next_step.endswith("resume` or key p")


def test_each_lock_is_shown_first_with_text_author_time_and_word_until_it_is_removed() -> None:
    model = ConsoleModel(CONFIG, ctl="ctl", keys=True)
    model.add_row(replace(HOLDING, state=State.STANDBY))
    for word, author in (("bofak", "unix:ann"), ("gumil", "page:bob")):
        fields = {
            "word": word,
            "author": author,
            "account": author,
            "session": "s",
            "set_utc": "2026-01-02",
            "number": 1,
        }
        model.add_event(event(0.0, "lock", text="hands inside", **fields))
    page = " ".join(" ".join(drawn(model, 0.0)).replace("│", " ").split())
    for author, word in (("unix:ann", "bofak"), ("page:bob", "gumil")):
        assert f'LOCKED "hands inside" by {author} (s), 2026-01-02, word {word}' in page
        assert f'LOCKED "hands inside" by {author} (s), 2026-01-02, word {word}' in format_line(
            model.make_view(0.0)
        )
    assert model.make_view(0.0).next_step == "next: ask unix:ann, then `ctl unlock bofak`"
    removed = {"text": "", "author": "", "set_utc": "", "remover": "", "how": "word", "number": 2}
    model.add_event(event(0.0, "unlock", word="bofak", **removed))
    assert model.make_view(0.0).next_step == "next: ask page:bob, then `ctl unlock gumil`"
    model.add_event(event(0.0, "unlock", word="gumil", **removed))
    assert model.make_view(0.0).locks == ()
    assert "hold" in model.make_view(0.0).next_step


def test_fault_and_its_remedy_are_seen() -> None:
    page = " ".join(" ".join(drawn(everything_wrong())).replace("│", " ").split())
    assert "pump is off and the vent is open: link lost" in page
    assert (
        "link lost: the link to the pump board is down (link down); check cable, power and address"
        in page
    )
    assert "12 of 3000012 ticks missed" in page


def test_trouble_with_the_recording_is_seen_until_it_is_over() -> None:
    model = held()
    model.add_event(
        event(75.0, "disk_low", what="disk", message="less than 500 MB free; delete old runs")
    )
    low = "Disk almost full: less than 500 MB free; delete old runs"
    assert any(f"notice {low}" in " ".join(row.split()) for row in drawn(model))
    assert format_line(model.make_view(75.0)).count(low) == 1
    model.add_event(event(76.0, "recorder_recovered", what="disk", message="disk works again"))
    assert not any("notice" in row for row in drawn(model))
    assert "500 MB" not in format_line(model.make_view(75.0))


def test_of_many_notices_the_first_are_shown() -> None:
    model = held()
    for nth in range(5):
        model.add_event(
            event(75.0, "recorder_error", what=f"file {nth}", message=f"file {nth} failed")
        )
    shown = [" ".join(row.split()) for row in drawn(model) if "notice" in row]
    assert len(shown) == 4
    assert "Not recorded: file 0 failed" in shown[0]
    assert "and 2 more" in shown[3]


def test_silence_is_the_headline() -> None:
    assert any("no tick for 4.0 s" in row for row in drawn(held(), now_s=78.98))


def test_before_the_first_tick_and_with_nothing_known() -> None:
    assert any("waiting for the first tick" in row for row in drawn(ConsoleModel(CONFIG)))
    model = ConsoleModel(CONFIG)
    model.add_row(
        replace(
            NOTHING,
            mono_s=0.0,
            tick=1.0,
            missed_ticks=0.0,
            state=0.0,
            shape_state=0.0,
            safe_level=0.0,
        )
    )
    assert not any("nan" in row for row in drawn(model))
    assert "nan" not in format_line(model.make_view(0.0))


def test_plain_line_has_the_second_in_it() -> None:
    line = format_line(held().make_view(75.0))
    for words in (
        "75.0 s  hold",
        "error",
        "pump  29 %",
        "leak 1.240 µm/s",
        "shape tracking ok 1 s",
        "45 s left",
    ):
        assert words in line
    assert "\n" not in line
    assert "no tick for 10.0 s" in format_line(held().make_view(84.98))
    assert format_line(ConsoleModel(CONFIG).make_view(0.0)).endswith("no tick yet")


def test_plain_events() -> None:
    assert event_line(event(12.345, "fault", **FAULT)) == (
        "     12.3 s  Fault link_lost: the link to the pump board is down (link down). Do: "
        "check cable, power and "
        "address; a board's watchdog stops its pump. Limit: must be up; safe level pump_off"
    )
    assert (
        event_line(event(1.0, "state", state="hold", why="settled"))
        == "      1.0 s  State hold: settled"
    )
    assert event_line({"kind": "end", "exit": "done"}) == "        – s  Run ended: done"
    assert event_line({"kind": "end", "exit": 5}) == "        – s  end: exit 5"
    assert event_line(event(1.0, "raw_frames", message="a\n  b")) == "      1.0 s  A b"


def test_faults_and_state_changes_are_drawn_at_once() -> None:
    kinds = ("fault", "cleared", "state", "link", "child_ended", "end", "command", "start")
    kinds += (
        "recorder_error",
        "disk_low",
        "recorder_recovered",
        "interlock_opened",
        "interlock_closed",
    )
    assert all(from_dict({"kind": kind}).notable for kind in kinds)
    assert not any(
        from_dict({"kind": kind}).notable
        for kind in ("why", "shape", "sensors_used", "pump", "vibrations")
    )
    assert from_dict({"kind": "acquisition", "state": "retrying"}).notable
    assert not from_dict({"kind": "acquisition", "state": "running"}).notable


def test_bars_stand_and_hang() -> None:
    upper, lower = signed_bars([2.0, 0.0, -1.0, math.nan, 3.0], full=2.0, band=2.0)
    assert upper.plain == "█▁  █"
    assert lower.plain == "  ▄  "  # the upper half is the bar: it is drawn in reverse
    assert [span.style for span in upper.spans] == ["green", "green", "red"]


@pytest.mark.parametrize(
    ("largest", "full"),
    [(0.0, 0.5), (0.4, 0.5), (0.7, 1.0), (1.0, 1.0), (1.1, 2.0), (30.0, 50.0), (51.0, 100.0)],
)
def test_full_scale_is_a_round_figure(largest: float, full: float) -> None:
    assert full_scale([math.nan, -largest], 0.5) == pytest.approx(full)


@pytest.mark.parametrize(
    ("fraction", "bar"),
    [(0.0, "░░░░"), (0.5, "██░░"), (1.0, "████"), (7.0, "████"), (math.nan, "░░░░")],
)
def test_level_bar(fraction: float, bar: str) -> None:
    assert level_bar(fraction, 4).plain == bar


def test_words() -> None:
    spans_s = (0.9, 59.9, 60.0, 3599.0, 3600.0, 90061.0, math.nan)
    assert [format_duration(s) for s in spans_s] == [
        "0 s",
        "59 s",
        "1:00",
        "59:59",
        "1:00:00",
        "1 d 01:01:01",
        "–",
    ]
    assert format_number(-0.125, 2, "µm", sign=True) == "-0.12 µm"
    assert format_number(math.inf, 2, "µm") == "–"
    assert format_percent(0.254) == "25 %"


def test_the_link_of_the_page_is_shown_while_its_service_answers(tmp_path: Path) -> None:
    found = PageLink(tmp_path)
    assert found.find(0.0) == "", "there is no service"
    with socket.create_server(("127.0.0.1", 0)) as listener:
        url = f"http://127.0.0.1:{listener.getsockname()[1]}/"
        with publish_address(tmp_path, url, has_link=False):
            assert found.find(1.0) == "", "it is not looked for at each picture"
            assert found.find(3.0) == url
            listener.close()
            assert found.find(6.0) == ""
    page = drawn(held(), link="http://127.0.0.1:7480/?key=zERTzB4rBWUGFTpRBpd9KShA5xyoqVk1")
    assert len(page) == 24
    assert any(
        "page  http://127.0.0.1:7480/?key=zERTzB4rBWUGFTpRBpd9KShA5xyoqVk1" in line for line in page
    )
