"""The settings of each driver: its table in the configuration, with limits and defaults."""

from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, model_validator

# keys of the same meaning for every device
_PORT = "Serial port, /dev/ttyUSB0 or usb:VID:PID[:SERIAL]. Set it to the one that `devices` lists."
_LINK = "Modbus line, tcp://HOST:PORT or rtu:///dev/ttyUSB0?baud=115200&parity=E. Set it as wired."
MODBUS_URL_PATTERN = r"^(tcp|rtu)://."
_UNIT = "Modbus address of the device. Set it as stored in the device."
_SERIAL = "Serial number; empty: whichever answers. Set it to refuse any other instrument."
_TIMEOUT = "Longest wait for an answer. Raise it on a slow line or machine."
_BAUD = "Baud rate as stored in the device. Change it if the device was set to another."
_DIRECTION = (
    "Sign of the reading; -1: the laser is behind the mirror. Set it to 1 for a laser in front."
)
_STEP = (
    "Readings farther than this from both previous ones are rejected. Raise it at low tick rates."
)
BOARD_INPUTS = 16
Fraction = Annotated[float, Field(ge=0, le=1)]
Micrometres = Annotated[float, Field(ge=-1e7, le=1e7)]  # ten metres
Number = Annotated[float, Field(ge=-1e12, le=1e12)]
Distance = Annotated[float, Field(ge=-1e4, le=1e4)]
Word = Annotated[int, Field(ge=0, le=0xFFFF)]
Port = Annotated[str, Field(min_length=1, description=_PORT)]
ModbusUrl = Annotated[str, Field(pattern=MODBUS_URL_PATTERN, description=_LINK)]
UnitId = Annotated[int, Field(ge=1, le=247, description=_UNIT)]
Serial = Annotated[str, Field(max_length=80, description=_SERIAL)]
Timeout = Annotated[float, Field(gt=0, le=5, description=_TIMEOUT)]
Baud = Annotated[int, Field(ge=300, le=1_000_000, description=_BAUD)]
Direction = Annotated[Literal[-1, 1], Field(description=_DIRECTION)]
StepMax = Annotated[float, Field(gt=0, le=10_000, description=_STEP)]
Driver = Field(discriminator="driver")


class Section(BaseModel):
    """A configuration table: immutable, no unknown keys, no NaN or infinity, no `true` in place of
    a number.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _refuse_other_types(cls, table: Any) -> Any:
        """Refuse `true` and "1" for a number, 1 for a switch: pydantic takes them all for what they
        are not.
        """
        if not isinstance(table, dict):
            return table
        for name, value in table.items():
            field = cls.model_fields.get(name)
            kinds = set() if field is None else _list_kinds(field.annotation)
            if kinds == {bool} and not isinstance(value, bool):
                raise ValueError(f"{name}: {value!r}: write true or false")
            if kinds and _has_kind(value, bool) and not kinds & {bool, Any}:
                raise ValueError(f"{name}: {str(value).lower()} is neither a number nor a text")
            if _has_kind(value, str) and kinds & {int, float} and not kinds & {str, Any}:
                raise ValueError(
                    f"{name}: {value!r}: write a number, without quotes, with a decimal point"
                )
        return table


def _has_kind(value: Any, kind: Any) -> bool:
    return isinstance(value, kind) or (
        isinstance(value, list | tuple) and any(_has_kind(part, kind) for part in value)
    )


def _list_kinds(annotation: Any) -> set[Any]:
    """Return the types in an annotation; of a literal, that of its values."""
    inner = [
        _list_kinds(part) if not isinstance(part, int | str) else {type(part)}
        for part in get_args(annotation)
    ]
    if inner or isinstance(annotation, type) or annotation is Any:
        return {annotation}.union(*inner)
    return set()


class Optoncdt1420Config(Section):
    """Micro-Epsilon optoNCDT 1420 laser."""

    driver: Literal["optoncdt1420"] = "optoncdt1420"
    port: Port
    baud: Baud = 921_600
    rate_khz: Annotated[float, Field(ge=0.25, le=4)] = 4.0
    """Measuring rate: 0.25, 0.5, 1, 2 or 4. Lower it with `baud`, or for a dark target."""
    range_mm: Annotated[float, Field(gt=0, le=500)] | None = None
    """Measuring range of the sensor. Set it to refuse a sensor of another range."""
    zero_mm: Distance | None = None
    """Distance from the start of the range at displacement 0; its middle when absent. Set it to
    move the zero.
    """
    direction: Direction = -1
    step_max_um: StepMax = 50.0
    timeout_s: Annotated[float, Field(gt=0, le=5)] = 0.2
    """Longest wait for an answer, and for a new value after a reading. Raise it on a slow machine.
    """

    @model_validator(mode="after")
    def _check_rate(self) -> "Optoncdt1420Config":
        rates_khz = (0.25, 0.5, 1.0, 2.0, 4.0)
        if self.rate_khz not in rates_khz:
            raise ValueError(
                f"rate_khz = {self.rate_khz:g}: the sensor has "
                f"{', '.join(f'{r:g}' for r in rates_khz)}"
            )
        if (busy := 1000 * self.rate_khz * 60 / self.baud) > 0.9:  # six bytes of ten bits a value
            raise ValueError(
                f"baud = {self.baud} cannot carry rate_khz = {self.rate_khz:g} (line "
                f"{busy:.0%} busy)"
            )
        return self


class KeyenceDlRs1aConfig(Section):
    """Keyence DL-RS1A with an IL, IG or GT2 head."""

    driver: Literal["keyence_dl_rs1a"] = "keyence_dl_rs1a"
    port: Port
    baud: Literal[2400, 4800, 9600, 19_200, 38_400] = 9600
    """Baud rate as set by its switches; 9600 gives 25 readings per second, 38400 gives 80. Set it
    to 38400.
    """
    parity: Literal["N", "E", "O"] = "N"
    """Parity as set by the switches. Set it to E, with the switches: without it a corrupted digit
    passes.
    """
    amplifier: Annotated[int, Field(ge=0, le=14)] = 0
    """0 is the main unit, 1 to 14 are expansions. Change it if the head is at an expansion."""
    zero_mm: Distance = 0.0
    """Value at displacement 0. Change it to move the zero."""
    direction: Direction = -1
    step_max_um: StepMax = 10.0
    timeout_s: Timeout = 0.1


class VaisalaPtb330Config(Section):
    """Vaisala PTB330 barometer."""

    driver: Literal["vaisala_ptb330"] = "vaisala_ptb330"
    port: Port
    baud: Baud = 4800
    period_s: Annotated[float, Field(gt=0, le=60)] = 0.2
    """Interval between requests; a message takes 80 ms at 4800 baud. Raise it at lower baud rates.
    """
    age_max_s: Annotated[float, Field(gt=0, le=600)] = 3.0
    """Age from which a value is not used. Raise it for a slow measurement."""
    timeout_s: Timeout = 0.3


class Mks937bConfig(Section):
    """MKS 937B or 946 controller with a capacitance manometer between gas and room."""

    driver: Literal["mks_937b"] = "mks_937b"
    port: Port
    baud: Literal[9600, 19_200, 38_400, 57_600, 115_200] = 115_200
    """Baud rate as set in the controller, which is delivered with 9600. Set both to 115200: 9600
    takes 30 ms.
    """
    parity: Literal["N", "E", "O"] = "N"
    """Parity as set in the controller. Set it to E, with the controller, if that offers it."""
    address: Annotated[int, Field(ge=1, le=253)] = 253
    """Address as set in the controller. Change it if the controller was set to another."""
    channel: Annotated[int, Field(ge=1, le=6)] = 1
    """Channel of the manometer: 1 and 2 are in slot A, 3 and 4 in B, 5 and 6 in C. Set it as
    plugged in.
    """
    range_pa: Annotated[float, Field(gt=0, le=1e7)] | None = None
    """Full scale of the manometer. Set it to have the limits checked against it."""
    step_max_pa: Annotated[float, Field(gt=0, le=1e6)] = 50.0
    """Readings farther than this from both previous ones are rejected. Raise it at low tick rates.
    """
    serial: Serial = ""
    timeout_s: Timeout = 0.1


class VentusConfig(Section):
    """Lee / TTP Ventus disc pump."""

    driver: Literal["ventus"] = "ventus"
    port: Port
    power_max_mw: Annotated[float, Field(gt=0, le=1400)] = 1000.0
    """Power at full drive; none of these pumps takes more than 1400. Change it to your pump's
    rating.
    """
    timeout_s: Timeout = 0.1


class BronkhorstModbusConfig(Section):
    """Bronkhorst EL-FLOW (as pump) or EL-PRESS (as gauge pressure) with a Modbus interface."""

    driver: Literal["bronkhorst_modbus"]
    link: ModbusUrl
    unit_id: UnitId
    serial: Serial = ""
    timeout_s: Timeout = 0.2


class BronkhorstProparConfig(Section):
    """Bronkhorst EL-FLOW (as pump) or EL-PRESS (as gauge pressure) on RS-232, ProPar protocol."""

    driver: Literal["bronkhorst_propar"] = "bronkhorst_propar"
    port: Port
    baud: Baud = 38_400
    node: Annotated[int, Field(ge=1, le=128)] = 128
    """ProPar node; 128: whatever is at the end of the cable. Change it to insist on one node."""
    serial: Serial = ""
    timeout_s: Timeout = 0.2


class ModbusMapConfig(Section):
    """Any device with Modbus registers, one of which is the role's value.

    `raw` and `value` are two points of the straight line between the register and the role's unit.
    """

    driver: Literal["modbus_map"]
    link: ModbusUrl
    unit_id: UnitId = 1
    timeout_s: Timeout = 0.2
    preset: str = ""
    """File of firmware_iface/presets with defaults for the keys below. Set it if your device has
    one.
    """
    function: Literal["holding", "input"] | None = None
    """Kind of register; holding when absent. Set it from the device's manual."""
    type: Literal["u16", "i16", "u32", "i32", "f32"] | None = None
    """Type of the value in the registers; u16 when absent. Set it from the device's manual."""
    word_order: Literal["big", "little"] | None = None
    """Which word of a 32-bit value comes first; big when absent. Set it from the device's manual.
    """
    address: Word
    """Address of the first register, counted from 0. Set it from the device's manual."""
    raw: tuple[Number, Number] | None = None
    """Register contents at the two ends of `value`. Set it from the manual, e.g. the counts at 4
    and 20 mA.
    """
    value: tuple[Number, Number]
    """Two values in the role's unit (µm, Pa, degC, fraction), at the contents `raw`. Set it as
    scaled.
    """
    limits: tuple[Number, Number] | None = None
    """Values outside are refused; the span of `value` when absent. Set it wider for a sensor that
    exceeds it.
    """
    identity_address: Word | None = None
    """Holding register that identifies the device. Set it to refuse any other device."""
    identity_equals: Word | None = None
    """Content of that register. Set it together with `identity_address`."""

    @model_validator(mode="after")
    def _check_line(self) -> "ModbusMapConfig":
        for name, pair in (("raw", self.raw), ("value", self.value)):
            if pair is not None and pair[0] == pair[1]:
                raise ValueError(f"{name} needs two different numbers")
        if self.limits is not None and self.limits[0] >= self.limits[1]:
            raise ValueError("limits needs two numbers, the lower one first")
        return self


class ExternalSection(Section):
    """A device whose driver is a package of its own. Reading a configuration never loads that
    package.
    """

    model_config = ConfigDict(extra="allow")

    driver: Literal["external"]
    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
    """Name under which the driver is installed. Set it to one that `devices` lists."""

    @property
    def keys(self) -> dict[str, Any]:
        """The keys of the table that its driver gets."""
        return self.model_dump(exclude={"driver", "name"}, exclude_none=True)


class ExternalConfig(ExternalSection):
    """An instrument whose driver is a separate package (docs/how-to/new-device.md). The driver
    defines more keys.

    Reading a configuration never loads that package: only opening or emulating the devices does.
    """

    port: Port
    timeout_s: Timeout = 0.2


DisplacementDriver = Annotated[
    Optoncdt1420Config | KeyenceDlRs1aConfig | ModbusMapConfig | ExternalConfig, Driver
]
PumpDriver = Annotated[
    BronkhorstModbusConfig
    | BronkhorstProparConfig
    | VentusConfig
    | ModbusMapConfig
    | ExternalConfig,
    Driver,
]
PressureDriver = Annotated[
    BronkhorstModbusConfig
    | BronkhorstProparConfig
    | Mks937bConfig
    | ModbusMapConfig
    | ExternalConfig,
    Driver,
]
BarometerDriver = Annotated[VaisalaPtb330Config | ModbusMapConfig | ExternalConfig, Driver]
ValueDriver = Annotated[ModbusMapConfig | ExternalConfig, Driver]
# By what a sensor measures (`roles.Role.reads`): its drivers.
SENSOR_DRIVERS: dict[str, Any] = {
    "gauge_pressure_pa": PressureDriver,
    "ambient_pressure_pa": BarometerDriver,
    "air_temperature_c": ValueDriver,
    "film_temperature_c": ValueDriver,
    "ring_temperature_c": ValueDriver,
    "humidity_percent": ValueDriver,
}
ON_MODBUS = (BronkhorstModbusConfig, ModbusMapConfig)  # have a `link`, the others a `port`
# Controllers of a flow: it is proportional to the command, from 0 on.
FLOW_CONTROLLERS = (BronkhorstModbusConfig, BronkhorstProparConfig)
AnyDriver = DisplacementDriver | PumpDriver | PressureDriver | BarometerDriver


class InterlockConfig(Section):
    """A normally closed circuit that prevents a hold, and ends one, while it is open."""

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,30}$")]
    """Name in messages. Set it to a word of lower-case letters, digits and `_`, such as door."""
    text: Annotated[str, Field(min_length=1, max_length=200)]
    """For people, while the circuit is open. Set it to what is open and what to do."""
    safe_level: Literal["ramp_down", "pump_off", "vent"] = "pump_off"
    """Safe level that an open circuit, or a lost signal, enters. Set it to vent where pressure in
    the mirror is the danger, to ramp_down where a sudden stop is."""

    @model_validator(mode="after")
    def _one_line_of_text(self) -> "InterlockConfig":
        if not self.text.isprintable() or not self.text.strip():
            raise ValueError("text: only printable characters, in one line")
        return self


class BoardInputConfig(InterlockConfig):
    """Interlock at an input of the pump board, from register map version 3 on."""

    driver: Literal["board_input"]
    input: Annotated[int, Field(ge=0, le=BOARD_INPUTS - 1)]
    """Number of the board's input, counted from 0. Set it as wired."""


class PolledInterlockConfig(InterlockConfig):
    """Interlock at a device that is asked again and again."""

    period_s: Annotated[float, Field(ge=0.01, le=10)] = 0.1
    """Interval between requests. Lower it for a contact that may open for a moment only."""
    age_max_s: Annotated[float, Field(ge=0.05, le=30)] = 0.5
    """Age from which an answer does not count: the circuit is then open. Raise it for a slow
    line.
    """


class ModbusInputConfig(PolledInterlockConfig):
    """Interlock at a discrete input or coil of a Modbus device; 1 means closed."""

    driver: Literal["modbus_input"]
    link: ModbusUrl
    unit_id: UnitId = 1
    timeout_s: Timeout = 0.2
    function: Literal["discrete", "coil"] = "discrete"
    """Kind of bit. Set it to coil for a device without discrete inputs: a coil keeps what was last
    written.
    """
    address: Word
    """Address of the bit, counted from 0. Set it from the device's manual."""


class GpioLineConfig(PolledInterlockConfig):
    """Interlock at a GPIO line of this machine."""

    driver: Literal["gpio_line"]
    chip: Annotated[str, Field(min_length=1)] = "/dev/gpiochip0"
    """The chip's device file. Set it to the one that `gpiodetect` lists."""
    line: Annotated[int, Field(ge=0, le=4095)]
    """Number of the line on its chip. Set it as wired; `gpioinfo` lists names and numbers."""
    wiring: Literal["to_ground", "to_supply"] = "to_ground"
    """What the closed contact connects the line to. Set it as wired; a cut wire then reads as open.
    """
    pull: Literal["internal", "external"] = "internal"
    """Resistor that defines the level of an open contact. Set it to external if the chip has none.
    """


InterlockDriver = Annotated[BoardInputConfig | ModbusInputConfig | GpioLineConfig, Driver]


class CameraSection(Section):
    """A camera's table: what the program must know of its frames, whichever the driver."""

    @property
    def frame_exposure_s(self) -> float | None:
        """Exposure of a frame; None if the driver does not state it."""
        return None

    @property
    def frame_bits(self) -> int | None:
        """Depth of a pixel; None if the driver gives the depth of `[optics.camera]`."""
        return None

    @property
    def shows_patterns(self) -> bool:
        """Whether the camera also takes the role of a screen."""
        return False


class AravisCameraConfig(CameraSection):
    """A GenICam camera (USB3 Vision or GigE Vision)."""

    driver: Literal["aravis"] = "aravis"
    camera: str = ""
    """Name as `devices` lists it, or its address; empty: the first one found. Set it if there are
    several.
    """
    pixel_format: Literal[
        "Mono8", "Mono10", "Mono12", "Mono16", "BayerRG8", "BayerGR8", "BayerGB8", "BayerBG8"
    ] = "Mono8"
    """Format of a pixel. Bayer needs no demosaicing: each pixel's phase is independent of its gain.
    Change it with `optics.camera.bits`, for a colour camera or for more depth."""
    exposure_ms: Annotated[float, Field(gt=0, le=10_000)] = 20.0
    """Exposure of a frame. Change it to what the self test of the start suggests."""
    gain_db: Annotated[float, Field(ge=0, le=48)] = 0.0
    """Gain of the sensor. Raise it only if the exposure cannot be longer: it adds noise."""
    packet_bytes: Annotated[int, Field(ge=0, le=65_000)] = 0
    """GigE Vision: size of a packet; 0: negotiated by camera and network. Set it to 8000 with jumbo
    frames.
    """
    timeout_s: Annotated[float, Field(gt=0, le=60)] = 1.0
    """Longest wait for a frame, from the end of its exposure. Raise it on a slow network."""

    @property
    def frame_exposure_s(self) -> float:
        """Exposure of a frame."""
        return self.exposure_ms / 1000.0

    @property
    def frame_bits(self) -> int:
        """Depth of a pixel."""
        if not self.pixel_format[-2:].isdigit():
            return 8
        return int(self.pixel_format[-2:])


class UvcCameraConfig(CameraSection):
    """A USB camera without GenICam. It gives 8 bits."""

    driver: Literal["uvc"] = "uvc"
    port: str = "0"
    """Its number, or its path such as /dev/video0. Set it to a path below /dev/v4l/by-id, which
    stays the same.
    """
    exposure: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    """Exposure in the camera's own unit, often 0.1 ms; 0 leaves it. Set it so that white does not
    saturate.
    """
    gain: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    """Gain in the camera's own unit; 0 leaves it. Raise it only if the exposure cannot be longer.
    """

    @property
    def frame_bits(self) -> int:
        """Depth of a pixel."""
        return 8


class FolderCameraConfig(CameraSection):
    """Pictures from a folder instead of a camera and a screen."""

    driver: Literal["folder"] = "folder"
    folder: Annotated[str, Field(min_length=1)]
    """Folder of pictures named like the patterns, e.g. x_sin_0.png. Set it to a capture set."""

    @property
    def shows_patterns(self) -> bool:
        """Each picture is the one of the pattern to show."""
        return True


class ExternalCameraConfig(CameraSection, ExternalSection):
    """A camera whose driver is a separate package (docs/how-to/new-camera.md). The driver defines
    more keys.

    Reading a configuration never loads that package: only opening or emulating the camera does.
    """

    exposure_ms: Annotated[float, Field(gt=0, le=10_000)] | None = None
    """Exposure of a frame; absent: the driver does not state it. Set it if the driver has this key.
    """

    @property
    def frame_exposure_s(self) -> float | None:
        """Exposure of a frame; None if the driver does not state it."""
        if self.exposure_ms is None:
            return None
        return self.exposure_ms / 1000.0


class ScreenSection(Section):
    """A screen's table: what the program must know of its pixels and its light, whichever the
    driver.
    """

    width_px: Annotated[int, Field(ge=16, le=16_384)]
    """Columns of the panel. Set it to the panel's own; `devices` lists them."""
    height_px: Annotated[int, Field(ge=16, le=16_384)]
    """Rows of the panel. Set it to the panel's own; `devices` lists them."""
    pixel_mm: Annotated[float, Field(gt=0.01, le=10)]
    """Pitch of its pixels. Set it from a rule laid over 1000 pixels."""
    centre_px: tuple[Number, Number] | None = None
    """(column, row) of O'; the screen's middle when absent. Set it if the pattern must be shifted.
    """
    settle_ms: Annotated[float, Field(ge=0, le=5000)] | None = None
    """Time until a new picture is complete; measured at the start when absent. Set it to save that
    measurement.
    """
    linearise: bool = True
    """Measure the display's response at the start and correct it. Set it to false for a linear
    display.
    """
    self_test: bool = True
    """Test exposure and panel at the start. Set it to false to start sooner."""


class PygameScreenConfig(ScreenSection):
    """A display of this machine's desktop."""

    driver: Literal["pygame"] = "pygame"
    display: Annotated[int, Field(ge=0, le=15)] = 0
    """Number of the display. Change it if the desktop has several."""


class ExternalScreenConfig(ScreenSection, ExternalSection):
    """A screen whose driver is a separate package (docs/how-to/new-camera.md). The driver defines
    more keys.

    Reading a configuration never loads that package: only opening or emulating the screen does.
    """


CameraConfig = Annotated[
    AravisCameraConfig | UvcCameraConfig | FolderCameraConfig | ExternalCameraConfig, Driver
]
ScreenConfig = Annotated[PygameScreenConfig | ExternalScreenConfig, Driver]
