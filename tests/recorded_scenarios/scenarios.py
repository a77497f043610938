"""Thirty scenarios of a controller on a simulated bench, in virtual time and from fixed seeds.

Together they reach every state of the controller, of the shape loop and of the safe levels, all
three process values, all experiments and most rules of the safety table (see
`test_recorded_scenarios.py`).
"""

import math

from firmware_iface.drivers.pump_board import PumpBoard
from firmware_iface.settings import BoardInputConfig, ModbusInputConfig
from membrane_ctrl.config.schema import (
    Config,
    DevicesConfig,
    EstimatorConfig,
    LimitsConfig,
    LoopConfig,
    ResumeConfig,
    ShapeConfig,
    StatesConfig,
    TwinConfig,
)
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.commands import AT_START
from membrane_ctrl.model.lock import Lock
from membrane_ctrl.sim.bench_events import (
    AirTemperatureChange,
    AmbientChange,
    LaserDrift,
    LaserDropout,
    LeakChange,
)
from membrane_ctrl.sim.virtual_bench import MemoryLink, VirtualBench, at_once
from tests.worlds.controller_runs import STORIES, Story, switched

# Ten ticks a second and no test of the actuators: a hold begins after some 5 s
_LOOP = LoopConfig(rate_hz=10.0)
_STATES = StatesConfig(
    actuator_test=False, stay_after_trip=True, ramp_down_s=4.0, hold_flow_max_s=5.0
)
_TWIN = TwinConfig(scenario="quiet", start_error_um=-1.0, laser_noise_um=0.5)
_CONFIG = Config(twin=_TWIN, loop=_LOOP, states=_STATES, shape=ShapeConfig(enabled=False))
_WITH_SHAPE = _CONFIG.model_copy(update={"shape": ShapeConfig(time_constant_s=10.0)})
_BY_OPTICS = _CONFIG.model_copy(
    update={
        "twin": _TWIN.model_copy(update={"laser": False}),
        "estimator": EstimatorConfig(process_value="optics"),
        "shape": ShapeConfig(mode="track", track_rate_hz=10.0),
    }
)
_BY_ESTIMATE = _CONFIG.model_copy(
    update={
        "estimator": EstimatorConfig(process_value="estimate"),
        "shape": ShapeConfig(mode="track", track_rate_hz=5.0),
    }
)
_EMERGENCY_STOP = BoardInputConfig(
    driver="board_input", name="stop", text="release the button", safe_level="vent", input=15
)
_OXYGEN = ModbusInputConfig(
    driver="modbus_input",
    name="oxygen",
    text="air the room",
    safe_level="ramp_down",
    link="tcp://192.0.2.9",
    address=4,
    age_max_s=0.5,
)
_LOCK = Lock("bofak", "hands inside", "unix:ann", "unix:ann", "p 7", "")
_HOLD = Command("hold", "a test", "it runs")
_ACK = Command("ack", "ann")


def _limited(config: Config, **limits: float) -> Config:
    return config.model_copy(update={"limits": LimitsConfig.model_validate(limits)})


def _claim_board(bench: VirtualBench) -> None:
    """Another program claims the board of a stalled hold and clears its latches."""
    intruder = PumpBoard("", watchdog_s=0.5, link=MemoryLink(bench))
    at_once(intruder.open())
    at_once(intruder.clear_faults(0xFFFF))


def _open_oxygen(bench: VirtualBench) -> None:
    bench.interlocks.lost_names.add("oxygen")


SCENARIOS: dict[str, Story] = {
    **STORIES,
    "setpoint ramps": Story(
        _WITH_SHAPE,
        45.0,
        {
            0.05: _HOLD,
            8.0: Command("setpoint", "ann", value=15.0),
            16.0: Command("setpoint", "ann", value=5.0),
            18.0: Command("setpoint", "ann", value=1e6),
            19.0: Command("setpoint", "ann", value=math.nan),
            20.0: Command("setpoint", "ann", value=-8.0),
            30.0: Command("mark", "ann", text="wind"),
            31.0: Command("capture", "ann"),
            35.0: Command("pause", "ann"),
            36.0: Command("setpoint", "ann", value=2.0),
            38.0: Command("resume", "ann"),
        },
        shape_s=1.0,
    ),
    "weather, leak and shape loop": Story(
        _WITH_SHAPE,
        60.0,
        {0.05: _HOLD, 50.0: Command("shape_off", "ann"), 54.0: Command("shape_on", "ann")},
        {
            (25.0, 27.0): switched("barometer_lost", True),
            (30.0, 33.0): switched("thermometer_lost", True),
            (40.0, 46.0): switched("camera_lost", True),
        },
        shape_s=0.5,
        surroundings=(
            AmbientChange(10.0, 20.0),
            AirTemperatureChange(15.0, 0.3, 10.0),
            LeakChange(35.0, 1.3),
            LaserDropout(48.0, 0.4),
            LaserDrift(20.0, 6.0, 20.0),
        ),
        continued_at_s=(12.3, 41.7),
    ),
    "laser lost for good": Story(
        _CONFIG.model_copy(update={"states": _STATES.model_copy(update={"pump_off_max_s": 8.0})}),
        40.0,
        {0.05: _HOLD},
        {(10.0, 10.5): switched("no_light", True), (14.0, 99.0): switched("no_light", True)},
    ),
    "laser repeats its value": Story(
        _CONFIG, 30.0, {0.05: _HOLD}, {(10.0, 99.0): switched("laser_stuck", True)}
    ),
    "laser jumps": Story(
        _CONFIG,
        30.0,
        {0.05: _HOLD, 26.0: _ACK},
        {
            **{
                (10.0 + 0.2 * n, 10.1 + 0.2 * n): switched("laser_offset_um", -120.0)
                for n in range(6)
            },
            (15.0, 99.0): switched("laser_offset_um", 90.0),
        },
    ),
    "samples do not advance": Story(
        _CONFIG, 30.0, {0.05: _HOLD}, {(10.0, 99.0): switched("samples_frozen", True)}
    ),
    "laser contradicts camera and gauge": Story(
        _WITH_SHAPE,
        45.0,
        {0.05: _HOLD},
        {(20.0, 99.0): switched("laser_offset_um", -28.0)},
        shape_s=0.5,
    ),
    "gauge lost": Story(
        _CONFIG,
        30.0,
        {0.05: _HOLD, 28.0: _ACK},
        {(9.0, 9.4): switched("gauge_lost", True), (14.0, 27.0): switched("gauge_lost", True)},
    ),
    "gauge repeats its value, then jumps": Story(
        _limited(_CONFIG, gauge_stuck_s=5.0),
        60.0,
        {0.05: _HOLD, 26.0: _ACK, 27.0: _HOLD},
        {
            (10.0, 18.0): switched("gauge_stuck", True),
            (45.0, 99.0): switched("gauge_offset_pa", -60.0),
        },
    ),
    "pressure above the limits of program and board": Story(
        _limited(_CONFIG, gauge_pressure_max_pa=650.0),
        60.0,
        {0.05: _HOLD, 20.0: _ACK, 21.0: _HOLD, 52.0: _ACK},
        {
            (10.0, 13.0): switched("gauge_offset_pa", 100.0),
            (45.0, 47.0): switched("gauge_offset_pa", 400.0),
        },
    ),
    "pump runs at full, whatever its command": Story(
        _limited(_CONFIG, displacement_max_um=20.0),
        30.0,
        {0.05: _HOLD},
        {(10.0, 99.0): switched("pump_stuck_fraction", 1.0)},
    ),
    "pump gives nothing": Story(
        _limited(_CONFIG, displacement_min_um=-25.0, following_error_max_um=5.0),
        60.0,
        {0.05: _HOLD, 32.0: _ACK, 33.0: _HOLD},
        {
            (8.0, 28.0): switched("pump_share", 0.0),
            (55.0, 99.0): switched("laser_offset_um", -35.0),
        },
    ),
    "vent leaks": Story(
        _limited(_CONFIG, leak_growth_max=1.5),
        165.0,
        {0.05: _HOLD},
        {(70.0, 999.0): switched("vent_stuck_fraction", 0.024)},
    ),
    "pump and read-back run on after a stop": Story(
        _CONFIG,
        30.0,
        {0.05: _HOLD, 12.0: Command("lower", "ann")},
        {
            (11.9, 99.0): switched("readback_fraction", 0.9),
            (11.95, 99.0): switched("pump_stuck_fraction", 0.9),
        },
    ),
    "gas comes in although the pump is off": Story(
        _CONFIG, 30.0, {}, {(3.0, 99.0): switched("pump_stuck_fraction", 0.9)}
    ),
    "read-back does not follow": Story(
        _CONFIG, 25.0, {0.05: _HOLD}, {(9.0, 99.0): switched("readback_fraction", 0.05)}
    ),
    "board restarts, watchdog trips, hold resumes": Story(
        _CONFIG.model_copy(
            update={
                "resume": ResumeConfig(
                    faults=("link_lost", "device_silent", "watchdog_tripped"), wait_s=1.0
                )
            }
        ),
        75.0,
        {
            0.0: Command("resumed", AT_START, value=3600.0),
            0.05: _HOLD,
        },
        {
            (11.0, 11.3): switched("stalled", True),
            (40.0, 42.0): switched("stalled", True),
            (62.0, 62.5): switched("unreachable", True),
        },
        actions={15.0: VirtualBench.power_cycle},
    ),
    "ticks late, answers lost, task ended": Story(
        _CONFIG,
        60.0,
        {0.05: _HOLD, 26.0: _ACK, 27.0: _HOLD, 46.0: _ACK, 47.0: _HOLD},
        {
            (6.0, 20.0): switched("lost_every", 5),
            (10.0, 10.4): switched("late_ms", 150.0),
            (15.0, 17.0): switched("late_ms", 150.0),
            (38.0, 40.0): switched("silent", True),
            (58.0, 99.0): switched("dead_task", True),
        },
    ),
    "another program takes the board": Story(
        _CONFIG,
        25.0,
        {0.05: _HOLD, 18.0: _ACK},
        {(10.0, 11.0): switched("stalled", True)},
        actions={10.9: _claim_board},
    ),
    "locks, interlocks and refused commands": Story(
        _CONFIG.model_copy(
            update={
                "devices": DevicesConfig(board="tcp://twin", interlocks=(_EMERGENCY_STOP, _OXYGEN))
            }
        ),
        60.0,
        {
            0.0: Command("latched", AT_START, text="over_pressure"),
            1.0: _HOLD,
            2.0: _ACK,
            3.0: _HOLD,
            10.0: Command("latch", "ann", text="x", lock=_LOCK),
            10.1: _HOLD,
            11.0: Command("unlock", "bob", text="wrong", account="unix:bob"),
            12.0: Command("unlock", "ann", text="bofak", account="unix:ann"),
            13.0: _ACK,
            14.0: _HOLD,
            28.0: _ACK,
            29.0: _HOLD,
            40.0: Command("manual", "ann", value=1e6),
            41.0: Command("manual", "ann", value=1.0),
            42.0: Command("keep", "ann"),
            55.0: Command("stop", "ann"),
        },
        {(44.0, 46.0): switched("open_interlocks", 1 << 15)},
        actions={20.0: _open_oxygen, 24.0: lambda bench: bench.interlocks.lost_names.clear()},
    ),
    "film unseen without a laser, and an inflation that stalls": Story(
        _BY_OPTICS.model_copy(
            update={
                "twin": _BY_OPTICS.twin.model_copy(update={"start_error_um": -30.0}),
                "states": _STATES.model_copy(update={"inflate_timeout_s": 18.0}),
            }
        ),
        75.0,
        {0.05: _HOLD, 29.0: _ACK, 30.0: _HOLD, 32.0: Command("shape_off", "ann")},
        {
            (3.0, 25.0): switched("pump_share", 0.2),
            (54.0, 55.0): switched("camera_lost", True),
            (60.0, 99.0): switched("camera_lost", True),
        },
        shape_s=0.1,
    ),
}
