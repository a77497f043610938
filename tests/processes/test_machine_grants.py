"""What the machine grants is stated, and memory is locked only where no limit can end a hold."""

from __future__ import annotations

import os
import resource

import pytest

from membrane_ctrl.processes import machine_grants


class Library:
    """A C library that notes what is to be locked."""

    def __init__(self, result: int = 0) -> None:
        self.flags: list[int] = []
        self._result = result

    def mlockall(self, flags: int) -> int:
        self.flags.append(flags)
        return self._result


def lock_with(monkeypatch: pytest.MonkeyPatch, limit: int, library: Library) -> bool:
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (limit, limit))
    monkeypatch.setattr(machine_grants.ctypes, "CDLL", lambda *_, **__: library)
    return machine_grants.lock_memory()


def test_memory_is_locked_without_a_limit_only(monkeypatch: pytest.MonkeyPatch) -> None:
    for limit in (0, 64 << 10, 8 << 20, 1 << 40):
        library = Library()
        assert not lock_with(monkeypatch, limit, library)
        assert library.flags == []
    library = Library()
    assert lock_with(monkeypatch, resource.RLIM_INFINITY, library)
    assert library.flags == [3]  # present and future


def test_a_refused_lock_is_no_lock(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not lock_with(monkeypatch, resource.RLIM_INFINITY, Library(-1))


def test_asking_changes_nothing() -> None:
    before = os.sched_getscheduler(0), os.sched_getparam(0).sched_priority
    found = machine_grants.find_grants()
    assert (os.sched_getscheduler(0), os.sched_getparam(0).sched_priority) == before
    assert found.processors == tuple(sorted(os.sched_getaffinity(0)))


def test_the_words_name_the_limit_and_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(resource, "getrlimit", lambda kind: (8 << 20, 8 << 20))
    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {1, 3})
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    found = machine_grants.find_grants()
    assert "LimitRTPRIO" in found.scheduling
    assert "8 MB" in found.memory_words
    assert "LimitMEMLOCK" in found.memory_words
    assert found.processor_words == "1, 3 of 4"
