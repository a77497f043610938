"""The time that a session announces is that of what it has found, not of the plan alone."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from membrane_ctrl.config.schema import Config, LoopConfig
from membrane_ctrl.control_port.ctl import Where
from membrane_ctrl.sessions.progress import Progress
from tuning.commands import run
from tuning.options import TuneOptions
from tuning.steps.characterise import PumpUnknownError


def make_options(short: bool) -> TuneOptions:
    return TuneOptions(
        config=Config(),
        twin=True,
        where=Where(),
        logs=Path(),
        session=None,
        name="timed",
        author="tester",
        reason="test",
        limit_um=10.0,
        observe_s=600.0,
        verify_s=300.0 if short else 600.0,
        take_over=False,
        yes=True,
        choose="",
        json=False,
        short=short,
    )


@pytest.mark.parametrize(
    ("short", "announced", "rest_s"),
    [(True, "25 to 45 min from here", 621.0), (False, "40 to 60 min from here", 1490.0)],
)
def test_a_pump_that_must_be_mapped_lengthens_the_announced_session(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    short: bool,
    announced: str,
    rest_s: float,
) -> None:
    """The map, and after it the whole session again."""
    folder = SimpleNamespace(is_done=lambda step: False)
    calls: list[int] = []
    after_s: list[float] = []

    @contextlib.contextmanager
    def opened(options: TuneOptions) -> Iterator[tuple[Any, Any, Progress]]:
        yield folder, None, Progress()

    def run_steps(*given: object) -> None:
        calls.append(len(calls))
        if len(calls) == 1:
            raise PumpUnknownError("identify: the pump does not match its configured curve")

    def measure(folder: Any, rig: Any, limit_um: float, progress: Progress, rest: float) -> Any:
        after_s.append(rest)
        return folder

    monkeypatch.setattr(run.connection, "open_on_hold", opened)
    monkeypatch.setattr(run.map_pump, "has_pump_map", lambda folder: False)
    monkeypatch.setattr(run, "_run_steps", run_steps)
    monkeypatch.setattr(run, "measure_pump", measure)
    monkeypatch.setattr(run, "_note_verified", lambda *given: None)
    monkeypatch.setattr(run.page, "write_report", lambda folder: None)
    monkeypatch.setattr(run, "conclude", lambda folder, options: 0)
    run.run_session(make_options(short))
    assert announced in capsys.readouterr().err
    assert after_s == [pytest.approx(rest_s, abs=15.0)]


def test_a_verification_states_its_settling_and_that_it_may_be_prolonged(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """67 s for slow gains, and twice ten minutes if it is close."""
    slow = LoopConfig(kp_per_s=0.492, ti_s=19.05)
    monkeypatch.setattr(run.apply, "load_checked_gains", lambda folder: slow)
    folder: Any = SimpleNamespace()
    run._announce_step(Progress(), make_options(False), folder, "verify", [])
    assert "verify: 11:06 to 21:06" in capsys.readouterr().err


def test_a_step_that_takes_longer_than_planned_does_not_show_no_time_left(
    capsys: pytest.CaptureFixture[str],
) -> None:
    progress = Progress()
    progress.begin_step("pump", 900.0, 600.0, 2100.0)
    progress(840.0)
    progress(120.0)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "pump: 15:00 to 35:00"
    assert lines[1] == "pump: 14:00, 1:00 left, session 11:00"
    assert lines[2] == "pump: 16:00, 19:00 left, session 29:00"
