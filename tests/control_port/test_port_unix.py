from __future__ import annotations

import grp
import os
import socket
import stat
from pathlib import Path

import pytest

from membrane_ctrl.control_port.sockets import UnixListener, short
from membrane_ctrl.model.errors import DeviceError, InputError


def connect(path: Path) -> socket.socket:
    connection = socket.socket(socket.AF_UNIX)
    with short(path) as address:
        connection.connect(address)
    return connection


def test_the_file_lets_in_owner_and_group_only(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"
    umask = os.umask(0)
    try:
        listener = UnixListener(path, None, "operate")
        assert stat.S_IMODE(path.stat().st_mode) == 0o660
        assert os.umask(0) == 0, "the process's own mask is back"
    finally:
        os.umask(umask)
    listener.close()
    assert not path.exists()


def test_the_owner_tunes(tmp_path: Path) -> None:
    listener = UnixListener(tmp_path / "control.sock", None, "read")
    with connect(tmp_path / "control.sock"):
        accepted, _ = listener.socket.accept()
        peer = listener.peer(accepted)
        accepted.close()
    assert peer.role == "tune"
    assert peer.who.startswith("unix:")
    listener.close()


def test_another_user_has_the_groups_role(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    listener = UnixListener(tmp_path / "control.sock", None, "operate")
    credentials = type(
        "Connection", (), {"getsockopt": lambda *_: (1).to_bytes(4, "little") + b"\x39\x30\0\0" * 2}
    )
    peer = listener.peer(credentials())  # type: ignore[arg-type]
    assert peer.role == "operate"
    assert peer.who == "unix:12345", "a uid without a name is named by its number"
    listener.close()


def test_a_dead_holds_socket_is_removed(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"
    dead = socket.socket(socket.AF_UNIX)
    dead.bind(str(path))
    dead.close()
    listener = UnixListener(path, None, "operate")
    connect(path).close()
    listener.close()


def test_a_living_holds_socket_is_refused_and_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"
    first = UnixListener(path, None, "operate")
    with pytest.raises(DeviceError, match=r"another hold is listening there.*port\.socket"):
        UnixListener(path, None, "operate")
    connect(path).close()
    first.close()


def test_a_hanging_holds_socket_is_busy_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its queue is full and a connection waits: still no reason to replace it."""
    monkeypatch.setattr("membrane_ctrl.control_port.sockets._SOMEBODY_THERE_S", 0.05)
    path = tmp_path / "control.sock"
    hanging = socket.socket(socket.AF_UNIX)
    hanging.bind(str(path))
    hanging.listen(0)
    try:
        with connect(path), pytest.raises(DeviceError, match="another hold"):
            UnixListener(path, None, "operate")
    finally:
        hanging.close()


def test_a_file_in_the_way_is_not_removed(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"
    path.write_text("precious")
    with pytest.raises(InputError, match=r"control\.sock: exists and is not a socket"):
        UnixListener(path, None, "operate")
    assert path.read_text() == "precious"


def test_anothers_socket_at_the_same_place_is_left(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"
    first = UnixListener(path, None, "operate")
    path.unlink()
    second = UnixListener(path, None, "operate")
    first.close()
    assert path.exists()
    second.close()


def test_a_path_longer_than_a_socket_address(tmp_path: Path) -> None:
    path = tmp_path / ("deep" * 20) / ("deeper" * 10) / "control.sock"
    assert len(str(path)) > 150
    listener = UnixListener(path, None, "operate")
    connect(path).close()
    with pytest.raises(DeviceError, match="another hold"):
        UnixListener(path, None, "operate")
    listener.close()
    assert not path.parent.exists(), "a folder made for the socket goes with it"


def test_a_group_that_is_none_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"port\.group: no group 'nobody-has-this' on this machine"
    ):
        UnixListener(tmp_path / "control.sock", "nobody-has-this", "operate")
    assert not list(tmp_path.iterdir())


def test_the_file_is_given_to_the_group(tmp_path: Path) -> None:
    own = grp.getgrgid(os.getgid()).gr_name
    listener = UnixListener(tmp_path / "control.sock", own, "operate")
    assert (tmp_path / "control.sock").stat().st_gid == os.getgid()
    listener.close()


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "logs").write_text("in the way")
    with pytest.raises(DeviceError, match=r"logs: cannot be written.* --logs"):
        UnixListener(tmp_path / "logs" / "control.sock", None, "operate")
