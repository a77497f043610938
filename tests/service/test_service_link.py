"""A hold finds the service of its runs; the link's key stays the same."""

from __future__ import annotations

import os
import stat
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from membrane_ctrl.control_port import service_link
from membrane_ctrl.control_port.service_link import (
    ADDRESS_NAME,
    find_service,
    link_key,
    publish_address,
)
from membrane_ctrl.model.errors import DeviceError

URL = "http://127.0.0.1:7480/"


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "state"


def test_the_key_stays_and_only_its_user_may_read_it(state: Path) -> None:
    key = link_key()
    assert len(key) >= 32
    assert link_key() == key
    folder = state / "membrane-ctrl" / "service"
    (file,) = folder.iterdir()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_two_programs_that_start_together_get_one_key() -> None:
    with ThreadPoolExecutor(8) as pool:
        assert len(set(pool.map(lambda _: link_key(), range(8)))) == 1


def test_an_empty_key_file_is_no_key(state: Path) -> None:
    link_key()
    (state / "membrane-ctrl" / "service" / "link-key").write_text("\n")
    with pytest.raises(DeviceError, match="empty; remove it"):
        link_key()


def test_without_a_folder_that_can_be_written_there_is_one_line(
    state: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    state.write_text("a file")
    with pytest.raises(DeviceError, match="cannot be written"):
        link_key()
    monkeypatch.delenv("XDG_STATE_HOME")
    monkeypatch.setattr(service_link, "find_state_folder", lambda: None)
    with pytest.raises(DeviceError, match="set XDG_STATE_HOME"):
        link_key()


def test_a_service_is_found_while_it_lives(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    assert find_service(logs) is None
    with publish_address(logs, URL, has_link=True):
        assert find_service(logs) == f"{URL}?key={link_key()}"
        with (
            pytest.raises(DeviceError, match=f"another service has this folder of runs, at {URL}"),
            publish_address(logs, "http://127.0.0.1:1/", has_link=True),
        ):
            pass
    assert find_service(logs) is None
    with publish_address(logs, URL, has_link=False):
        assert find_service(logs) == URL, "people log in"


def test_a_killed_service_is_not_found(tmp_path: Path) -> None:
    (tmp_path / ADDRESS_NAME).write_text('{"url": "http://127.0.0.1:1/", "link": true}')
    assert find_service(tmp_path) is None


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"\xff", b"[]", b'{"url": 5}', b'{"url": "file:///x"}', b'{"url": "http://a\\n"}'],
)
def test_a_file_with_something_else_names_no_address(tmp_path: Path, content: bytes) -> None:
    with publish_address(tmp_path, URL, has_link=True):
        handle = os.open(tmp_path / ADDRESS_NAME, os.O_WRONLY | os.O_TRUNC)
        os.write(handle, content)
        os.close(handle)
        assert find_service(tmp_path) == ""
