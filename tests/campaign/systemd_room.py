"""A separate systemd to test the unit file: real, but in namespaces that end with the test."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

SOURCE = Path(__file__).parents[2]
_UNIT = "membrane-hold@lab"
_UNITS = "/run/units"
_PROGRAM = "/opt/membrane-ctrl/.venv/bin/membrane-ctrl"
# not needed with an installed interpreter and package
_PLACES = "Environment=LD_LIBRARY_PATH=/opt/python/lib PYTHONPATH=/opt/source"
_SET_UP = f"""
adduser --quiet --system --group --home /var/lib/membrane-ctrl membrane
adduser --quiet membrane dialout
install -d -m 750 -g membrane /etc/membrane-ctrl
printf '[twin]\\nport = 1502\\nseed = 1\\n' > /etc/membrane-ctrl/twin.toml
mkdir -p {_UNITS}/{_UNIT}.service.d /run/notices
chown membrane /run/notices
printf '[Service]\\n{_PLACES}\\n' | tee {_UNITS}/{_UNIT}.service.d/room.conf > {_UNITS}/twin.service
echo "ExecStart={_PROGRAM} twin --config /etc/membrane-ctrl/twin.toml" >> {_UNITS}/twin.service
cp /opt/source/membrane_ctrl/examples/membrane-*@.service {_UNITS}
cp /opt/source/membrane_ctrl/examples/membrane-*.socket {_UNITS}
mkdir -p {_UNITS}/membrane-commission@.service.d
cp {_UNITS}/{_UNIT}.service.d/room.conf {_UNITS}/membrane-commission@.service.d
systemctl daemon-reload
systemctl start systemd-journald.service
"""


def missing() -> str:
    """Why this machine cannot have one; empty if it can."""
    if not sys.platform.startswith("linux") or os.geteuid() != 0:
        return "needs Linux and root"
    if not Path("/lib/systemd/systemd").exists():
        return "needs systemd"
    tools = ("unshare", "nsenter", "ip", "adduser", "journalctl")
    if absent := [tool for tool in tools if shutil.which(tool) is None]:
        return f"needs {', '.join(absent)}"
    probe = [
        "unshare",
        "--mount",
        "--pid",
        "--fork",
        "--cgroup",
        "--net",
        "mount",
        "-t",
        "tmpfs",
        "tmpfs",
        "/mnt",
    ]
    return (
        ""
        if subprocess.run(probe, capture_output=True, check=False).returncode == 0
        else "needs namespaces"
    )


class Room:
    """The processes in it.

    Parameters
    ----------
    pid : int
        Of its process 1, as seen from here.
    """

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._since = ""

    def run(self, script: str) -> str:
        """Output of a shell script in the room, as root. Raises CalledProcessError."""
        enter = ["nsenter", "-t", str(self._pid), "-m", "-p", "-C", "-u", "-i", "-n", "-r", "-w"]
        done = subprocess.run(
            [*enter, "bash", "-euc", script],
            capture_output=True,
            text=True,
            timeout=120,
            check=True,
        )
        return done.stdout.strip()

    def configure(self, more: str = "") -> None:
        """Write the configuration of the service."""
        text = f'[devices]\nboard = "tcp://127.0.0.1:1502"\n{more}\n'
        self.run(f"cat > /etc/membrane-ctrl/lab.toml <<'END'\n{text}END")

    def drop_in(self, *environment: str) -> None:
        """Set more variables of the service, and let it write to /run/notices."""
        lines = "".join(f"Environment={each}\\n" for each in environment)
        path = f"{_UNITS}/{_UNIT}.service.d/test.conf"
        self.run(
            f"printf '[Service]\\nReadWritePaths=/run/notices\\n{lines}' > {path}; systemctl "
            "daemon-reload"
        )

    def fresh(self, more: str = "") -> None:
        """A new board, no run, no latched fault, nothing started yet."""
        self.run(
            f"systemctl stop {_UNIT} twin; systemctl reset-failed; rm -rf "
            "/var/lib/membrane-ctrl/* /run/notices/*"
        )
        self._since = self.run("date '+%F %T.%N'")
        self.configure(more)
        self.run(
            "systemctl start twin; until (: > /dev/tcp/127.0.0.1/1502) 2> /dev/null; do "
            "sleep 0.1; done"
        )

    def start(self) -> None:
        """Start the service; systemd answers when it says READY."""
        self.run(f"systemctl start {_UNIT}")

    def show(self, *names: str) -> dict[str, str]:
        """Properties of the service, as systemd sees them."""
        output = self.run(f"systemctl show {_UNIT} -p {','.join(names)}")
        return dict(line.split("=", 1) for line in output.splitlines())

    @property
    def main_pid(self) -> int:
        """The control process, in the room's own numbers."""
        return int(self.show("MainPID")["MainPID"])

    def kill(self, number: signal.Signals) -> None:
        """A signal to the control process alone."""
        self.run(f"kill -{int(number)} {self.main_pid}")

    def log(self) -> str:
        """Messages of the service and of systemd since it was fresh."""
        since = f"--since '{self._since}'" if self._since else ""
        return self.run(f"journalctl -u {_UNIT} -o cat --no-pager {since}")

    def survivors(self) -> list[str]:
        """Processes that the service left behind."""
        return self.run(
            f"group=$(systemctl show {_UNIT} -p ControlGroup --value); "
            "[ -z $group ] || cat /sys/fs/cgroup$group/cgroup.procs 2> /dev/null || true"
        ).split()

    def until(self, what: Callable[[], bool], patience_s: float = 60.0) -> None:
        """Wait for something. Raises AssertionError when it does not come."""
        give_up_s = time.monotonic() + patience_s
        while not what():
            assert time.monotonic() < give_up_s, f"waited in vain; {self.log()[-2000:]}"
            time.sleep(0.2)

    def settled(self, state: str) -> bool:
        """Whether the service is in this state of systemd's."""
        return self.show("ActiveState")["ActiveState"] == state

    def status_has(self, word: str) -> bool:
        """Whether its STATUS line begins like this."""
        return self.show("StatusText")["StatusText"].startswith(word)


@contextmanager
def systemd_room(folder: Path) -> Iterator[Room]:
    """A room with everything installed as docs/how-to/operations.md says, and a twin to start."""
    environment = os.environ | {
        "ROOM": str(folder),
        "ROOM_PYTHON": sys.base_prefix,
        "ROOM_VENV": sys.prefix,
        "ROOM_SOURCE": str(SOURCE),
    }
    branch = ""
    process = subprocess.Popen(
        [Path(__file__).with_suffix(".sh")], env=environment, start_new_session=True
    )
    try:
        give_up_s = time.monotonic() + 30.0
        while (
            not (children := psutil.Process(process.pid).children())
            or children[0].name() != "systemd"
        ):
            assert process.poll() is None, "the room could not be made"
            assert time.monotonic() < give_up_s, "no systemd came up"
            time.sleep(0.1)
        branch = Path(f"/proc/{process.pid}/cgroup").read_text().splitlines()[-1].partition("::")[2]
        room = Room(children[0].pid)
        room.until(
            lambda: (
                "basic.target" in room.run("systemctl list-units --no-legend --no-pager || true")
            )
        )
        room.run(_SET_UP)
        yield room
    finally:
        process.kill()  # and with it, by --kill-child, process 1 and everything in the room
        process.wait()
        _remove_branch(branch)


def _remove_branch(branch: str) -> None:
    """The control groups of the room; they stay when their processes have gone."""
    tree = next(
        tree for tree in map(Path, ("/sys/fs/cgroup/unified", "/sys/fs/cgroup")) if tree.exists()
    )
    top = tree / branch.strip("/")
    if not branch.strip("/") or not top.name.startswith("membrane-room-"):
        return
    for _ in range(50):  # a killed process leaves its group shortly after
        for folder in sorted((f for f in top.rglob("*") if f.is_dir()), reverse=True):
            try:
                folder.rmdir()
            except OSError:
                break
        try:
            top.rmdir()
        except FileNotFoundError:
            return
        except OSError:
            time.sleep(0.1)
