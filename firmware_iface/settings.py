"""The settings of each driver: its table in the configuration, with limits and defaults."""

from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, model_validator


class Section(BaseModel):
    """A configuration table: immutable, no unknown keys, no NaN or infinity, no `true` in place of a number."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _truth_is_no_number(cls, table: Any) -> Any:
        """Refuse booleans: pydantic takes `true` for 1.0, so a leftover switch would pass as a quantity."""
        if isinstance(table, dict):
            for name, value in table.items():
                field = cls.model_fields.get(name)
                if field is not None and _has_truth(value) and not _takes_truth(field.annotation):
                    raise ValueError(f"{name}: {str(value).lower()} is neither a number nor a text")
        return table


def _has_truth(value: Any) -> bool:
    return isinstance(value, bool) or (isinstance(value, list | tuple) and any(map(_has_truth, value)))


def _takes_truth(annotation: Any) -> bool:
    return annotation in (bool, Any) or any(map(_takes_truth, get_args(annotation)))


UnitId = Annotated[int, Field(ge=1, le=247)]
Timeout = Annotated[float, Field(gt=0, le=5)]
Baud = Annotated[int, Field(ge=300, le=1_000_000)]
Direction = Literal[-1, 1]  # -1: the laser is behind the mirror, and a deeper bowl is nearer to it
StepMax = Annotated[float, Field(gt=0, le=10_000)]  # readings farther than this from both previous ones are rejected
Word = Annotated[int, Field(ge=0, le=0xFFFF)]
Port = Annotated[str, Field(min_length=1)]  # /dev/ttyUSB0, or usb:VID:PID[:SERIAL]
ModbusUrl = Annotated[str, Field(pattern=r"^(tcp|rtu)://")]  # tcp://HOST:PORT or rtu:///dev/ttyUSB0?baud=115200


class Optoncdt1420Config(Section):
    """Micro-Epsilon optoNCDT 1420 laser."""

    driver: Literal["optoncdt1420"] = "optoncdt1420"
    port: Port
    baud: Baud = 921_600
    rate_khz: float = 4.0
    range_mm: Annotated[float, Field(gt=0, le=500)] | None = None  # refuse a sensor of another range
    zero_mm: float | None = None  # distance from the start of the range at displacement 0; its middle when absent
    direction: Direction = -1
    step_max_um: StepMax = 50.0
    timeout_s: Timeout = 0.2  # for an answer, and for a new value after a reading

    @model_validator(mode="after")
    def _rate(self) -> "Optoncdt1420Config":
        rates_khz = (0.25, 0.5, 1.0, 2.0, 4.0)
        if self.rate_khz not in rates_khz:
            raise ValueError(f"rate_khz = {self.rate_khz:g}: the sensor has {', '.join(f'{r:g}' for r in rates_khz)}")
        if (busy := 1000 * self.rate_khz * 60 / self.baud) > 0.9:  # six bytes of ten bits a value
            raise ValueError(f"baud = {self.baud} cannot carry rate_khz = {self.rate_khz:g} (line {busy:.0%} busy)")
        return self


class KeyenceDlRs1aConfig(Section):
    """Keyence DL-RS1A with an IL, IG or GT2 head."""

    driver: Literal["keyence_dl_rs1a"] = "keyence_dl_rs1a"
    port: Port
    # baud and parity as set by the unit's switches: the factory's 9600 without parity is good for 25 readings a
    # second, 38400 with even parity for 80
    baud: Literal[2400, 4800, 9600, 19_200, 38_400] = 9600
    parity: Literal["N", "E", "O"] = "N"
    amplifier: Annotated[int, Field(ge=0, le=14)] = 0  # 0 is the main unit, 1..14 are expansions
    zero_mm: float = 0.0  # value at displacement 0
    direction: Direction = -1
    step_max_um: StepMax = 10.0
    timeout_s: Timeout = 0.1


class VaisalaPtb330Config(Section):
    """Vaisala PTB330 barometer."""

    driver: Literal["vaisala_ptb330"] = "vaisala_ptb330"
    port: Port
    baud: Baud = 4800
    period_s: Annotated[float, Field(gt=0, le=60)] = 0.2  # between requests; a message takes 80 ms at 4800 baud
    age_max_s: Annotated[float, Field(gt=0, le=600)] = 3.0  # NaN if the measurement counter stands still longer
    timeout_s: Timeout = 0.3


class VentusConfig(Section):
    """Lee / TTP Ventus disc pump."""

    driver: Literal["ventus"] = "ventus"
    port: Port
    power_max_mw: Annotated[float, Field(gt=0, le=1400)] = (
        1000.0  # full drive; none of these pumps takes more than 1400
    )
    timeout_s: Timeout = 0.1


class BronkhorstModbusConfig(Section):
    """Bronkhorst EL-FLOW (as pump) or EL-PRESS (as gauge pressure) with a Modbus interface."""

    driver: Literal["bronkhorst_modbus"]
    link: ModbusUrl
    unit_id: UnitId
    serial: str = ""  # refuse any other instrument; empty: take whichever answers
    timeout_s: Timeout = 0.2


class BronkhorstProparConfig(Section):
    """Bronkhorst EL-FLOW (as pump) or EL-PRESS (as gauge pressure) on RS-232, ProPar protocol."""

    driver: Literal["bronkhorst_propar"] = "bronkhorst_propar"
    port: Port
    baud: Baud = 38_400
    node: Annotated[int, Field(ge=1, le=128)] = 128  # 128: whatever is at the end of the cable
    serial: str = ""
    timeout_s: Timeout = 0.2


class ModbusMapConfig(Section):
    """Any device with Modbus registers, one of which is the role's value.

    `raw` and `value` are two points of the straight line between the register and the role's unit.
    """

    driver: Literal["modbus_map"]
    link: ModbusUrl
    unit_id: UnitId = 1
    timeout_s: Timeout = 0.2
    preset: str = ""  # a file of firmware_iface/presets that gives defaults for the keys below
    function: Literal["holding", "input"] | None = None
    type: Literal["u16", "i16", "u32", "i32", "f32"] | None = None
    word_order: Literal["big", "little"] | None = None
    address: Word
    raw: tuple[float, float] | None = None
    value: tuple[float, float]
    limits: tuple[float, float] | None = None  # values outside are refused; by default the span of `value`
    identity_address: Word | None = None
    identity_equals: Word | None = None

    @model_validator(mode="after")
    def _line(self) -> "ModbusMapConfig":
        for name, pair in (("raw", self.raw), ("value", self.value)):
            if pair is not None and pair[0] == pair[1]:
                raise ValueError(f"{name} needs two different numbers")
        if self.limits is not None and self.limits[0] >= self.limits[1]:
            raise ValueError("limits needs two numbers, the lower one first")
        return self


Driver = Field(discriminator="driver")
DisplacementDriver = Annotated[Optoncdt1420Config | KeyenceDlRs1aConfig | ModbusMapConfig, Driver]
PumpDriver = Annotated[BronkhorstModbusConfig | BronkhorstProparConfig | VentusConfig | ModbusMapConfig, Driver]
PressureDriver = Annotated[BronkhorstModbusConfig | BronkhorstProparConfig | ModbusMapConfig, Driver]
BarometerDriver = Annotated[VaisalaPtb330Config | ModbusMapConfig, Driver]
ON_MODBUS = (BronkhorstModbusConfig, ModbusMapConfig)  # have a `link`, the others a `port`
AnyDriver = DisplacementDriver | PumpDriver | PressureDriver | BarometerDriver


class AravisCameraConfig(Section):
    """A GenICam camera (USB3 Vision or GigE Vision)."""

    driver: Literal["aravis"] = "aravis"
    camera: str = ""  # as listed by `devices`, or its address; empty: the first one found
    # Bayer needs no demosaicing: each pixel's phase is independent of its gain
    pixel_format: Literal["Mono8", "Mono10", "Mono12", "Mono16", "BayerRG8", "BayerGR8", "BayerGB8", "BayerBG8"] = (
        "Mono8"
    )
    exposure_ms: Annotated[float, Field(gt=0, le=10_000)] = 20.0
    gain_db: Annotated[float, Field(ge=0, le=48)] = 0.0
    packet_bytes: Annotated[int, Field(ge=0, le=65_000)] = 0  # GigE Vision; 0: negotiated by camera and network
    timeout_s: Annotated[float, Field(gt=0, le=60)] = 1.0  # for a frame, from the end of its exposure

    @property
    def bits(self) -> int:
        """Depth of a pixel."""
        return int(self.pixel_format[-2:]) if self.pixel_format[-2:].isdigit() else 8


class UvcCameraConfig(Section):
    """A USB camera without GenICam."""

    driver: Literal["uvc"] = "uvc"
    port: str = "0"  # its number, or its path such as /dev/video0 (better: below /dev/v4l/by-id)
    exposure: Annotated[float, Field(ge=0)] = 0.0  # in the camera's own unit, often 0.1 ms; 0 leaves it
    gain: Annotated[float, Field(ge=0)] = 0.0  # in the camera's own unit; 0 leaves it
    bits: Literal[8] = 8


class FolderCameraConfig(Section):
    """Pictures from a folder instead of a camera and a screen."""

    driver: Literal["folder"]
    folder: Annotated[str, Field(min_length=1)]


class PygameScreenConfig(Section):
    """The display with the fringes."""

    driver: Literal["pygame"] = "pygame"
    display: Annotated[int, Field(ge=0, le=15)] = 0
    width_px: Annotated[int, Field(ge=16, le=16_384)]
    height_px: Annotated[int, Field(ge=16, le=16_384)]
    pixel_mm: Annotated[float, Field(gt=0.01, le=10)]
    centre_px: tuple[float, float] | None = None  # (column, row) of O'; the screen's middle when absent
    settle_ms: Annotated[float, Field(ge=0, le=5000)] | None = None  # measured at the start when absent
    linearise: bool = True  # measure the display's response at the start and correct it
    self_test: bool = True  # exposure and checkerboard at the start


CameraConfig = Annotated[AravisCameraConfig | UvcCameraConfig | FolderCameraConfig, Field(discriminator="driver")]
