"""Findings on the interlocks: sources that react too late, that cannot react, or that the board
does not have.
"""

import math

from firmware_iface.roles import BenchIdentity
from firmware_iface.settings import BoardInputConfig, ModbusInputConfig, PolledInterlockConfig
from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.cross_check_plant import ConfigFindings

_INPUTS_SINCE = 3  # the register map's version
_BLIND_S = 2.0  # how long the pump may run without the signal, as without a control process
_MOMENT_S = 0.2  # a person's push of a button lasts at least this long


def judge_interlocks(config: Config, findings: ConfigFindings) -> None:
    """Judge the sources of the interlocks, and what their safe levels can do on this bench.

    Parameters
    ----------
    config : Config
        Whose `[[devices.interlocks]]` are judged.
    findings : ConfigFindings
        Gets the errors and warnings. The fields have the interlock's index, such as
        `devices.interlocks.0.period_s`.
    """
    for index, interlock in enumerate(config.interlocks):
        field = f"devices.interlocks.{index}"
        if isinstance(interlock, PolledInterlockConfig):
            _check_polled(field, interlock, findings)
        if isinstance(interlock, ModbusInputConfig):
            _check_modbus(field, interlock, config, findings)
        why = (
            "no vent is fitted: an open circuit only stops the pump, and the leak lowers the mirror"
        )
        without_vent = interlock.safe_level == "vent" and not config.vent_fitted
        findings.warn(without_vent, f"{field}.safe_level", why, "fit a vent (devices.vent)")


def _check_polled(field: str, interlock: PolledInterlockConfig, findings: ConfigFindings) -> None:
    """Judge period and age of a source that is asked: neither late answers nor short openings
    count.
    """
    period_s, age_max_s = interlock.period_s, interlock.age_max_s
    slowest_s = period_s + (
        interlock.timeout_s if isinstance(interlock, ModbusInputConfig) else 0.0
    )
    why = (
        f"a source asked every {period_s:g} s may take {slowest_s:g} s to answer: each late "
        "answer would be a fault"
    )
    findings.error(
        slowest_s >= age_max_s, f"{field}.age_max_s", why, f"set more than {slowest_s:g} s"
    )
    why = "the pump would run this long after the signal is lost"
    findings.error(age_max_s > _BLIND_S, f"{field}.age_max_s", why, f"set at most {_BLIND_S:g} s")
    why = (
        f"nothing detects a circuit that opens and closes again within {period_s:g} s, as a "
        "pushed button does"
    )
    findings.warn(
        period_s > _MOMENT_S,
        f"{field}.period_s",
        why,
        f"set at most {_MOMENT_S:g} s, or use a latching contact",
    )


def _check_modbus(
    field: str, interlock: ModbusInputConfig, config: Config, findings: ConfigFindings
) -> None:
    coil = interlock.function == "coil"
    why = "a coil keeps what was written last: nothing detects that its writer has stopped"
    findings.warn(coil, f"{field}.function", why, "wire the circuit to a discrete input")
    if config.devices is None or not interlock.link.startswith("rtu:"):
        return
    pump = getattr(config.devices.pump, "link", None) or config.devices.board
    why = "on the pump's line: a module that does not answer also delays the pump's commands"
    findings.warn(
        interlock.link == pump, f"{field}.link", why, "give the interlocks a line of their own"
    )


def judge_interlock_board(config: Config, board: BenchIdentity, findings: ConfigFindings) -> None:
    """Refuse inputs that the board which answers does not have.

    Parameters
    ----------
    config : Config
        Whose interlocks name inputs of the board.
    board : BenchIdentity
        As read at the start; one without a watchdog and without a kind stands for "not read yet",
        and is not judged.
    findings : ConfigFindings
        Gets the errors and warnings.
    """
    if math.isnan(board.watchdog_s) and not board.kind:
        return  # no board has answered yet
    for index, interlock in enumerate(config.interlocks):
        if not isinstance(interlock, BoardInputConfig):
            continue
        field = f"devices.interlocks.{index}.input"
        why = f"this board has register map {board.map_version}, which has no interlock inputs"
        old = board.map_version < _INPUTS_SINCE
        findings.error(old, field, why, "update the board's firmware, or use another source")
        stops = board.interlocks_fitted >> interlock.input & 1
        why = "the board reports this circuit, but does not stop the pump by itself when it opens"
        findings.warn(
            not old and not stops,
            field,
            why,
            "set the input as fitted in the board's settings (docs/how-to/board.md)",
        )
