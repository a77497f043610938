"""Commands beside a hold on a locked device: none that could let gas in begins, and the locks are
shown.
"""

from __future__ import annotations

import getpass
import json
from pathlib import Path

import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.commissioning.check import _describe_hold, run_conformance
from membrane_ctrl.config.schema import Config, DevicesConfig
from membrane_ctrl.instruments.device_claim import claim_devices
from membrane_ctrl.instruments.lock_keys import modbus_keys
from membrane_ctrl.instruments.lock_store import LockStore
from membrane_ctrl.model.errors import DeviceError
from membrane_ctrl.model.lock import Lock
from membrane_ctrl.sessions.live_hold import _require_unlocked

URL = "tcp://127.0.0.1:1"
KEYS = modbus_keys(URL, 1)
ME = f"unix:{getpass.getuser()}"
ANN = Lock(
    "bofak", "hands inside", "unix:ann", "unix:ann", "process 7", "2026-01-02T03:04:05+00:00"
)
OWN = Lock("gumil", "lens off", ME, ME, "process 8", "2026-01-02T03:05:05+00:00")


@pytest.mark.parametrize("url", [URL, "tcp://localhost:1", "tcp://[::1]:1"])
def test_conformance_does_not_touch_a_locked_board(url: str) -> None:
    LockStore.of_machine().write_lock(ANN, KEYS)
    with pytest.raises(
        DeviceError, match=r'locked: "hands inside" by unix:ann.*word bofak.*locks remove'
    ):
        run_conformance(url, 1, False)


def test_check_names_the_locks_that_keep_a_hold_down() -> None:
    config = Config(devices=DevicesConfig(board=URL))
    assert _describe_hold(config)["locks"] == "none"
    LockStore.of_machine().write_lock(ANN, KEYS)
    assert "hands inside" in _describe_hold(config)["locks"]
    assert _describe_hold(Config())["locks"] == "none"


class Client:
    """A control port with this status."""

    def __init__(self, status: dict[str, object]) -> None:
        self._status = status

    def status(self) -> dict[str, object]:
        return {"ok": True, "status": self._status}


def test_a_session_does_not_begin_on_a_locked_mirror() -> None:
    _require_unlocked(Client({"state": "hold", "locks": []}))  # type: ignore[arg-type]
    lock = {"word": "bofak", "text": "hands inside", "author": "unix:ann"}
    with pytest.raises(DeviceError, match=r"locked: .*hands inside.*unlock"):
        _require_unlocked(Client({"state": "standby", "locks": [lock]}))  # type: ignore[arg-type]


def test_locks_are_removed_by_their_author_or_by_their_word(
    capsys: pytest.CaptureFixture[str],
) -> None:
    store = LockStore.of_machine()
    first, _ = store.write_lock(ANN, KEYS), store.write_lock(OWN, KEYS)
    for words in (["locks", "remove", "wrong"], ["locks", "remove", "hands inside"]):
        assert run(words) == 2
        assert "no lock has the word" in capsys.readouterr().err
    assert run(["locks", "remove"]) == 0
    assert [each.lock for each in store.find_locks()] == [ANN]
    assert run(["locks", "remove"]) == 2
    assert "none of the locks" in capsys.readouterr().err
    assert run(["locks", "remove", "bofak"]) == 0
    assert store.find_locks() == []
    log = Path(first).with_name("removed.log").read_text().splitlines()
    assert [
        (entry["how"], entry["author"], entry["remover"]) for entry in map(json.loads, log)
    ] == [
        ("author", ME, ME),
        ("word", "unix:ann", ME),
    ]


def test_while_a_program_has_the_devices_a_lock_is_removed_there(
    capsys: pytest.CaptureFixture[str],
) -> None:
    LockStore.of_machine().write_lock(OWN, KEYS)
    with claim_devices(KEYS):
        assert run(["locks", "remove"]) == 4
    assert "ctl unlock" in capsys.readouterr().err
    assert len(LockStore.of_machine().find_locks()) == 1


def test_a_damaged_file_is_removed_by_its_word(capsys: pytest.CaptureFixture[str]) -> None:
    LockStore.of_machine().write_lock(ANN, KEYS).write_text("{")
    assert run(["locks", "--json"]) == 0
    (entry,) = json.loads(capsys.readouterr().out)["locks"]
    assert entry["devices"] == []
    assert run(["locks", "remove"]) == 2
    assert run(["locks", "remove", entry["word"]]) == 0
    assert LockStore.of_machine().find_locks() == []
