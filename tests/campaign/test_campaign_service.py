"""The unit file under a real systemd: ready, watched, protected, stopped, killed, hung, latched,
given up.
"""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator

import pytest
from systemd_room import Room, missing, systemd_room

from tests.support.machine_needs import needs

pytestmark = [pytest.mark.campaign, pytest.mark.timeout(300)]

RUNS = "/var/lib/membrane-ctrl/logs"
LATCHED = f"{RUNS}/latched-fault.json"
PLACES = "PYTHONPATH=/opt/source LD_LIBRARY_PATH=/opt/python/lib"
SOCKET = f"--socket {RUNS}/control.sock"
# Apprise need not be installed here: its notices go to a file
APPRISE = """
class _Target:
    def notify(self, title, body, notify_type):
        with open("/run/notices/sent", "a") as file:
            file.write(title + chr(10))
        return True

class Apprise:
    @staticmethod
    def instantiate(url):
        return _Target()
"""
ALARMS = '[alarms]\nurls_file = "/etc/membrane-ctrl/urls"\nsilent_s = 3.0\n'
RESUMES = '[resume]\nfaults = ["watchdog_tripped"]\n'


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Room]:
    if why := missing():
        pytest.skip(why)
    with systemd_room(tmp_path_factory.mktemp("room")) as made:
        made.run(f"mkdir /opt/stand-in; cat > /opt/stand-in/apprise.py <<'END'\n{APPRISE}\nEND")
        made.run("echo mail://ann > /etc/membrane-ctrl/urls")
        made.drop_in("PYTHONPATH=/opt/source:/opt/stand-in")
        yield made


def runs(room: Room) -> list[str]:
    return room.run(f"ls -d {RUNS}/2*").splitlines()


def ctl(room: Room, who: str, words: str) -> str:
    """The answer to a person of the lab."""
    program = "/opt/membrane-ctrl/.venv/bin/membrane-ctrl"
    as_who = f"setpriv --reuid {who} --regid {who} --init-groups"
    return room.run(f"cd /; {PLACES} {as_who} {program} ctl {words} {SOCKET} 2>&1 || true")


def read_sent(room: Room) -> str:
    return room.run("cat /run/notices/sent 2> /dev/null || true")


def test_the_service_reports_readiness_and_status_and_can_do_no_harm(room: Room) -> None:
    room.fresh()
    room.start()
    assert room.show("ActiveState", "Type", "WatchdogUSec") == {
        "ActiveState": "active",
        "Type": "notify",
        "WatchdogUSec": "10s",
    }
    room.until(lambda: room.status_has("inflate"))
    status = room.run(f"cat /proc/{room.main_pid}/status")
    assert "NoNewPrivs:\t1" in status
    assert "Seccomp:\t2" in status
    assert "CapBnd:\t0000000000000000" in status
    assert "CapEff:\t0000000000000000" in status
    as_service = (
        f"nsenter -t {room.main_pid} -m setpriv --reuid membrane --regid membrane --init-groups"
    )
    for place in ("/etc/membrane-ctrl", "/opt/membrane-ctrl", "/usr/local"):
        refused = room.run(f"{as_service} touch {place}/new 2>&1 || true")
        assert "Read-only file system" in refused
    assert room.run(f"{as_service} ls /tmp /root 2>&1 || true").count("Permission denied") == 1
    assert room.run(f"{as_service} touch /var/lib/membrane-ctrl/mine && echo may") == "may"
    room.until(lambda: room.status_has("hold"), 90.0)


def test_a_stop_is_clean_and_stays(room: Room) -> None:
    room.fresh()
    room.start()
    room.until(lambda: room.status_has("inflate"))
    room.run("systemctl stop membrane-hold@lab")
    assert room.settled("inactive")
    assert "Deactivated successfully" in room.log()
    assert "pump 0" in room.log()
    assert json.loads(room.run(f"cat {runs(room)[0]}/summary.json"))["exit"] == "interrupted"
    assert room.survivors() == []


def test_a_killed_hold_is_recorded_reported_made_safe_and_started_again(room: Room) -> None:
    room.fresh(ALARMS + RESUMES)
    room.start()
    room.until(lambda: room.status_has("inflate"))
    room.kill(signal.SIGKILL)
    room.until(lambda: room.show("NRestarts")["NRestarts"] == "1")
    assert "control_gone" in read_sent(room)
    assert "pump 0" in room.log()
    assert room.run(f"ls {runs(room)[0]}/summary.json")
    room.until(lambda: room.status_has("inflate"))


def test_a_hung_hold_is_killed_by_systemds_watchdog_and_started_again(room: Room) -> None:
    room.fresh(ALARMS + RESUMES)
    room.start()
    room.until(lambda: room.status_has("inflate"))
    room.kill(signal.SIGSTOP)
    room.until(lambda: room.show("NRestarts")["NRestarts"] == "1", 90.0)
    assert "Watchdog timeout" in room.log()
    assert "silent" in read_sent(room)
    assert "control_gone" in read_sent(room)
    assert room.run(f"ls {runs(room)[0]}/summary.json")
    room.until(lambda: room.status_has("inflate"))


def test_after_a_kill_a_board_that_latched_needs_a_person(room: Room) -> None:
    room.fresh()
    room.start()
    room.until(lambda: room.status_has("inflate"))
    room.kill(signal.SIGKILL)
    room.until(lambda: room.settled("failed"))
    assert room.show("ExecMainStatus", "NRestarts") == {"ExecMainStatus": "4", "NRestarts": "1"}
    assert "the board has latched faults" in room.log()


def test_a_trip_stays_down_and_the_next_start_names_it(room: Room) -> None:
    room.fresh()
    room.start()
    room.until(lambda: room.status_has("inflate"))
    room.run("systemctl stop twin")
    room.until(lambda: room.settled("failed"))
    assert room.show("ExecMainStatus", "NRestarts") == {"ExecMainStatus": "5", "NRestarts": "0"}
    fault = json.loads(room.run(f"cat {LATCHED}"))["name"]
    assert fault == "link_lost"
    room.run("systemctl start membrane-hold@lab || true")
    assert room.show("ExecMainStatus")["ExecMainStatus"] == "4"
    assert f"a fault is latched: {fault}" in room.log()


@pytest.mark.parametrize(
    "damage",
    [
        f": > {LATCHED}",
        f"head -c 500 /dev/urandom > {LATCHED}",
        f"mkdir {LATCHED}",
        f"touch {LATCHED}; chmod 0 {LATCHED}",
    ],
    ids=["empty", "binary", "folder", "unreadable"],
)
def test_a_damaged_latched_fault_file_keeps_it_down(room: Room, damage: str) -> None:
    room.fresh()
    room.run(f"install -d -o membrane -g membrane {RUNS}; {damage}")
    room.run("systemctl start membrane-hold@lab || true")
    assert room.show("ActiveState", "ExecMainStatus") == {
        "ActiveState": "failed",
        "ExecMainStatus": "4",
    }
    assert "a fault is latched: unreadable" in room.log()


def test_in_standby_it_runs_with_a_latched_fault_and_holds_only_after_a_person_acknowledged(
    room: Room,
) -> None:
    room.fresh()
    room.run(f"install -d -o membrane -g membrane {RUNS}; : > {LATCHED}; chown membrane {LATCHED}")
    unit = "/run/units/membrane-hold@.service"
    room.run(f"sed -i '/^ExecStart=/s/$/ --standby/' {unit}; systemctl daemon-reload")
    try:
        room.start()
        assert room.show("ActiveState")["ActiveState"] == "active"
        assert "latched" in ctl(room, "membrane", "hold")
        assert "done" in ctl(room, "membrane", "ack --why seen")
        assert "done" in ctl(room, "membrane", "hold")
        room.until(lambda: room.status_has("inflate"))
    finally:
        room.run(
            f"cp '/opt/source/membrane_ctrl/examples/membrane-hold@.service' {unit}; systemctl "
            "daemon-reload"
        )


def test_a_member_of_the_group_operates_and_a_stranger_does_not_come_near(room: Room) -> None:
    room.fresh()
    room.run("for who in ann eve; do adduser --quiet --disabled-password --gecos '' $who; done")
    room.run("adduser --quiet ann membrane")
    room.start()
    assert "commander" in ctl(room, "ann", "status")
    assert "gains needs the role tune" in ctl(room, "ann", "gains 'kp_per_s = 0.5'")
    assert "permission denied" in ctl(room, "eve", "status")
    assert "permission denied" in ctl(room, "eve", "stop")
    assert "stop: done" in ctl(room, "ann", "stop")
    room.until(lambda: room.settled("inactive"))


@needs("Xvfb", "xauth", "xhost", "xdpyinfo")
def test_the_service_reaches_a_desktops_display_once_it_may(room: Room) -> None:
    unit = "/opt/source/membrane_ctrl/examples/membrane-hold@.service"
    edits = (
        "-e 's,^ExecStart=.*,ExecStart=/usr/bin/xdpyinfo -display :7,' -e '/^ExecStopPost/d' -e "
        "'/^Restart/d'"
    )
    room.run(f"sed {edits} -e 's/Type=notify/Type=oneshot/' {unit} > /run/units/display.service")
    room.run("xauth -f /run/cookie add :7 . 0123456789abcdef0123456789abcdef")
    xvfb = "/usr/bin/Xvfb :7 -noreset -nolisten local -auth /run/cookie"
    room.run(
        f"printf '[Service]\\nExecStart={xvfb}\\n' > /run/units/x.service; systemctl daemon-reload"
    )
    room.run("systemctl start x; until [ -e /tmp/.X11-unix/X7 ]; do sleep 0.1; done")
    try:
        room.run("! systemctl start display")
        room.run(
            "XAUTHORITY=/run/cookie DISPLAY=:7 xhost +si:localuser:membrane; systemctl start "
            "display"
        )
    finally:
        room.run("systemctl stop x")


# Number of a serial adapter that is not there: open(2) finds no device, unless it is kept away
ADAPTER = "/dev/ttyUSB7"
REACHED, KEPT_AWAY = "No such device or address", "Operation not permitted"


@pytest.mark.parametrize("unit", ["membrane-hold@.service", "membrane-commission@.service"])
def test_units_at_the_bench_reach_a_serial_port(room: Room, unit: str) -> None:
    edits = (
        f"-e 's,^ExecStart=.*,ExecStart=/bin/sh -c \": < {ADAPTER}\",' -e '/^ExecStopPost/d' "
        "-e '/^Standard/d' -e '/^Restart/d' -e 's/^Type=.*/Type=oneshot/'"
    )
    source = f"/opt/source/membrane_ctrl/examples/{unit}"
    room.run(f"sed {edits} {source} > /run/units/reach.service; systemctl daemon-reload")
    room.run(f"mknod -m 660 {ADAPTER} c 188 7; chgrp dialout {ADAPTER}")
    try:
        room.run("systemctl start reach || true")
        seen = room.run("journalctl -u reach -o cat --no-pager")
        assert REACHED in seen
        assert KEPT_AWAY not in seen
    finally:
        room.run(f"rm {ADAPTER}; rm /run/units/reach.service; journalctl --rotate --vacuum-time=1s")


GUIDED = """
import sys, time
sys.path.insert(0, "/opt/source")
from pathlib import Path
from membrane_ctrl.service.guided_session import GuidedSession

ANSWERS = {
    "devices.kind": "board",
    "devices.board": "tcp://127.0.0.1:1502",
    "camera.driver": "none",
    "interlock1.driver": "none",
    "mirror.relief_pa": "900",
}
session = GuidedSession(Path("/var/lib/membrane-ctrl/commissioning"), units=True)
session.start("lab-1", simulated=False, who="ann")
answered, until_s = 0, time.monotonic() + 100.0
while session.seen.is_running and time.monotonic() < until_s:
    asked = session.seen.question
    if asked is None or asked.number == answered:
        time.sleep(0.05)
        continue
    answered, key = asked.number, asked.question.key
    print(key, asked.question.kind, flush=True)
    if key.startswith("gauge_zero") or answered > 60:
        break
    yes = "y" if asked.question.kind == "confirmation" else asked.question.default
    session.answer(answered, ANSWERS.get(key, yes), "ann")
for message in session.seen.messages:
    print(message, flush=True)
session.close()
print(session.seen.ended)
"""


def test_a_session_of_the_page_reaches_the_bench(room: Room) -> None:
    room.fresh()
    room.run("install -d -o membrane -g membrane /var/lib/membrane-ctrl/commissioning")
    room.run(f"cat > /run/guided.py <<'END'\n{GUIDED}\nEND")
    room.run("systemctl start membrane-commission.socket")
    as_service = "setpriv --reuid membrane --regid membrane --init-groups"
    python = "/opt/membrane-ctrl/.venv/bin/python3"
    seen = room.run(f"cd /; {PLACES} {as_service} {python} /run/guided.py 2>&1")
    assert "gauge_zero" in seen, seen
    assert "lab-1: stopped; start it again" in seen
    room.until(lambda: "active" in room.run("systemctl is-active membrane-commission.socket"))
    assert room.run("systemctl list-units --no-legend 'membrane-commission@*'") == ""


def test_what_dies_again_and_again_is_given_up_in_a_safe_state(room: Room) -> None:
    room.fresh(RESUMES + "most_per_day = 6\n")  # by default the daily count ends it earlier
    room.start()
    for _ in range(5):
        room.until(lambda: room.settled("active"))
        room.kill(signal.SIGKILL)
        room.until(lambda: not room.settled("active"))
    room.until(lambda: room.settled("failed"))
    assert "Start request repeated too quickly" in room.log()
    assert room.log().count("pump 0") == 5
    assert room.survivors() == []
