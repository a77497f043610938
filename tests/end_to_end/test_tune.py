"""A session beside an independent hold: commands through the port, ticks from the rings; the hold
outlives both.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from patience import slow_machine

from membrane_ctrl.config.schema import PumpConfig
from membrane_ctrl.control.experiments.spec import ExperimentSpec
from membrane_ctrl.control_port.client import PortClient
from membrane_ctrl.model.errors import DeviceError, InputError
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.sessions.live_hold import HoldError, LiveHold
from tuning.rigs.hold_rig import HoldRig

pytestmark = pytest.mark.real_time

CONFIG = f"""
{slow_machine()}
[twin]
port = 0
scenario = "quiet"
start_error_um = -3.0
[shape]
enabled = false
[states]
actuator_test = false
check_s = 0.5
"""
PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Logs of a running hold of the twin."""
    folder = tmp_path_factory.mktemp("tune")
    (folder / "lab.toml").write_text(CONFIG)
    words = ["hold", "--twin", "--config", str(folder / "lab.toml"), "--logs", str(folder / "logs")]
    process = subprocess.Popen(
        [sys.executable, "-m", "membrane_ctrl", *words], stderr=subprocess.DEVNULL
    )
    try:
        yield folder / "logs"
    finally:
        process.terminate()
        process.wait(PATIENCE_S)


def connected(logs: Path) -> LiveHold:
    """A link to the hold, once it holds."""
    give_up_s = time.monotonic() + PATIENCE_S
    while True:
        assert time.monotonic() < give_up_s, "the twin was never held"
        try:
            client = PortClient.unix(logs / "control.sock", lambda text: None)
        except DeviceError:
            time.sleep(0.1)
            continue
        if client.ask(do="status")["status"]["state"] == "hold":
            return LiveHold(client, logs / client.greeting["run"])
        client.close()
        time.sleep(0.2)


def steps(rig: HoldRig, duration_s: float) -> ExperimentSpec:
    around = rig.around(rig.hold(2.0), 10.0)
    flow = min(max(around.holding_flow_um_per_s, 0.8), 1.8)  # two seconds give it only roughly
    return ExperimentSpec(
        kind="steps", duration_s=duration_s, holding_flow_um_per_s=flow, laser_um=around.laser_um
    )


def test_an_experiment_and_gains_on_a_live_hold(logs: Path) -> None:
    link = connected(logs)
    rig = HoldRig(link, "tester")
    record, finished = rig.perform(steps(rig, 12.0))
    assert finished.completed, finished.reason
    assert 12.0 <= record.duration_s < 24.0
    assert (
        record.lost_fraction < 0.3
    )  # a machine that pauses twice skips ticks; they are counted, not hidden
    curve = PumpConfig(curve_fraction=(0.1, 1.0), curve_um_per_s=(0.0, 5.3), flow_full_um_per_s=5.3)
    rig.set_gains(rig.loop.model_copy(update={"kp_per_s": 0.4}), "test", 60.0, pump=curve)
    rig.keep_gains()
    link.close()
    again = connected(logs)
    assert again.config.loop.kp_per_s == 0.4  # a later session starts from what runs
    assert again.config.pump == curve
    again.close()


def test_the_hold_ends_the_experiment_of_a_session_that_has_gone(logs: Path) -> None:
    link = connected(logs)
    rig = HoldRig(link, "tester")
    spec = steps(rig, 8.0)
    link._client.ask(do="tune", experiment=spec.model_dump())
    link._client.close()  # killed: nothing is released
    watcher = HoldRig(connected_in_any_state(logs), "watcher")
    assert watcher._next_held().state == State.TUNE
    most_ticks = round((8.0 + 45.0) / watcher.dt_s)  # and the way back
    assert any(watcher._next_held().state == State.HOLD for _ in range(most_ticks))
    watcher._link.close()


STEPS_AND_IS_KILLED = """
import sys
from pathlib import Path
from membrane_ctrl.control_port.client import PortClient
from membrane_ctrl.sessions.live_hold import LiveHold
from tuning.identification import shape_loop_fit
from tuning.rigs.hold_rig import HoldRig

logs = Path(sys.argv[1])
client = PortClient.unix(logs / "control.sock", print)
shape_loop_fit._SETTLE_S, shape_loop_fit._LEVEL_S, shape_loop_fit._LATE_S = 0.5, 2.0, 2.0
link = LiveHold(client, logs / client.greeting["run"])
shape_loop_fit.run_step_experiment(HoldRig(link, "doomed"))
"""


def test_the_hold_takes_the_setpoint_back_from_a_killed_session(logs: Path) -> None:
    watcher = connected(logs)
    doomed = subprocess.Popen([sys.executable, "-c", STEPS_AND_IS_KILLED, str(logs)])
    give_up_s = time.monotonic() + PATIENCE_S

    def setpoint_um() -> float:
        assert time.monotonic() < give_up_s
        return watcher.read_news().rows[-1].setpoint_um

    while setpoint_um() < 3.0:
        pass
    doomed.kill()
    doomed.wait(PATIENCE_S)
    while setpoint_um() > 0.01:
        pass
    assert watcher.read_news().rows[-1].state == State.HOLD
    watcher.close()


def connected_in_any_state(logs: Path) -> LiveHold:
    client = PortClient.unix(logs / "control.sock", lambda text: None)
    return LiveHold(client, logs / client.greeting["run"])


def test_a_refusal_states_its_reason(logs: Path) -> None:
    link = connected(logs)
    rig = HoldRig(link, "tester")
    with pytest.raises(HoldError, match="refused"):
        rig.set_gains(rig.loop, "test", 5.0, setpoint_step_um=5000.0)
    link.close()


def test_a_folder_of_another_run_is_refused(logs: Path, tmp_path: Path) -> None:
    client = PortClient.unix(logs / "control.sock", lambda text: None)
    with pytest.raises(InputError, match="is not running"):
        LiveHold(client, tmp_path)
    client.close()
