"""Step 3: each sensor, actuator and protection is tried, without gas in the mirror.

The pump runs only while the bench is open, with the vent open and every interlock closed, and never
while a question waits.
"""

import math
from typing import TypeVar

import numpy as np

from firmware_iface import roles
from firmware_iface.settings import InterlockDriver
from membrane_ctrl.commissioning.guide import thresholds
from membrane_ctrl.commissioning.guide.bench_access import (
    Action,
    HandAct,
    HandMotion,
    OpenBench,
)
from membrane_ctrl.commissioning.guide.good_readings import average_good, select_good
from membrane_ctrl.commissioning.guide.mirror_design import derive_design
from membrane_ctrl.commissioning.guide.session_state import SessionState, TomlTable
from membrane_ctrl.commissioning.guide.stage import (
    StageContext,
    StageFailedError,
)

PUMP_FRACTION = 0.35  # above the start threshold of a diaphragm pump
_RUN_S = 3.0
_PERIOD_S = 0.1  # of commands and readings: well below a watchdog's period
_STOPPED_S = 1.0
_READ_S = 3.0
_CABLE_S = 30.0  # for a person to pull it
_PUSH_S = 15.0  # for a person to push the emergency stop
_CARD_MM = 5.0
T = TypeVar("T")
_OFF = roles.BenchCommand(0.0, 0.0)
_VENTED = roles.BenchCommand(0.0, 1.0)


async def read_for(opened: OpenBench, duration_s: float) -> list[roles.BenchReading]:
    """Read every 0.1 s, with pump and vent commanded off.

    Parameters
    ----------
    opened : OpenBench
        The bench; its `sleep` decides whether time is real.
    duration_s : float
        Of the whole.
    """
    readings = []
    for _ in range(round(duration_s / _PERIOD_S)):
        await opened.bench.write(_OFF)
        readings.append(await opened.bench.read())
        await opened.sleep(_PERIOD_S)
    return readings


def stop_at_open_circuit(
    reading: roles.BenchReading, interlocks: tuple[InterlockDriver, ...]
) -> None:
    """Raise StageFailedError if a reading shows the circuit of an interlock open.

    Parameters
    ----------
    reading : BenchReading
        Bit i of its `interlocks_open` belongs to interlock i.
    interlocks : tuple of InterlockDriver
        In the order of the configuration.
    """
    words = [
        f"{interlock.name} is open: {interlock.text}"
        for bit, interlock in enumerate(interlocks)
        if reading.interlocks_open >> bit & 1
    ]
    if words:
        raise StageFailedError(
            f"interlock {'; '.join(words)}. The pump is off. Close the circuit, then run this "
            "stage again"
        )


async def wait_for_circuits(opened: OpenBench, interlocks: tuple[InterlockDriver, ...]) -> None:
    """Wait until all circuits are closed, a second at most.

    A circuit counts as open until its source has answered once, so the first reading after opening
    the bench shows nothing yet.

    Parameters
    ----------
    opened : OpenBench
        The bench.
    interlocks : tuple of InterlockDriver
        In the order of the configuration, for the message.

    Raises
    ------
    StageFailedError
        A circuit is still open.
    """
    reading = await opened.bench.read()
    for _ in range(round(_STOPPED_S / _PERIOD_S)):
        if not reading.interlocks_open:
            return
        await opened.sleep(_PERIOD_S)
        reading = await opened.bench.read()
    stop_at_open_circuit(reading, interlocks)


async def run_outputs(
    opened: OpenBench,
    command: roles.BenchCommand,
    duration_s: float,
    gauge_most_pa: float,
    interlocks: tuple[InterlockDriver, ...] = (),
) -> list[roles.BenchReading]:
    """Keep pump and vent commanded, then switch the pump off.

    Parameters
    ----------
    opened : OpenBench
        The bench.
    command : BenchCommand
        Of pump and vent.
    duration_s : float
        For so long.
    gauge_most_pa : float
        Highest pressure.
    interlocks : tuple of InterlockDriver
        Must stay closed meanwhile.

    Returns
    -------
    list of BenchReading
        The readings meanwhile.

    Raises
    ------
    StageFailedError
        The pressure rises beyond it, or one of the interlocks opens; the pump is then off and the
        vent open.
    """
    readings: list[roles.BenchReading] = []
    if interlocks:
        await wait_for_circuits(opened, interlocks)
    try:
        for _ in range(round(duration_s / _PERIOD_S)):
            await opened.bench.write(command)
            await opened.sleep(_PERIOD_S)
            readings.append(await opened.bench.read())
            stop_at_open_circuit(readings[-1], interlocks)
            if not readings[-1].gauge_pressure_pa < gauge_most_pa:
                raise StageFailedError(
                    f"the gauge shows {readings[-1].gauge_pressure_pa:.0f} Pa with the vent open, "
                    f"the limit is {gauge_most_pa:.0f} Pa: the pump is off, the vent open"
                )
    finally:
        await opened.bench.write(_VENTED)
    return readings


def probe_devices(context: StageContext) -> None:
    """Probe each device as `check` does, without writing to it."""
    for probe in context.access.probe_devices(context.config):
        seen = probe.problem or f"{probe.identity}: {probe.reading}"
        remedy = probe.notes
        if probe.role == "displacement":
            remedy = (
                f"if aim and cable are right: the flat film is {context.facts.sag_mm:g} mm from "
                "displacement 0. Set `zero_mm` of its table so that its range covers the way"
            )
        context.require(f"{probe.role} on {probe.device}", not probe.problem, seen, remedy)
    if context.access.simulated and context.devices.board is None:
        context.note("the next stages", "they run on an emulated pump board, not on instruments")


def test_gauge_zero(context: StageContext) -> None:
    """Read the gauge of the vented mirror."""
    context.dialogue.wait("gauge_zero", "Vent the mirror, shut the gas supply")
    readings = _act(context, lambda opened: read_for(opened, _READ_S))
    gauge_pa = np.array(select_good([each.gauge_pressure_pa for each in readings], "gauge"))
    context.judge(
        "gauge reading of the vented mirror",
        abs(float(np.mean(gauge_pa))),
        thresholds.GAUGE_ZERO,
        "zero the gauge as its manual states, with both its ports open to the room",
    )
    context.judge(
        "standard deviation of the vented gauge",
        float(np.std(gauge_pa)),
        thresholds.GAUGE_NOISE,
        "look for air that moves at its ports, and for its filter setting",
    )
    is_alive = float(np.ptp(gauge_pa)) > 0.0
    context.require("the gauge's last digit moves", is_alive, "yes" if is_alive else "never")


def test_gauge_sign(context: StageContext) -> None:
    """See the gauge rise under a hand."""
    before_pa = _mean(context, "gauge_pressure_pa")
    context.dialogue.wait(
        "gauge_sign", "Shut the vent by hand if you can; press one of the films gently"
    )
    context.access.move_hand(HandMotion(HandAct.PRESS_FILM))
    pressed_pa = _mean(context, "gauge_pressure_pa")
    context.access.move_hand(HandMotion(HandAct.RELEASE_FILM))
    context.judge(
        "rise of the gauge under a hand",
        pressed_pa - before_pa,
        thresholds.GAUGE_RISE,
        "if it falls, exchange the gauge's ports; if it stays, look for a hose that is off",
    )


def test_laser(context: StageContext) -> None:
    """Move a card before the laser: sign and scale."""
    dialogue = context.dialogue
    dialogue.show(
        "  Hold a white card where the film's centre is, in the laser's beam. A deeper bowl moves",
        "  the film away from its flat place: that way counts as up.",
    )
    dialogue.wait("laser_card", "Hold the card still")
    before_um = _mean(context, "displacement_um")
    moved_mm = dialogue.ask_number(
        "laser_mm", "Move it that way, and type by how much", _CARD_MM, 0.5, 100.0, "mm"
    )
    context.access.move_hand(HandMotion(HandAct.MOVE_CARD, distance_um=1e3 * moved_mm))
    after_um = _mean(context, "displacement_um")
    context.access.move_hand(HandMotion(HandAct.REMOVE_CARD))
    if not (math.isfinite(before_um) and math.isfinite(after_um)):
        context.require("laser sees the card", False, "no reading", "check aim and range")
        return
    # Displacement rises when the bowl deepens. The sign is judged first: with the wrong one, the
    # loop would drive the mirror away, and the scale means nothing.
    ratio = (after_um - before_um) / (1e3 * moved_mm)
    is_right = context.require(
        "laser's sign",
        ratio > 0,
        f"{after_um - before_um:+.0f} µm for {moved_mm:g} mm",
        "set `direction` of the laser's table to the other sign",
    )
    if is_right:
        context.judge(
            "laser's motion over the card's, difference from 1",
            abs(ratio - 1.0),
            thresholds.LASER_SCALE,
            "check range and unit of the laser's table against its manual",
        )


def test_outputs(context: StageContext) -> None:
    """Run the vent, then the pump with the vent open: read-backs, and what is heard."""
    dialogue = context.dialogue
    limit_pa = _bench_pressure_pa(context)
    interlocks = context.devices.interlocks
    # The vent first: with it open, the pump raises no pressure.
    if context.devices.vent_fitted:
        dialogue.wait("vent_try", "The vent opens for 3 s. Listen")
        seen = _act(context, lambda opened: run_outputs(opened, _VENTED, _RUN_S, limit_pa))
        _judge_readback(context, "vent", [reading.vent_fraction for reading in seen], 1.0)
        heard = dialogue.confirm("vent_heard", "Did the vent open, and shut again?")
        context.require("vent heard", heard, "yes" if heard else "no", "check its wires and power")
        request = f"The pump runs for 3 s at {PUMP_FRACTION:.0%}, the vent is open. Listen"
    else:
        context.leave_out("vent", "none is fitted: only the leak lowers the mirror")
        request = (
            f"Take the pump's hose off the mirror. The pump runs for 3 s at {PUMP_FRACTION:.0%}"
        )
    dialogue.wait("pump_try", request)
    command = roles.BenchCommand(PUMP_FRACTION, 1.0)
    seen = _act(context, lambda opened: run_outputs(opened, command, _RUN_S, limit_pa, interlocks))
    _judge_readback(context, "pump", [reading.pump_fraction for reading in seen], PUMP_FRACTION)
    heard = dialogue.confirm("pump_heard", "Did the pump start, and stop again?")
    context.require("pump heard", heard, "yes" if heard else "no", "check its wires and power")


def test_watchdog(context: StageContext) -> None:
    """Stop commanding a running pump: the watchdog must stop it."""
    context.dialogue.wait("watchdog", "The pump runs, and the program stops commanding it. Listen")
    interlocks = context.devices.interlocks
    late_s = _act(context, lambda opened: _time_watchdog(opened, interlocks))
    context.judge(
        "pump off after the last command, beyond the watchdog's period",
        late_s,
        thresholds.WATCHDOG_LATE,
        "do not use this board or pump: run `membrane-ctrl conformance`",
    )
    _clear_trip(context)


async def _time_watchdog(opened: OpenBench, interlocks: tuple[InterlockDriver, ...]) -> float:
    """Time beyond the watchdog's period until the pump's read-back is 0; NaN if it stays on."""
    # Run the pump, then only read: reading does not feed a watchdog, so that it must trip.
    command = roles.BenchCommand(PUMP_FRACTION, 1.0)
    await wait_for_circuits(opened, interlocks)
    for _ in range(round(1.0 / _PERIOD_S)):
        await opened.bench.write(command)
        await opened.sleep(_PERIOD_S)
        stop_at_open_circuit(await opened.bench.read(), interlocks)
    if (await opened.bench.read()).pump_fraction == 0.0:
        raise StageFailedError("the pump does not run: its watchdog cannot be tried")
    began_s = opened.now()
    period_s = opened.identity.watchdog_s
    while opened.now() - began_s < period_s + 2.0:
        await opened.sleep(0.05)
        if (await opened.bench.read()).pump_fraction == 0.0:
            return max(0.0, opened.now() - began_s - period_s)
    return math.nan


def test_cable(context: StageContext) -> None:
    """Pull the cable while the pump runs."""
    dialogue = context.dialogue
    dialogue.wait("cable", "The pump runs, the vent is open. Then pull its data cable")
    is_lost = _act(context, lambda opened: _run_until_lost(context, opened))
    if not is_lost:
        context.access.move_hand(HandMotion(HandAct.PLUG_CABLE))
        raise StageFailedError(f"the link was not lost within {_CABLE_S:g} s; try again")
    stopped = dialogue.confirm("cable_stopped", "Did the pump stop within two seconds?")
    context.require(
        "pump stops when its cable is pulled",
        stopped,
        "yes" if stopped else "it ran on",
        "cut its power now; use a drive that falls to zero without commands, or a pump board",
    )
    dialogue.wait("cable_back", "Plug the cable in again")
    context.access.move_hand(HandMotion(HandAct.PLUG_CABLE))
    reading = _act(context, _read_once)
    context.require(
        "pump off when the cable is back",
        reading.pump_fraction == 0.0,
        f"read-back {reading.pump_fraction:g}",
    )
    _clear_trip(context)


async def _run_until_lost(context: StageContext, opened: OpenBench) -> bool:
    """Keep the pump commanded until the link is lost; False if it never is."""
    command = roles.BenchCommand(PUMP_FRACTION, 1.0)
    interlocks = context.devices.interlocks
    await wait_for_circuits(opened, interlocks)
    try:
        for round_number in range(round(_CABLE_S / _PERIOD_S)):
            await opened.bench.write(command)
            await opened.sleep(_PERIOD_S)
            stop_at_open_circuit(await opened.bench.read(), interlocks)
            if round_number == round(1.0 / _PERIOD_S):
                context.access.move_hand(HandMotion(HandAct.PULL_CABLE))
    except roles.LinkError:
        return True
    return False


async def _read_once(opened: OpenBench) -> roles.BenchReading:
    """A reading before anything is commanded."""
    return await opened.bench.read()


def test_interlocks(context: StageContext) -> None:
    """Open each circuit, and cut its signal off: it, and no other, must be seen open."""
    interlocks = context.devices.interlocks
    if not interlocks:
        context.require(
            "interlocks",
            False,
            "none is configured",
            "wire at least the emergency stop to one (docs/how-to/operations.md, Interlocks)",
        )
        return
    # Four states of each circuit: closed, opened by its contact, without its signal (a cut wire
    # must count as open), closed again. In each, exactly this circuit may be open, which also
    # finds exchanged wires.
    for bit, interlock in enumerate(interlocks):
        name = interlock.name
        _require_mask(context, f"{name} closed", 0)
        context.dialogue.wait(f"open_{name}", f"Open the circuit of {name}")
        context.access.move_hand(HandMotion(HandAct.OPEN_CIRCUIT, name))
        _require_mask(context, f"{name} open", 1 << bit)
        context.access.move_hand(HandMotion(HandAct.CLOSE_CIRCUIT, name))
        context.dialogue.wait(f"lose_{name}", f"Close it. Unplug the signal of {name}")
        context.access.move_hand(HandMotion(HandAct.LOSE_SIGNAL, name))
        _require_mask(context, f"{name} without its signal", 1 << bit)
        context.access.move_hand(HandMotion(HandAct.CLOSE_CIRCUIT, name))
        context.dialogue.wait(f"close_{name}", f"Plug the signal of {name} in again")
        _clear_trip(context)
        _require_mask(context, f"{name} closed again", 0)


def _require_mask(context: StageContext, name: str, wanted: int) -> None:
    """Require that exactly these circuits are open."""
    seen = _act(context, _read_open_mask)
    interlocks = context.devices.interlocks
    names = [each.name for bit, each in enumerate(interlocks) if seen >> bit & 1]
    context.require(
        name,
        seen == wanted,
        f"open: {', '.join(names) or 'none'}",
        "check the wires of this circuit, and its `input`, `address` or `line`",
    )


async def _read_open_mask(opened: OpenBench) -> int:
    """The open circuits, once every source has been asked."""
    await opened.sleep(_STOPPED_S)
    return (await opened.bench.read()).interlocks_open


def test_emergency_stop(context: StageContext) -> None:
    """Push the emergency stop while the pump runs: its hardware must stop the pump."""
    dialogue = context.dialogue
    fitted = dialogue.confirm(
        "stop_fitted", "Is there a switch that cuts the pump's power without any program?"
    )
    if not fitted:
        context.require(
            "emergency stop",
            False,
            "none",
            "fit one: a program is no replacement for hardware that cuts the power",
        )
        return
    dialogue.wait(
        "stop_push", f"The pump runs for {_PUSH_S:g} s, the vent is open. Push the switch"
    )
    command = roles.BenchCommand(PUMP_FRACTION, 1.0)
    limit_pa = _bench_pressure_pa(context)
    try:
        _act(context, lambda opened: run_outputs(opened, command, _PUSH_S, limit_pa))
    except roles.LinkError as error:
        dialogue.show(f"  the link was lost, which is right if the switch cuts it: {error}")
    stopped = dialogue.confirm("stop_stopped", "Did the pump stop at once when you pushed it?")
    context.require(
        "emergency stop", stopped, "stopped" if stopped else "ran on", "check the switch's wires"
    )
    dialogue.wait("stop_released", "Release the switch")
    _clear_trip(context)


def test_relief(context: StageContext) -> None:
    """Judge the relief valve's pressure, and ask whether it was seen to open."""
    design = derive_design(context.facts)
    relief_pa = context.facts.relief_pa
    if relief_pa <= 0.0:
        context.require(
            "relief valve",
            False,
            "none is fitted",
            f"fit one that opens between {design.gauge_max_pa:.0f} and "
            f"{design.relief_most_pa:.0f} Pa: no program can switch it off",
        )
        return
    context.require(
        "relief valve's pressure",
        design.gauge_max_pa < relief_pa < design.relief_most_pa,
        f"{relief_pa:g} Pa, between {design.gauge_max_pa:.0f} and {design.relief_most_pa:.0f} Pa",
        "change the valve, or its spring",
    )
    opened = context.dialogue.confirm(
        "relief_opened",
        f"Was it seen to open at {relief_pa:g} Pa, and to hold the pump's full flow there (a "
        "closed volume in place of the film)?",
    )
    context.require(
        "relief valve opens",
        opened,
        "seen" if opened else "not seen",
        "test it (docs/how-to/operations.md, Relief valve)",
    )


def _clear_trip(context: StageContext) -> None:
    """Clear what a test has made the bench latch."""

    async def clear(opened: OpenBench) -> int:
        await opened.bench.clear_faults(roles.ALL_FAULTS)
        await opened.bench.write(_OFF)
        return (await opened.bench.read()).latched_faults

    latched = _act(context, clear)
    if latched:
        raise StageFailedError(
            f"faults {latched:#x} stay latched (docs/reference/registers.md): their cause is still "
            "there"
        )


def _act(context: StageContext, action: Action[T]) -> T:
    return context.access.act(context.config, action)


def _mean(context: StageContext, name: str) -> float:
    """The mean of a sensor's readings; NaN if most of them are lost."""
    readings = _act(context, lambda opened: read_for(opened, _READ_S))
    try:
        return average_good([getattr(reading, name) for reading in readings], name)
    except StageFailedError:
        return math.nan


def _judge_readback(
    context: StageContext, name: str, fractions: list[float], commanded: float
) -> None:
    """Judge the last read-back of an actuator."""
    context.judge(
        f"{name}: read-back minus command",
        abs(fractions[-1] - commanded),
        thresholds.READBACK,
        f"check the scale of the {name}'s table, and its limits",
    )


def _bench_pressure_pa(context: StageContext) -> float:
    share = thresholds.BENCH_PRESSURE_SHARE.value
    return share * context.config.limits.gauge_pressure_max_pa


def has_laser(state: SessionState, tables: TomlTable) -> bool:
    """Whether a laser is configured: behind a board, or as an instrument.

    Parameters
    ----------
    state : SessionState
        Not used; every stage's `is_needed` gets it.
    tables : TomlTable
        The configuration as it is in the file; empty before it is written.
    """
    devices = tables.get("devices", {})
    return "board" in devices or "displacement" in devices
