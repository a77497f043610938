"""The whole configuration: frozen, validated, unit-suffixed, one TOML file.

Every field that holds a quantity ends in its unit. Values that no real bench could have are
refused, so that a wrong unit (metres for millimetres) shows when the file is read and not at the
mirror.

The text below a key states what it means and, from its first imperative ("Change", "Leave",
"Lower", "Raise", "Set"), when to change it. Everything that explains the configuration is made from
these texts (`config/reference.py`).
"""

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, ValidationError, create_model, model_validator

from firmware_iface import settings
from firmware_iface.roles import ACTUATORS, ROLES, SENSORS
from firmware_iface.settings import Section
from membrane_ctrl.config import device_places
from membrane_ctrl.config.alarms import AlarmsConfig
from membrane_ctrl.config.bridges import BridgesConfig
from membrane_ctrl.config.climate import ClimateConfig
from membrane_ctrl.config.control import (
    EstimatorConfig,
    LimitsConfig,
    LoopConfig,
    PumpConfig,
    ResumeConfig,
    ShapeConfig,
    StatesConfig,
)
from membrane_ctrl.config.optics import (
    CameraConfig,
    DisturbancesConfig,
    GeometryConfig,
    MirrorConfig,
    OpticsConfig,
    PatternConfig,
)
from membrane_ctrl.config.port import PortConfig

__all__ = [
    "CameraConfig",
    "ClimateConfig",
    "Config",
    "DevicesConfig",
    "DisturbancesConfig",
    "EstimatorConfig",
    "GeometryConfig",
    "LimitsConfig",
    "LoopConfig",
    "MirrorConfig",
    "OpticsConfig",
    "PatternConfig",
    "PumpConfig",
    "RecordingConfig",
    "ResumeConfig",
    "ShapeConfig",
    "StatesConfig",
    "TwinConfig",
]

INTERLOCKS_MAX = 32  # bits of a mask that telemetry carries as a double
# required before any gas moves: the loop's two ends, and the limit that protects the film
NEEDED = tuple(name for name, role in ROLES.items() if role.needed)
# keys of the estimator that state the pump's response
_PUMP_RESPONSE_KEYS = frozenset({"pump_response", "pump_delay_s", "pump_lag_s"})
# keys of the pump that state its size
_PUMP_SIZE_KEYS = frozenset({"flow_full_um_per_s", "curve_fraction", "curve_um_per_s"})

if TYPE_CHECKING:  # `DevicesConfig.roles` gives their tables
    SensorTables = Section
else:
    SensorTables = create_model(
        "SensorTables",
        __base__=Section,
        **{
            role.name: (settings.SENSOR_DRIVERS[role.reads] | None, None)
            for role in SENSORS.values()
        },
    )


class DevicesConfig(SensorTables):
    """Which device fills which role: a board fills all, or one table per role."""

    board: settings.ModbusUrl | None = None
    """The pump board, tcp://HOST:PORT or rtu:///dev/ttyUSB0?baud=115200. Set it, or one table per
    role.
    """
    unit_id: settings.UnitId = 1
    timeout_s: settings.Timeout = 0.2
    watchdog_s: Annotated[float, Field(ge=0.1, le=10)] = 0.5
    """Time without commands after which the board stops the pump. Raise it for tick rates below 4
    Hz.
    """
    displacement: settings.DisplacementDriver | None = None
    pump: settings.PumpDriver | None = None
    vent: settings.ValueDriver | None = None
    camera: settings.CameraConfig | None = None
    screen: settings.ScreenConfig | None = None
    interlocks: Annotated[
        tuple[settings.InterlockDriver, ...], Field(max_length=INTERLOCKS_MAX)
    ] = ()
    """Circuits that must be closed for a hold, at most 32. Set it for emergency stop, door, oxygen
    monitor.
    """

    @model_validator(mode="after")
    def _require_board_or_roles(self) -> "DevicesConfig":
        """Require a pump board, or an instrument for each needed role."""
        filled = [role for role in ROLES if getattr(self, role) is not None]
        if self.board is not None and filled:
            raise ValueError(f"give either board or one table per role, not board and {filled[0]}")
        if self.board is None and not filled:
            raise ValueError(
                'name the pump board (board = "tcp://HOST:PORT"), or give one table per role'
            )
        missing = [role for role in NEEDED if role not in filled]
        # a laser is `Config`'s affair
        if self.board is None and missing not in (
            [],
            ["displacement"],
        ):
            raise ValueError(f"no device for {missing[0]}; required: {', '.join(NEEDED)}")
        for role in ACTUATORS:
            section = getattr(self, role)
            if isinstance(section, settings.ModbusMapConfig) and not _is_fraction(
                section.limits or section.value
            ):
                raise ValueError(
                    f"{role}: value and limits of an actuator are fractions within 0..1"
                )
        return self

    @model_validator(mode="after")
    def _require_one_owner_a_port(self) -> "DevicesConfig":
        owners: dict[str, tuple[str, str]] = {}
        for role, port, link in self.list_ports():
            other, other_link = owners.setdefault(port, (role, link))
            if other != role and not (link and link == other_link):
                raise ValueError(
                    f"{other} and {role} name the same port, {port}; only Modbus devices on "
                    "one link may share it"
                )
        return self

    def list_ports(self) -> Iterator[tuple[str, str, str]]:
        """Yield the role, the port and, of Modbus devices, the link of everything that has one."""
        if self.board is not None:
            yield "board", _port_of(self.board), self.board
        for role, section in self.roles().items():
            if isinstance(section, settings.ON_MODBUS):
                yield role, _port_of(section.link), section.link
            else:
                yield role, section.port, ""
        for index, interlock in enumerate(self.interlocks):
            if isinstance(interlock, settings.ModbusInputConfig):
                yield f"interlocks.{index}", _port_of(interlock.link), interlock.link

    @model_validator(mode="after")
    def _require_interlock_sources(self) -> "DevicesConfig":
        names = [interlock.name for interlock in self.interlocks]
        for index, interlock in enumerate(self.interlocks):
            if interlock.name in names[:index]:
                raise ValueError(
                    f"interlocks.{index}.name: {interlock.name!r} is the name of two interlocks"
                )
            if self.board is None and isinstance(interlock, settings.BoardInputConfig):
                raise ValueError(
                    f"interlocks.{index}.driver: an input of the pump board, but no board is "
                    "configured"
                )
        return self

    @model_validator(mode="after")
    def _camera_sees_a_screen(self) -> "DevicesConfig":
        if self.camera is None and self.screen is not None:
            raise ValueError("[devices.screen] needs a [devices.camera]")
        if self.camera is not None and (self.screen is None) != self.camera.shows_patterns:
            raise ValueError(
                "a camera needs a [devices.screen]; a folder of frames must not have one"
            )
        return self

    @property
    def vent_fitted(self) -> bool:
        """Whether there is a valve that lets gas out: a pump board drives one, single instruments
        may lack it.
        """
        return self.board is not None or self.vent is not None

    def roles(self) -> dict[str, settings.AnyDriver]:
        """The filled roles; empty with a board."""
        return {role: section for role in ROLES if (section := getattr(self, role)) is not None}

    @property
    def name(self) -> str:
        """For messages: the board's address, or each role's address."""
        return self.board or ", ".join(
            f"{role} on {address_of(section)}" for role, section in self.roles().items()
        )


def _port_of(link: str) -> str:
    """Serial port of an RTU link; a TCP link as it is."""
    return link.removeprefix("rtu://").partition("?")[0]


def address_of(section: settings.AnyDriver) -> str:
    """Address of the device: its port or its Modbus address."""
    if isinstance(section, settings.ON_MODBUS):
        return f"{section.link} unit {section.unit_id}"
    return section.port


def _is_fraction(pair: tuple[float, float]) -> bool:
    return all(math.isfinite(number) and 0.0 <= number <= 1.0 for number in pair)


class TwinConfig(Section):
    """The simulated bench. The defaults are assumptions, explained in
    docs/explanation/physics.md."""

    port: Annotated[int, Field(ge=0, le=65535)] = 5020
    """Port of its Modbus TCP server; 0: any free one. Change it if another program has it."""
    scenario: Literal["calm", "quiet", "typical", "gusty"] = "typical"
    """Weather around the mirror. Change it to see the loop in other weather."""
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = 1
    """Seed of everything random. Change it for another run of the same kind."""
    from_flat: bool = False
    """Start with a flat mirror; filling it takes two hours. Set it to true to practise a first
    inflation.
    """
    start_error_um: Annotated[float, Field(ge=-500, le=500)] = -25.0
    """Distance from the setpoint at the start. Change it to see a longer or shorter approach."""
    laser: bool = True
    """Whether there is one. Set it to false to practise a bench without a laser
    (estimator.process_value).
    """
    laser_noise_um: Annotated[float, Field(ge=0, le=100)] = 1.0
    """Noise of a laser reading. Change it to your laser's."""
    laser_resolution_um: Annotated[float, Field(ge=0, le=100)] = 0.1
    """Steps of the laser reading; 0: none. Change it to your laser's."""
    laser_drift_um_per_min: Annotated[float, Field(ge=-1000, le=1000)] = 0.0
    """Drift of the laser's mount. Change it to see the shape loop work."""
    leak_time_constant_s: Annotated[float, Field(ge=10, le=1e8)] = 1.0e4
    """Time in which the leak would empty the mirror to a third. Change it to your mirror's."""
    pump_shape: Literal[
        "configured", "quadratic", "root", "s-shaped", "saturating", "hysteretic", "pwm"
    ] = "configured"
    """True curve of the pump, between the dead command and the full flow of `[pump]`.
    Change it to practise `tune pump`."""
    pump_delay_s: Annotated[float, Field(ge=0, le=10)] = 0.075
    """Time of the gas in the tube. Change it to your bench's."""
    pump_lag_s: Annotated[float, Field(gt=0, le=10)] = 0.15
    """Time constant of motor and diaphragm. Change it to your pump's."""
    barometer_noise_pa: Annotated[float, Field(ge=0, le=100)] = 0.05
    """Noise of the barometer. Change it to your barometer's."""
    thermometer_noise_k: Annotated[float, Field(ge=0, le=10)] = 0.002
    """Noise of the air thermometer. Change it to your thermometer's."""
    climate: Literal["steady", "day", "hvac", "lamp"] = "steady"
    """Climate of the room, which strains film and ring: `day` has +-2 K and +-10 % of relative
    humidity, `hvac` +-0.5 K and -+2 % each quarter of an hour, `lamp` a warm patch of the film for
    ten minutes of each hour. Then film, ring and humidity have sensors in virtual time. Change it
    to see how climate changes the figure."""
    film_prestrain: Annotated[float, Field(ge=-0.01, le=0.1)] = 0.0
    """Strain of the flat film before it was clamped, in its pictures. Change it to try `film` and
    `calibrate`.
    """
    film_poisson: Annotated[float, Field(ge=0, le=0.5)] = 0.3
    """Poisson ratio of the film, in its pictures. Change it to try `film` and `calibrate`."""
    film_stiffness_n_per_m: Annotated[float, Field(ge=1, le=1e9)] = 2.05e5
    """Modulus times thickness of the film, for the pressure that `simulate` states. Change it to
    try `film`.
    """
    drum_nm: Annotated[float, Field(ge=0, le=1e4)] = 0.0
    """Amplitude of each vibration of the film, at 27, 48, 57 and 61 Hz, in its pictures. Change it
    to try `modes`.
    """
    disturbances: DisturbancesConfig = DisturbancesConfig()
    # true camera and screen poses; none: those of [optics.geometry]
    geometry: GeometryConfig | None = None


class RecordingConfig(Section):
    """Where runs are stored and what they contain."""

    logs_dir: Annotated[str, Field(min_length=1)] = "logs"
    """Folder of the runs, relative to the working folder. Change it to a disk with room."""
    min_free_mb: Annotated[float, Field(ge=1, le=1e9)] = 500.0
    """Free space below which the recorder reduces its data. Raise it on a disk that others use,
    too.
    """
    thumbnails: bool = True
    """Record small pictures of the frames. Set it to false to save space."""
    raw_every_cycles: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """Keep the frames of every n-th cycle; 0: none. Raise it to examine the measurement afterwards.
    """
    raw_before_fault_cycles: Annotated[int, Field(ge=0, le=20)] = 2
    """Always keep the frames of this many cycles before a fault. Raise it to see more of a fault's
    history.
    """
    segment_s: Annotated[float, Field(ge=10, le=86_400)] = 3600.0
    """Length of a file of the recording; a crash leaves at most this much unoptimised. Lower it for
    smaller files.
    """
    quiet_hz: Annotated[float, Field(ge=0.1, le=200)] = 1.0
    """Rows per second for the viewer while nothing happens. Raise it to see more, at the cost of
    space.
    """
    keep_gb: Annotated[float, Field(ge=0.1, le=1e6)] | None = None
    """Delete the oldest runs beyond this total; absent: never. Set it on a machine whose disk is
    not cleared by hand.
    """
    keep_days: Annotated[float, Field(ge=0.1, le=1e5)] | None = None
    """Delete runs older than this; absent: never. Set it on a machine whose disk is not cleared by
    hand."""


class Config(Section):
    """The whole configuration of a run."""

    loop: LoopConfig = LoopConfig()
    pump: PumpConfig = PumpConfig()
    limits: LimitsConfig = LimitsConfig()
    states: StatesConfig = StatesConfig()
    resume: ResumeConfig = ResumeConfig()
    shape: ShapeConfig = ShapeConfig()
    estimator: EstimatorConfig = EstimatorConfig()
    climate: ClimateConfig = ClimateConfig()
    optics: OpticsConfig = OpticsConfig()
    devices: DevicesConfig | None = None
    twin: TwinConfig = TwinConfig()
    recording: RecordingConfig = RecordingConfig()
    port: PortConfig = PortConfig()
    alarms: AlarmsConfig = AlarmsConfig()
    bridges: BridgesConfig = BridgesConfig()

    @model_validator(mode="after")
    def _check_consistency(self) -> "Config":
        """Refuse tables that contradict each other; `controller.cross_check` judges the finer
        points.
        """
        limits = self.limits
        if limits.displacement_min_um >= limits.displacement_max_um:
            raise ValueError("limits.displacement_min_um must be below limits.displacement_max_um")
        if not limits.displacement_min_um < self.loop.setpoint_um < limits.displacement_max_um:
            raise ValueError(
                f"loop.setpoint_um = {self.loop.setpoint_um:g} is outside the limits "
                f"({limits.displacement_min_um:g} .. {limits.displacement_max_um:g} µm)"
            )
        if self.devices is not None:
            shared = device_places.find_shared(self.devices.roles(), self.devices.interlocks)
            if shared:
                raise ValueError(shared)
        if self.devices is not None and not (
            self.devices.board or self.devices.displacement or self.by_optics
        ):
            raise ValueError(
                "devices: no device for displacement; without a laser set "
                'estimator.process_value = "optics"'
            )
        if self.devices is not None and self.devices.camera is not None:
            bits = self.devices.camera.frame_bits
            if bits not in (None, self.optics.camera.bits):
                raise ValueError(
                    f"optics.camera.bits = {self.optics.camera.bits}, but devices.camera "
                    f"gives {bits}"
                )
        return self

    @property
    def interlocks(self) -> tuple[settings.InterlockDriver, ...]:
        """The interlocks; bit i of `interlocks_open` is the i-th."""
        if self.devices is None:
            return ()
        return self.devices.interlocks

    @property
    def vent_fitted(self) -> bool:
        """Whether the bench has a vent; the twin, which serves if no devices are named, has one."""
        return self.devices is None or self.devices.vent_fitted

    @property
    def by_optics(self) -> bool:
        """Whether the mirror is held without a laser."""
        return self.estimator.process_value == "optics"

    @property
    def has_pi(self) -> bool:
        """Whether the PI on the laser may hold the mirror: its gains then matter."""
        return self.estimator.process_value in ("auto", "laser")

    @property
    def estimates_centre(self) -> bool:
        """Whether an estimate of the centre runs beside the states."""
        match self.estimator.process_value:
            case "laser":
                return False
            case "auto":
                return self.shape.enabled or self.loop.feedforward_barometer
            case _:
                return True

    def with_gains(self, changed: Mapping[str, Any] | None) -> "Config":
        """This configuration with the gains, and the pump's curve, of an event; as it is if they do
        not fit.
        """
        changed = changed or {}
        loop_changed = {key: changed[key] for key in LoopConfig.model_fields if key in changed}
        try:
            loop = LoopConfig.model_validate(self.loop.model_dump() | loop_changed)
            pump = PumpConfig.model_validate(changed.get("pump", self.pump))
        except ValidationError:
            return self
        return self.model_copy(update={"loop": loop, "pump": pump})


def leave_to_start(config: Config) -> Config:
    """The configuration of a new hold: what its file does not state is found at the start.

    Recorded runs state every key, so this changes no replay.
    """
    estimator = config.estimator
    if not _PUMP_RESPONSE_KEYS & estimator.model_fields_set:
        estimator = estimator.model_copy(update={"pump_response": "identified"})
    if "process_value" not in estimator.model_fields_set:
        estimator = estimator.model_copy(update={"process_value": "auto"})
    states = config.states
    size_stated = bool(_PUMP_SIZE_KEYS & config.pump.model_fields_set)
    if not size_stated and "actuator_size" not in states.model_fields_set:
        states = states.model_copy(update={"actuator_size": "any"})
    return config.model_copy(update={"estimator": estimator, "states": states})
