"""A session that is watched while it runs, killed, and resumed."""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from membrane_ctrl.config.schema import Config, DevicesConfig, LoopConfig
from membrane_ctrl.model import telemetry
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.sessions import folder, progress
from membrane_ctrl.sessions.live_log import (
    ANSWER,
    NAME,
    LiveLog,
    LiveReader,
    PageAnswer,
    Progressed,
    write_answer,
)
from membrane_ctrl.sessions.progress import Progress
from membrane_ctrl.web.session_chart import SessionChart
from membrane_ctrl.web.session_status import describe_session, find_silent_s, is_running
from tuning import same_bench

RATE_HZ = 50.0


def row(tick: int, displacement_um: float) -> telemetry.TelemetryRow:
    values = dict.fromkeys(telemetry.FIELDS, math.nan)
    values |= {
        "tick": float(tick),
        "displacement_um": displacement_um,
        "setpoint_um": 1.0,
        "flow_um_per_s": 1.2,
    }
    return telemetry.TelemetryRow(**values)


def logged(path: Path) -> LiveLog:
    return LiveLog(path, RATE_HZ, lambda line: pytest.fail(line))


def held(log: LiveLog, seconds: float, displacement_um: float = 0.5) -> None:
    for tick in range(round(seconds * RATE_HZ)):
        log.add_tick(row(tick, displacement_um))


def test_a_reader_beside_the_session_reads_its_progress(tmp_path: Path) -> None:
    log, reader = logged(tmp_path), LiveReader(tmp_path)
    assert reader.read_new()["time_s"] == []
    log.log_entry("step", "observe", planned_s=300.0, after_s=320.0)
    held(log, 2.0)
    first = reader.read_new()
    assert first["time_s"] == pytest.approx([0.2 * n for n in range(1, 11)])
    assert first["displacement_um"] == pytest.approx([0.5] * 10)
    assert first["flow_um_per_s"] == pytest.approx([1.2] * 10)
    assert (reader.progress.step, reader.progress.planned_s, reader.progress.done_s) == (
        "observe",
        300.0,
        2.0,
    )
    held(log, 1.0, math.nan)
    log.log_entry("result", "observe: laser noise 1.00 µm")
    log.log_entry("step", "design", planned_s=0.0, after_s=320.0)
    log.log_entry("asks", "apply which?")
    more = reader.read_new()
    assert more["time_s"][0] == pytest.approx(2.2)
    assert all(math.isnan(value) for value in more["displacement_um"])
    assert reader.progress == Progressed(
        "design",
        0.0,
        320.0,
        0.0,
        "apply which?",
        "",
        ("observe: laser noise 1.00 µm",),
        ((0.0, "observe"), (3.0, "design")),
    )
    assert reader.read_new()["time_s"] == []


def test_a_line_torn_by_a_kill_costs_no_other_line(tmp_path: Path) -> None:
    log = logged(tmp_path)
    log.log_entry("step", "observe", planned_s=300.0, after_s=0.0)
    path = tmp_path / NAME
    path.write_bytes(path.read_bytes() + b'{"result": "hal')
    again = logged(tmp_path)
    again.log_entry("step", "verify", planned_s=600.0, after_s=0.0)
    reader = LiveReader(tmp_path)
    reader.read_new()
    assert reader.progress.step == "verify"
    assert [step for _, step in reader.progress.begun_s] == ["observe", "verify"]


def test_a_foreign_log_does_no_harm(tmp_path: Path) -> None:
    (tmp_path / NAME).write_bytes(
        b'[]\n5\n{"every_s": 1e400, "displacement_um": [], "setpoint_um": [], '
        b'"flow_um_per_s": []}\n\xff\xfe\n'
        b'{"every_s": 0.2, "displacement_um": [1], "setpoint_um": [1, 2], "flow_um_per_s": [1]}\n'
        b'{"step": {}, "planned_s": "x", "after_s": 1}\n{"result": "' + b"a" * 9000 + b'"}\n'
    )
    reader = LiveReader(tmp_path)
    assert reader.read_new()["time_s"] == []
    assert [len(line) for line in reader.progress.results] == [500]


def test_a_full_disk_ends_the_log_and_is_reported_once(tmp_path: Path) -> None:
    message: list[str] = []
    (tmp_path / NAME).mkdir()
    log = LiveLog(tmp_path, RATE_HZ, message.append)
    log.log_entry("result", "one")
    log.log_entry("result", "two")
    assert len(message) == 1
    assert NAME in message[0]


@pytest.mark.parametrize(
    ("progress", "done", "silent_s", "words"),
    [
        (Progressed(), 0, 0.0, "Nothing recorded yet"),
        (
            Progressed("observe", 300.0, 320.0, 60.0),
            2,
            1.0,
            "Now: observe, 1:00 of about 5:00; 9:20 of holding left",
        ),
        (Progressed("design"), 3, 40.0, "Now: design"),
        (
            Progressed("design", asks="which?"),
            5,
            4000.0,
            "Waiting for an answer: which?",
        ),
        (
            Progressed("verify", 600.0),
            6,
            100.0,
            "killed or hangs; resume it with: membrane-ctrl tune run --resume",
        ),
        (
            Progressed("verify", ended="interrupted"),
            6,
            0.0,
            "Ended after verify (interrupted); resume it with",
        ),
        (Progressed("verify", ended="done"), 7, 0.0, "Done."),
    ],
)
def test_the_page_shows_what_a_session_does(
    progress: Progressed, done: int, silent_s: float, words: str
) -> None:
    assert words in describe_session(
        progress, set(folder.STEPS[:done]), silent_s, Path("logs/tuning/s")
    )


def test_a_session_that_works_or_has_ended(tmp_path: Path) -> None:
    opened = folder.create_session(tmp_path, "s", "eve", "twin", Config(), LoopConfig())
    assert not is_running(opened.path)
    log = logged(opened.path)
    log.log_entry("step", "characterise", planned_s=10.0, after_s=0.0)
    assert is_running(opened.path)
    long_ago_s = time.time() - 1000.0
    os.utime(opened.path / NAME, (long_ago_s, long_ago_s))
    assert find_silent_s(opened.path) == pytest.approx(1000.0, abs=60.0)
    assert not is_running(opened.path), "killed"
    log.log_entry("ended", "done")
    assert not is_running(opened.path)


def test_the_chart_of_a_session_keeps_its_whole_course(tmp_path: Path) -> None:
    log, reader, chart = logged(tmp_path), LiveReader(tmp_path), SessionChart()
    log.log_entry("step", "observe", planned_s=10.0, after_s=0.0)
    for part in range(4):
        held(log, 600.0, displacement_um=part)
        chart.add_points(reader.read_new())
    log.log_entry("step", "<script>", planned_s=10.0, after_s=0.0)
    reader.read_new()
    options = chart.make_options(reader.progress.begun_s)
    by_name = {each["name"]: each["data"] for each in options["series"]}
    assert set(by_name) == {"centre", "setpoint", "flow"}
    minutes = [point[0] for point in by_name["centre"]]
    assert 1500 < len(minutes) <= 3000
    assert minutes == sorted(minutes)
    assert (minutes[0], minutes[-1]) == (pytest.approx(0.0, abs=0.1), pytest.approx(40.0, abs=0.1))
    assert {point[1] for point in by_name["centre"]} == {0.0, 1.0, 2.0, 3.0}
    (mark,) = [line for line in options["series"][0]["markLine"]["data"] if line["xAxis"] > 1]
    assert mark["name"] == "<script>", "as data: ECharts draws it on a canvas"
    json.dumps(options, allow_nan=False)


RUNNING = LoopConfig(kp_per_s=0.5, setpoint_um=7.0)


@pytest.mark.parametrize(
    ("running", "pump", "refused"),
    [
        (RUNNING, {}, ""),
        (RUNNING.model_copy(update={"setpoint_um": 0.0, "bleed_fraction": 0.01}), {}, ""),
        (
            RUNNING.model_copy(update={"kp_per_s": 0.61}),
            {},
            "loop.kp_per_s = 0.61, .* began with 0.5",
        ),
        (
            RUNNING,
            {"flow_full_um_per_s": 8.0},
            "pump.flow_full_um_per_s = 8.0, the session had 5.3",
        ),
        (RUNNING.model_copy(update={"rate_hz": 25.0}), {}, "loop.rate_hz = 25.0"),
    ],
)
def test_a_session_continues_with_a_later_hold_of_the_same_bench(
    tmp_path: Path, running: LoopConfig, pump: dict[str, float], refused: str
) -> None:
    opened = folder.create_session(
        tmp_path, "s", "eve", "an-earlier-run", Config(loop=RUNNING), RUNNING
    )
    config = Config(loop=running)
    config = config.model_copy(update={"pump": config.pump.model_copy(update=pump)})
    link = SimpleNamespace(config=config, name="a-later-run")
    if not refused:
        going_on = same_bench.continue_on_hold(opened, link)  # type: ignore[arg-type]
        bleed = {"bleed_fraction": running.bleed_fraction}  # what a refusal may have asked for
        assert going_on == replace(
            opened, head=replace(opened.head, before=RUNNING.model_copy(update=bleed))
        )
        return
    with pytest.raises(InputError, match=refused):
        same_bench.continue_on_hold(opened, link)  # type: ignore[arg-type]


@pytest.mark.parametrize(("hold", "continues"), [("twin", True), ("a-run", False)])
def test_a_session_on_the_twin_of_a_bench_continues_there_only(
    tmp_path: Path, hold: str, continues: bool
) -> None:
    """A guided session that is practised on the emulated bench tunes twice, with `[devices]`."""
    config = Config(loop=RUNNING, devices=DevicesConfig(board="tcp://192.0.2.1"))
    opened = folder.create_session(tmp_path, "s", "eve", "twin", config, RUNNING)
    link = SimpleNamespace(config=config, name=hold)
    if continues:
        same_bench.continue_on_hold(opened, link)  # type: ignore[arg-type]
        return
    with pytest.raises(InputError, match="tuned the simulated bench"):
        same_bench.continue_on_hold(opened, link)  # type: ignore[arg-type]


@pytest.fixture
def keyboard(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Where a person types; the program's standard input is the terminal."""
    monkeypatch.setattr(progress, "_POLL_S", 0.01)
    ours, theirs = os.openpty()
    with os.fdopen(theirs) as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        yield ours
    os.close(ours)


class AskedPage(LiveLog):
    """A log whose question is answered on the page, or at the keyboard, as soon as it is asked."""

    def __init__(self, session: Path, *answers: str, keyboard: int = -1, typed: str = "") -> None:
        super().__init__(session, RATE_HZ, lambda line: pytest.fail(line))
        self._session, self._answers, self._keyboard, self._typed = (
            session,
            iter(answers),
            keyboard,
            typed,
        )

    def log_entry(self, what: str, line: str, **more: object) -> None:
        super().log_entry(what, line, **more)  # type: ignore[arg-type]
        if what == "asks":
            if self._typed:
                os.write(self._keyboard, self._typed.encode())
            for text in self._answers:
                (self._session / ANSWER).write_text(text)
                break


def progress_of(log: LiveLog) -> Progress:
    progress = Progress()
    progress.log = log
    return progress


def answer(message: str, to: str = "which?", by: str = "anna") -> str:
    return json.dumps({"to": to, "answer": message, "by": by})


@pytest.mark.parametrize("message", ["calm", ""])
def test_a_question_is_answered_on_the_page(
    tmp_path: Path, keyboard: int, capsys: pytest.CaptureFixture[str], message: str
) -> None:
    write_answer(
        tmp_path, "which?", PageAnswer("lively", "bob")
    )  # to an earlier question: too late
    log = AskedPage(tmp_path, answer(message, by="anna\x1b[2J"))
    assert progress_of(log).ask_question("which?", ("lively", "calm")) == message
    assert f"answers on the page: {message or 'none'}" in capsys.readouterr().err
    reader = LiveReader(tmp_path)
    reader.read_new()
    (line,) = reader.progress.results
    assert line.startswith("anna")
    assert "\x1b" not in line
    assert (reader.progress.asks, reader.progress.among) == ("", ())
    assert not (tmp_path / ANSWER).exists()


@pytest.mark.parametrize(
    "unfit",
    [
        answer("wild"),
        answer("calm", to="another?"),
        "{",
        "[]",
        '{"to": "which?", "answer": ["calm"], "by": 1}',
        "\0",
    ],
)
def test_the_terminal_answers_as_ever_and_an_unfit_answer_of_the_page_does_not(
    tmp_path: Path, keyboard: int, unfit: str
) -> None:
    log = AskedPage(tmp_path, unfit, keyboard=keyboard, typed="lively\n")
    assert progress_of(log).ask_question("which?", ("lively", "calm")) == "lively"
    assert log.pop_answer("which?", ("lively", "calm")) is None
    assert not (tmp_path / ANSWER).exists()


def test_a_reader_of_the_question_reads_its_answers(tmp_path: Path) -> None:
    log, reader = logged(tmp_path), LiveReader(tmp_path)
    log.log_entry("asks", "which?", among=("lively", "calm"))
    reader.read_new()
    assert (reader.progress.asks, reader.progress.among) == ("which?", ("lively", "calm"))
    log.log_entry("asks", "sure?")
    reader.read_new()
    assert (reader.progress.asks, reader.progress.among) == ("sure?", ())
    (tmp_path / NAME).write_text('{"asks": "which?", "among": 5}\n')
    LiveReader(tmp_path).read_new()
