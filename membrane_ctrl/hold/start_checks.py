"""Checks before a hold creates anything: devices, latched faults, locks, interlocks."""

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from firmware_iface.roles import ALL_FAULTS, Bench, BenchReading, LinkError
from firmware_iface.settings import GpioLineConfig
from membrane_ctrl.config.schema import Config, DevicesConfig
from membrane_ctrl.controller import cross_check, interlocks, safe_levels
from membrane_ctrl.hold.hold_options import HoldOptions
from membrane_ctrl.hold.lock_keeper import LockStorage
from membrane_ctrl.instruments.bench import make_bench, require_separate_ports
from membrane_ctrl.instruments.bench_connection import connect_bench
from membrane_ctrl.instruments.lock_keys import list_device_keys
from membrane_ctrl.instruments.lock_store import LockStore, require_unlocked
from membrane_ctrl.model import errors, telemetry
from membrane_ctrl.run_files import latched_fault

_UNLOCKS = (
    "start with --standby, then `membrane-ctrl ctl unlock WORD`; or `membrane-ctrl locks remove "
    "WORD`"
)


def require_possible(devices: DevicesConfig, lab: bool) -> None:
    """End with InputError for impossible settings, before anything is started.

    Parameters
    ----------
    devices : DevicesConfig
        The devices of the configuration; none is opened.
    lab : bool
        An emulated lab stands for lines of GPIO by a Modbus module, so that it needs no package for
        GPIO.
    """
    gpio = tuple(found for found in devices.interlocks if isinstance(found, GpioLineConfig))
    emulated = (
        tuple(found for found in devices.interlocks if found not in gpio)
        if lab
        else devices.interlocks
    )
    require_separate_ports(devices)
    make_bench(devices.model_copy(update={"interlocks": emulated}))


def open_latched_fault(
    config: Config, logs_dir: Path, options: HoldOptions
) -> latched_fault.LatchedFile | None:
    """Open the file of a latched fault, which outlives a run.

    Parameters
    ----------
    config : Config
        Whether the twin latches faults (`states.latch_twin_faults`).
    logs_dir : path
        Folder of the runs, which has the file: a bench has one.
    options : HoldOptions
        `--standby`, `--clear-faults`, and whether the bench is simulated.

    Returns
    -------
    LatchedFile or None
        The twin has one only if configured.

    Raises
    ------
    DeviceError
        If a fault is latched, unless it is to be cleared or the run starts in standby.
    """
    if options.twin and not config.states.latch_twin_faults:
        return None
    file = latched_fault.LatchedFile(logs_dir)
    fault = file.read()
    if fault is not None and options.clear_faults:
        try:
            file.clear()
        except OSError as error:
            reason = errors.os_reason(error)
            raise errors.DeviceError(
                f"{file.path}: cannot be cleared ({reason}); remove it by hand"
            ) from None
    elif fault is not None and not options.standby:
        raise errors.DeviceError(
            f"a fault is latched: {fault}; {fault.remedy}, then start with --clear-faults"
        )
    return file


def find_locks(config: Config, options: HoldOptions) -> LockStorage | None:
    """Find where the run keeps its locks, with those that are set.

    Parameters
    ----------
    config : Config
        Its devices are what a lock belongs to.
    options : HoldOptions
        `--standby`, and whether the bench is simulated.

    Returns
    -------
    LockStorage or None
        The twin keeps them only if configured.

    Raises
    ------
    DeviceError
        If there are any, unless the run starts in standby, where a person can remove them.
    """
    if options.twin and not config.states.latch_twin_faults:
        return None
    assert config.devices is not None
    store = LockStore.of_machine()
    # the twin's own port may be another one at each start
    devices = (
        frozenset({f"twin port {options.config.twin.port}"})
        if options.twin
        else list_device_keys(config.devices)
    )
    if not options.standby:
        require_unlocked(store, devices, _UNLOCKS)
    return LockStorage(store, devices, tuple(store.find_locks(devices)))


@dataclass(frozen=True, slots=True)
class BoardAtStart:
    """Faults that the board itself had latched before this run."""

    latched: str = ""  # still latched, as the run starts in standby
    cleared: str = ""  # cleared under the resume rule


async def identify_board(
    bench: Bench,
    config: Config,
    options: HoldOptions,
    resumes: latched_fault.ResumeLog | None = None,
) -> BoardAtStart:
    """Identify the devices and check their fitness before making a run folder.

    Parameters
    ----------
    bench : Bench
        Not yet connected; it is closed again.
    config : Config
        What the devices are judged by: limits and ranges, interlocks, resume rule.
    options : HoldOptions
        `--standby`, `--clear-faults`, and the name of the file for messages.
    resumes : ResumeLog or None
        Restarts by the resume rule so far.

    Raises
    ------
    DeviceError
        A device does not answer, is in use or another one; an interlock is open, or the board has
        latched a fault, unless the run starts in standby.
    InputError
        The configuration does not fit the devices: a limit that can never trip, for example.
    """
    devices = config.devices
    assert devices is not None
    try:
        identity = await connect_bench(bench, devices)
        cross_check.require_sound(config, options.source, identity)
        if options.clear_faults:
            await bench.clear_faults(ALL_FAULTS)
        # A closed interlock circuit and no latched fault: the hold may start
        reading = await bench.read()
        if not options.standby:
            _require_closed(config, reading)
        faults = reading.latched_faults
        if not faults:
            return BoardAtStart()
        what = (
            f"{devices.name}: the board has latched faults {faults:#x} "
            "(docs/reference/registers.md)"
        )
        # the last controller was killed, and nothing else happened if no other fault is latched and
        # it was not vented
        vented = reading.vent_fraction > safe_levels.VENTED_FRACTION
        if (
            faults == safe_levels.WATCHDOG_MASK
            and not vented
            and _may_resume("watchdog_tripped", config, resumes)
            and not config.states.observe
        ):
            await bench.clear_faults(safe_levels.WATCHDOG_MASK)
            return BoardAtStart(
                cleared="its watchdog had stopped the pump; cleared under resume.faults"
            )
    except LinkError as error:
        raise errors.DeviceError(f"{devices.name}: {error}") from None
    finally:
        await bench.close()
    if not options.standby:
        raise errors.DeviceError(f"{what}; find the cause, then start with --clear-faults")
    return BoardAtStart(latched=what)


def _require_closed(config: Config, reading: BenchReading) -> None:
    """Refuse a start that would hold the mirror while an interlock is open. Raises DeviceError."""
    circuits = interlocks.Interlocks(config.interlocks)
    circuits.observe_reading(reading, telemetry.State.STANDBY)
    if circuits.open_mask:
        raise errors.DeviceError(
            f"{circuits.describe_open(circuits.open_mask)}; close it, or start with "
            "--standby and hold later"
        )


def _may_resume(name: str, config: Config, resumes: latched_fault.ResumeLog | None) -> bool:
    """Apply the resume rule at a start; a resume that cannot be counted is not allowed."""
    if name not in config.resume.faults:
        return False
    if resumes is None:
        return True  # the twin, which keeps no latch
    now = datetime.now(UTC)
    if len(resumes.ages_s(now)) >= config.resume.most_per_day:
        return False
    try:
        resumes.add_resume(now)
    except OSError:
        return False
    return True
