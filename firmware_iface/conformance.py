"""Tests whether a board does what a pump board must, over its own protocol and without touching
anything else.

docs/reference/firmware.md explains the requirements; each check names its section. The pump is
briefly commanded to a few per cent: do not run it on a mirror that must not move.
"""

import contextlib
import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial

from firmware_iface import board_under_test, register_map, roles
from firmware_iface.board_under_test import PERIOD_S, PUMP_FRACTION, REST_S, other_key
from firmware_iface.links.modbus_rtu import ModbusLinks
from firmware_iface.requirement import ConformanceError, require

_GRACE_S = 0.1  # the board's own loop and one wake-up after the period
_NEAR = 0.002  # of a fraction: counts of a board that rounds its output
_FEED_S = 0.2  # between two commands where a check keeps the pump commanded for long
_UNDISTURBED_S = 1.0

# its name, the section of docs/reference/firmware.md, the check
_Check = tuple[str, str, Callable[[], Awaitable[None]]]


@dataclass(frozen=True, slots=True)
class CheckResult:
    """The result of one check: `problem` is empty if it passed, else the board's violation."""

    check: str
    section: str
    problem: str


class Conformance(board_under_test.BoardUnderTest):
    """The checks, in order."""

    async def run(self) -> list[CheckResult]:
        """Run all checks; the first decides whether the others are meaningful.

        Raises LinkDownError (the board went away), DeviceBusyError (another program holds it).
        """
        findings = [await self._make_check("identity", "Registers", self._check_identity)]
        if findings[0].problem:
            return findings
        # the check of the watchdog reports a failure to arm it
        with contextlib.suppress(roles.DeviceRefusedError):
            await self._arm_watchdog(REST_S)
        await self._bring_to_rest()
        checks, not_run = await self._possible_checks()
        for check, section, test in checks:
            findings.append(await self._make_check(check, section, partial(self._run_armed, test)))
            await self._bring_to_rest()
        if not_run:
            findings.append(
                CheckResult("all other requirements", "The conformance test", f"not run: {not_run}")
            )
        return findings

    async def _possible_checks(self) -> tuple[list[_Check], str]:
        """Return the checks that the board's inputs allow now, and why the others cannot be run.

        An open interlock or a missing gauge keeps the pump off, so that only the board's reaction
        to it is tested.
        """
        if not self._guards:
            return self._list_checks(), ""
        sensors = await self._read_sensors()
        open_inputs = self._interlocks_fitted & ~int(sensors["interlock_inputs"])
        if open_inputs:
            return (
                self._interlock_checks(),
                f"interlock inputs {open_inputs:#x} are open; close them and run it again",
            )
        if self._gauge_fitted and math.isnan(sensors["gauge_pressure_pa"]):
            return (
                self._gauge_checks(),
                "the fitted gauge has no value; connect it and run it again",
            )
        return self._list_checks(), ""

    async def _run_armed(self, test: Callable[[], Awaitable[None]]) -> None:
        await self._arm_watchdog(REST_S)
        await test()

    async def _make_check(
        self, check: str, section: str, test: Callable[[], Awaitable[None]]
    ) -> CheckResult:
        problem = ""
        try:
            await test()
        except ConformanceError as error:
            problem = str(error)
        except roles.LinkDownError:
            raise
        except roles.LinkError as error:
            problem = f"no valid answer: {error}"
        return CheckResult(check, section, problem)

    def _list_checks(self) -> list[_Check]:
        checks: list[_Check] = [
            ("every block is read whole", "Registers", self._check_blocks),
            ("samples advance", "Timing", self._check_sample_counter),
            ("a command is carried out and read back", "Commands", self._check_commands),
            ("values outside the limits are refused", "Commands", self._check_limits),
            ("a refused write changes nothing", "Commands", self._check_atomic_writes),
            ("read-only and unknown registers are refused", "Registers", self._read_only),
            ("settings are read back as written", "Watchdog", self._check_settings),
            ("disarming is refused while the pump is commanded", "Watchdog", self._check_disarming),
            ("a silent host stops the pump", "Watchdog", self._check_silence),
            ("the same heartbeat does not feed", "Watchdog", self._check_stuck_heartbeat),
            ("half a command does not feed", "Watchdog", self._check_partial_command),
            ("a latched fault keeps the pump off", "States", self._check_latched_trip),
            ("clearing sets the pump to 0", "States", self._check_clearing),
        ]
        if not self._claims:
            return checks
        checks += [
            (
                "the claim and the period are shown, the key is not",
                "Claim",
                self._check_shown_claim,
            ),
            ("another claim is refused", "Claim", self._check_second_program),
            ("no other program commands, clears or disarms", "Claim", self._check_stop_by_others),
            ("the same claim may be made again", "Claim", self._check_second_claim),
            ("the claim lapses with the watchdog", "Claim", self._check_lapsed_claim),
            ("without a claim nothing is commanded", "Claim", self._check_without_claim),
            ("any program may stop the pump", "Stop", self._check_stop),
        ]
        if self._guards:
            checks.append(
                (
                    "a gauge with a value and closed interlocks let the pump run",
                    "Gauge",
                    self._check_undisturbed_run,
                )
            )
        return checks

    def _gauge_checks(self) -> list[_Check]:
        return [
            ("every block is read whole", "Registers", self._check_blocks),
            ("without a gauge the pump is off after the time-out", "Gauge", self._without_gauge),
            (
                "clearing does not run the pump without a gauge",
                "Gauge",
                self._cleared_without_gauge,
            ),
        ]

    def _interlock_checks(self) -> list[_Check]:
        return [
            ("every block is read whole", "Registers", self._check_blocks),
            ("an open interlock keeps the pump off", "Interlocks", self._open_interlock),
            (
                "clearing does not run the pump with an open interlock",
                "Interlocks",
                self._cleared_interlock,
            ),
        ]

    async def _check_identity(self) -> None:
        # these two never move; the other registers follow from them
        kind, version = await self._link.read_holding(self._registers.block("identity").address, 2)
        wanted = self._registers.device_kind
        require(kind == wanted, f"device kind is {kind}, expected {wanted}")
        known = ", ".join(str(known) for known in register_map.list_known_maps())
        require(
            version in register_map.list_known_maps(),
            f"map version is {version}, this test knows {known}",
        )
        self._registers = register_map.list_known_maps()[version]
        found = await self._read_block(self._registers.block("identity"))
        require(found["gauge_pressure_limit_pa"] > 0, "gauge_pressure_limit_pa is not above 0")
        require(0 < found["pump_limit_fraction"] <= 1, "pump_limit_fraction is not within 0..1")
        if self._guards:
            self._note_protections(found)
        self._heartbeat = int((await self._read_sensors())["heartbeat_echo"])

    def _note_protections(self, identity: dict[str, float]) -> None:
        """Take over which protections are fitted, and check that their times are possible."""
        fitted, timeout_s, frozen_s = (
            identity[f"gauge_{name}"] for name in ("fitted", "timeout_s", "frozen_s")
        )
        require(fitted in (0, 1), f"gauge_fitted is {fitted:g}, expected 0 or 1")
        require(0.1 <= timeout_s <= 60, f"gauge_timeout_s is {timeout_s:g}, expected 0.1..60")
        require(
            frozen_s == 0 or 1 <= frozen_s <= 600,
            f"gauge_frozen_s is {frozen_s:g}, expected 0 or 1..600",
        )
        self._gauge_fitted = fitted == 1
        self._gauge_timeout_s = timeout_s
        self._interlocks_fitted = int(identity["interlocks_fitted"])

    async def _check_blocks(self) -> None:
        for block in self._registers.blocks:
            await self._read_block(block)

    async def _check_sample_counter(self) -> None:
        before = await self._read_sensors()
        await self._sleep(0.1)
        after = await self._read_sensors()
        require(
            after["sample_counter"] != before["sample_counter"],
            "sample_counter stands still for 0.1 s",
        )
        passed_s = _time_s(after) - _time_s(before)
        require(0.02 < passed_s < 1.0, f"device time went {passed_s:.3f} s in 0.1 s")

    async def _check_commands(self) -> None:
        for pump, vent in ((PUMP_FRACTION, 0.0), (0.0, 0.5), (0.0, 0.0)):
            await self._write_command(pump, vent)
            await self._sleep(_GRACE_S)
            found = await self._read_sensors()
            for name, wanted in (("pump", pump), ("vent", vent)):
                value = found[f"{name}_readback_fraction"]
                require(
                    abs(value - wanted) < _NEAR, f"{name} commanded {wanted:g}, read back {value:g}"
                )
        require(
            int(found["heartbeat_echo"]) == self._heartbeat,
            "heartbeat_echo is not the last heartbeat",
        )

    async def _check_limits(self) -> None:
        """Each value outside its limits, in a block that is right otherwise."""
        right = self._make_command(0.0, 0.0) | {
            "claim_id": self._id,
            "claim_key": self._key,
            "clear_key": self._key,
        }
        right |= {
            "watchdog_period_s": REST_S,
            "watchdog_arm": 1.0,
            "clear_faults": 0.0,
            "stop": 1.0,
        }
        for block in self._registers.blocks:
            for register in block.registers:
                for raw in _words_outside_limits(register):
                    words = block.encode(right)
                    at = register.address - block.address
                    # of two words only 0 is outside
                    words[at : at + register.words] = [raw] * register.words
                    what = f"{register.name} = {raw / register.counts_per_unit:g}"
                    await self._expect_refusal(words, block.address, what, "limits")

    async def _check_atomic_writes(self) -> None:
        await self._write_command(0.0, 0.25)
        block = self._registers.block("command")
        words = block.encode(self._make_command(0.0, 1.0))
        words[0] = 0xFFFF  # a pump command of 1.31
        await self._expect_refusal(
            words, block.address, "a command block with one value of 1.31", "limits"
        )
        found = await self._read_block(block)
        require(
            abs(found["vent_command_fraction"] - 0.25) < _NEAR,
            f"a refused block set the vent to {found['vent_command_fraction']:g}",
        )

    async def _read_only(self) -> None:
        for name in ("identity", "sensors"):
            await self._expect_refusal(
                [0], self._registers.block(name).address, f"a write to {name}", "rights"
            )
        last = max(block.address + block.count for block in self._registers.blocks)
        try:
            await self._link.read_holding(last, 1)
        except roles.DeviceRefusedError:
            return
        raise ConformanceError(f"answers a read of register {last}, which the map does not have")

    async def _check_settings(self) -> None:
        for period_s in (PERIOD_S, 1.5):
            await self._arm_watchdog(period_s)
            found = await self._read_block(self._registers.block("settings"))
            require(found["watchdog_arm"] == 1, "watchdog_arm written 1, read back 0")
            value_s = found["watchdog_period_s"]
            require(
                abs(value_s - period_s) < 1e-3,
                f"watchdog_period_s written {period_s:g}, read back {value_s:g}",
            )
        require(
            (await self._read_sensors())["watchdog_armed"] == 1,
            "watchdog_armed stays 0 after arming",
        )

    async def _check_disarming(self) -> None:
        await self._write_command(PUMP_FRACTION)
        try:
            await self._arm_watchdog(REST_S, 0.0)
        except roles.DeviceRefusedError:
            return
        raise ConformanceError("lets the watchdog be disarmed while the pump is commanded")

    async def _check_silence(self) -> None:
        await self._arm_watchdog()
        await self._write_command(PUMP_FRACTION)
        await self._sleep(PERIOD_S / 2)
        found = await self._read_sensors()
        require(
            found["pump_readback_fraction"] > 0, "stops the pump before the watchdog period is over"
        )
        await self._sleep(PERIOD_S / 2 + _GRACE_S)
        await self._expect_trip("a host silent for longer than the watchdog period")

    async def _check_stuck_heartbeat(self) -> None:
        await self._arm_watchdog()
        await self._write_command(PUMP_FRACTION)
        for _ in range(4):
            await self._sleep((PERIOD_S + _GRACE_S) / 4)
            await self._write_command(PUMP_FRACTION, fresh=False)
        await self._expect_trip("writes that repeat one heartbeat")

    async def _check_partial_command(self) -> None:
        await self._arm_watchdog()
        await self._write_command(PUMP_FRACTION)
        pump = self._registers.register("pump_command_fraction")
        for _ in range(4):
            await self._sleep((PERIOD_S + _GRACE_S) / 4)
            try:
                await self._link.write_registers(
                    pump.address, [round(PUMP_FRACTION * pump.counts_per_unit)]
                )
            except roles.DeviceRefusedError:
                continue  # as a board with claims has to
            require(not self._claims, "accepts a part of the command block, which carries no claim")
        await self._expect_trip("writes of the pump command alone")

    async def _check_latched_trip(self) -> None:
        await self._arm_watchdog()
        await self._write_command(PUMP_FRACTION)
        await self._sleep(PERIOD_S + _GRACE_S)
        await self._write_command(PUMP_FRACTION)
        await self._sleep(_GRACE_S)
        value = (await self._read_sensors())["pump_readback_fraction"]
        require(value == 0, f"runs the pump at {value:g} while a fault is latched")

    async def _check_clearing(self) -> None:
        await self._arm_watchdog()
        await self._write_command(PUMP_FRACTION)
        await self._sleep(PERIOD_S + _GRACE_S)
        await self._write_command(PUMP_FRACTION)
        await self._clear_faults()
        found = await self._read_sensors()
        require(
            found["latched_faults"] == 0,
            f"faults stay {found['latched_faults']:g} after they were cleared",
        )
        value = found["pump_readback_fraction"]
        require(value == 0, f"starts the pump at {value:g} when faults are cleared")

    async def _check_shown_claim(self) -> None:
        await self._arm_watchdog(1.5)
        found = await self._read_sensors()
        claim = int(found["claim_in_force"])
        period_s = found["period_in_force_s"]
        require(claim == self._id, f"claimed as {self._id:#x}, claim_in_force reads {claim:#x}")
        require(
            abs(period_s - 1.5) < 1e-3,
            f"watchdog period set to 1.5 s, period_in_force_s reads {period_s:g}",
        )
        for name, key in (
            ("settings", "claim_key"),
            ("command", "command_key"),
            ("reset", "clear_key"),
        ):
            require(
                (await self._read_block(self._registers.block(name)))[key] == 0,
                f"{key} can be read",
            )

    async def _check_second_program(self) -> None:
        await self._write_command(PUMP_FRACTION)
        await self._expect_busy(
            self._claim_as_other(other_key(self._key)), "a second claim while the watchdog is fed"
        )
        found = await self._read_sensors()
        require(found["period_in_force_s"] == REST_S, "a refused claim changed the watchdog period")
        require(int(found["claim_in_force"]) == self._id, "a refused claim changed the claim")

    async def _check_stop_by_others(self) -> None:
        await self._write_block("stop", {"stop": 1.0})
        # the low word, and the high word
        for key in (
            self._key ^ 1 or 2,
            self._key ^ (1 << 31) or 2,
        ):
            self._heartbeat = (self._heartbeat + 1) % 2**16
            other = "with another key than the claim's"
            await self._expect_busy(
                self._write_block("command", self._make_command(PUMP_FRACTION, 1.0, key)),
                f"a command {other}",
            )
            await self._expect_busy(self._clear_faults(key), f"clear_faults {other}")
            await self._expect_busy(self._claim_as_other(key, arm=0.0), f"disarming {other}")
        found = await self._read_sensors()
        require(int(found["latched_faults"]) != 0, "a refused clear_faults cleared")
        require(found["vent_readback_fraction"] < _NEAR, "a refused command moved the vent")
        require(found["watchdog_armed"] == 1, "a refused write disarmed the watchdog")

    async def _check_second_claim(self) -> None:
        await self._arm_watchdog()
        await self._write_command(PUMP_FRACTION)
        for _ in range(4):
            await self._sleep((PERIOD_S + _GRACE_S) / 4)
            await self._arm_watchdog()
        await self._expect_trip("claims that are made again, which do not feed")

    async def _check_lapsed_claim(self) -> None:
        await self._arm_watchdog()
        await self._write_command(PUMP_FRACTION)
        await self._sleep(PERIOD_S + _GRACE_S)
        theirs = other_key(self._key)
        await self._claim_as_other(theirs, PERIOD_S)
        await self._expect_busy(
            self._write_block("command", self._make_command(PUMP_FRACTION, 0.0)),
            "a command of a claim that lapsed",
        )
        await self._sleep(PERIOD_S + _GRACE_S)
        await self._arm_watchdog(REST_S)

    async def _check_without_claim(self) -> None:
        await self._arm_watchdog(REST_S, 0.0)
        require(
            (await self._read_sensors())["claim_in_force"] == 0,
            "keeps the claim when it is disarmed",
        )
        self._heartbeat = (self._heartbeat + 1) % 2**16
        for name, values in (
            ("command", self._make_command(PUMP_FRACTION, 0.0)),
            ("reset", {"clear_faults": 0xFFFF, "clear_key": self._key}),
        ):
            block = self._registers.block(name)
            await self._expect_refusal(
                block.encode(values), block.address, f"a write to {name} without a claim", "rights"
            )

    async def _check_stop(self) -> None:
        await self._write_command(PUMP_FRACTION, 0.25)
        await self._write_block("stop", {"stop": 1.0})
        await self._write_command(PUMP_FRACTION, 0.25)
        found = await self._read_sensors()
        value = found["pump_readback_fraction"]
        mask = self._registers.make_fault_mask("stopped")
        require(value == 0, f"runs the pump at {value:g} after stop")
        require(abs(found["vent_readback_fraction"] - 0.25) < _NEAR, "moves the vent at stop")
        require(bool(int(found["latched_faults"]) & mask), "does not latch the fault `stopped`")

    async def _check_undisturbed_run(self) -> None:
        await self._write_for(_UNDISTURBED_S, PUMP_FRACTION)
        found = await self._read_sensors()
        latched = int(found["latched_faults"])
        require(not latched, f"latches the faults {latched:#x} without a cause")
        require(found["pump_readback_fraction"] > 0, "stops the pump without a cause")

    async def _without_gauge(self) -> None:
        await self._write_for(self._gauge_timeout_s + _GRACE_S, PUMP_FRACTION, 0.25)
        await self._kept_off("gauge_lost", f"{self._gauge_timeout_s:g} s without a gauge")

    async def _cleared_without_gauge(self) -> None:
        """By now the gauge has been missing for longer than its time-out."""
        for when in ("a command without a gauge", "clearing without a gauge"):
            await self._write_for(_GRACE_S, PUMP_FRACTION, 0.25)
            await self._kept_off("gauge_lost", when)
            await self._clear_faults()

    async def _open_interlock(self) -> None:
        await self._write_for(_GRACE_S, PUMP_FRACTION, 0.25)
        await self._kept_off("interlock", "a command with an open interlock")

    async def _cleared_interlock(self) -> None:
        await self._clear_faults()
        await self._write_for(_GRACE_S, PUMP_FRACTION, 0.25)
        await self._kept_off("interlock", "clearing with an open interlock")

    async def _write_for(self, duration_s: float, pump: float, vent: float = 0.0) -> None:
        """Keep commanding the outputs for a time, and feed the watchdog."""
        steps = math.ceil(duration_s / _FEED_S)
        for _ in range(steps):
            await self._write_command(pump, vent)
            await self._sleep(duration_s / steps)

    async def _kept_off(self, fault: str, after: str) -> None:
        """Require that this fault is latched, the pump off and the vent where it was commanded."""
        found = await self._read_sensors()
        value = found["pump_readback_fraction"]
        require(value == 0, f"runs the pump at {value:g} after {after}")
        latched = int(found["latched_faults"]) & self._registers.make_fault_mask(fault)
        require(bool(latched), f"does not latch the fault `{fault}` after {after}")
        require(
            abs(found["vent_readback_fraction"] - 0.25) < _NEAR, f"moves the vent after {after}"
        )


def _time_s(values: dict[str, float]) -> float:
    return values["device_time_s"] + values["device_time_fraction_s"]


def _words_outside_limits(register: register_map.Register) -> list[int]:
    """Words just outside a register's limits, where the type has such; of a claim only 0 is."""
    if register.access != "rw" or math.isinf(register.maximum):
        return []
    if register.words != 1:
        return [0]
    low, high = (
        round(limit * register.counts_per_unit) for limit in (register.minimum, register.maximum)
    )
    return [
        raw for raw in (low - 1, high + 1, 0xFFFF) if 0 <= raw <= 0xFFFF and not low <= raw <= high
    ]


async def examine(url: str, unit_id: int = 1, timeout_s: float = 0.5) -> list[CheckResult]:
    """Examine the board at a Modbus URL.

    Parameters
    ----------
    url : str
        Of the board.
    unit_id : int
        Modbus unit.
    timeout_s : float
        Of one exchange.

    Returns
    -------
    list of CheckResult
        All findings.

    Raises
    ------
    LinkError
        The board is absent, or another program holds it.
    ValueError
        The URL is wrong.
    """
    link = ModbusLinks().link(url, unit_id, timeout_s)
    await link.connect()
    try:
        return await Conformance(link).run()
    except roles.DeviceBusyError as error:
        raise roles.DeviceBusyError(
            f"{error}: another program holds the board; stop that one first"
        ) from None
    finally:
        await link.close()
