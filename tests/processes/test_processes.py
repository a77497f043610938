"""A child is unaffected by signals to its group, and never left behind."""

from __future__ import annotations

import os
import signal
from multiprocessing.context import SpawnProcess

import pytest

from membrane_ctrl.processes.child import Child
from membrane_ctrl.processes.event_pipe import make_pipe


def test_what_is_sent_to_the_whole_group_is_not_for_the_children() -> None:
    before = {
        number: signal.getsignal(number)
        for number in (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP, signal.SIGTERM)
    }
    ours, theirs = make_pipe()
    child = Child("waits", "multiprocessing.connection:wait", ([theirs],), nice=0)
    child.start()
    try:
        assert child.pid is not None
        for number, handler in before.items():
            os.kill(child.pid, number)
            assert (
                signal.getsignal(number) == handler
            )  # nor does this process lose what it does with them
        assert not child.join(0.2)
        ours.send("go home")
        assert child.join(20.0)
        assert child.exit_code == 0
    finally:
        child.stop(1.0)


@pytest.mark.parametrize("number", [signal.SIGSTOP, signal.SIGCONT])
def test_a_child_that_does_not_obey_is_killed(number: signal.Signals) -> None:
    child = Child("sleeps", "time:sleep", (60.0,), nice=0)
    child.start()
    assert child.pid is not None
    os.kill(child.pid, number)
    child.stop(0.1)
    assert not child.alive


def test_a_signal_that_comes_while_a_child_is_started_is_not_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class SignalledError(Exception):
        """By the handler."""

    def raise_signalled(number: int, frame: object) -> None:
        raise SignalledError

    child = Child("sleeps", "time:sleep", (60.0,), nice=0)
    start = SpawnProcess.start

    def start_while_signalled(self: SpawnProcess) -> None:
        start(self)
        signal.raise_signal(
            signal.SIGTERM
        )  # to this thread: another one would take it, now or somewhat later

    monkeypatch.setattr(SpawnProcess, "start", start_while_signalled)
    before = signal.signal(signal.SIGTERM, raise_signalled)
    try:
        with pytest.raises(SignalledError):
            child.start()
    finally:
        signal.signal(signal.SIGTERM, before)
    assert not child.alive
