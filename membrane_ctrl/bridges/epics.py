"""The bridge to EPICS: one IOC for Channel Access and PV Access; a record for each published value
and each command.

Numbers without contact to the hold keep their last value with the severity INVALID and the status
COMM, as EPICS has no empty number. EPICS libraries keep their state in the process: one IOC in
each.
"""

import asyncio
import os
import socket
import sys
import tempfile
from pathlib import Path
from typing import Any

from membrane_ctrl.bridges.bridge import TABLE, Bridge
from membrane_ctrl.bridges.epics_search import require_unserved
from membrane_ctrl.config.bridges import EpicsConfig
from membrane_ctrl.instruments import device_claim
from membrane_ctrl.model import errors, files
from membrane_ctrl.service.action_button import ActionButton
from membrane_ctrl.service.published_signal import Published
from membrane_ctrl.service.published_signals import Value

# Clients may write the value of a command (level 0) only. EPICS by itself lets them write
# everything, and the other fields (FLNK, SCAN, ASG) would send commands in chains, again and again,
# or block them.
_RULES = "ASG(DEFAULT) { RULE(1, READ) }\nASG(COMMAND) { RULE(1, READ) RULE(0, WRITE) }\n"
_TEXT_BYTES = 512
_DIGITS = 4


async def serve(config: EpicsConfig, bridge: Bridge) -> None:
    """Serve until cancelled.

    Parameters
    ----------
    config : EpicsConfig
        Address and ports to listen on.
    bridge : Bridge
        The values that become records, and the commands that become records `do:COMMAND`. Its
        `opening` is held for the seconds in which the IOC starts.

    Raises
    ------
    DeviceError
        The address is taken, or another server has these records.
    """
    # The lock of this machine keeps two bridges of one name apart; the search below finds other
    # servers.
    with device_claim.claim_devices([f"EPICS records {bridge.settings.name}:*"]):
        await _serve_records(config, bridge)


async def _serve_records(config: EpicsConfig, bridge: Bridge) -> None:
    async with bridge.opening:
        await asyncio.to_thread(require_unserved, f"{bridge.settings.name}:state", config.ca_port)
        records = _start_ioc(config, bridge)
    print(
        f"epics: {config.host}, CA {config.ca_port}, PVA {config.pva_port}",
        file=sys.stderr,
        flush=True,
    )
    from softioc import alarm

    while True:
        # A value that is missing keeps the record's last number and becomes INVALID: by COMM if
        # the hold does not answer, by UDF if the hold has no such value now.
        missing_status = alarm.COMM_ALARM
        if bridge.live:
            missing_status = alarm.UDF_ALARM
        for name, value in bridge.values().items():
            record = records[name]
            if value is not None:
                record.set(_shorten_text(value))
            else:
                record.set_alarm(alarm.INVALID_ALARM, missing_status)
        await asyncio.sleep(bridge.settings.period_s)


def _start_ioc(config: EpicsConfig, bridge: Bridge) -> dict[str, Any]:
    """Start the IOC, which takes seconds; returns the records of the published values."""
    _require_free(config)
    # EPICS reads addresses and ports from the environment only, for Channel Access (CAS) and
    # PV Access (PVAS): where to listen, and no beacons to networks that nobody configured.
    for protocol in ("CAS", "PVAS"):
        os.environ.update(
            {
                f"EPICS_{protocol}_INTF_ADDR_LIST": config.host,
                f"EPICS_{protocol}_BEACON_ADDR_LIST": config.host,
                f"EPICS_{protocol}_AUTO_BEACON_ADDR_LIST": "NO",
            }
        )
    os.environ.update(
        EPICS_CA_SERVER_PORT=str(config.ca_port), EPICS_PVAS_SERVER_PORT=str(config.pva_port)
    )
    from softioc import asyncio_dispatcher, builder, imports, softioc  # they read the environment

    builder.SetDeviceName(bridge.settings.name)
    records = {each.name: _record(builder, each) for each in TABLE}
    for do, action in bridge.commands.items():
        _make_command_record(builder, bridge, do, action, records["answer"])
    builder.LoadDatabase()
    # The rules of access must be set before iocInit, which reads their file; then the file may go.
    with tempfile.TemporaryDirectory() as folder:
        rules = Path(folder) / "rules.acf"
        files.write_text_atomic(rules, _RULES)
        imports.dbCore.asSetFilename(str(rules).encode())
        softioc.iocInit(asyncio_dispatcher.AsyncioDispatcher(asyncio.get_running_loop()))
    return records


def _require_free(config: EpicsConfig) -> None:
    """Refuse ports that are in use: EPICS would listen on another one, where no client searches.
    Raises DeviceError.
    """
    for port in (config.ca_port, config.pva_port):
        try:
            socket.create_server((config.host, port)).close()
        except OSError as error:
            where = f"{config.host}:{port}"
            raise errors.DeviceError(
                f"epics: {where}: {errors.os_reason(error)}; choose another port"
            ) from None


def _shorten_text(value: Value) -> Value:
    """A text that fits its record."""
    if isinstance(value, str):
        return value.encode()[: _TEXT_BYTES - 1].decode("utf-8", "ignore")
    return value


def _record(builder: Any, published: Published) -> Any:
    description = published.description.replace("`", "")[:40]  # EPICS has no more room
    if published.is_text:
        return builder.longStringIn(published.name, length=_TEXT_BYTES, DESC=description)
    return builder.aIn(published.name, EGU=published.unit, PREC=_DIGITS, DESC=description)


def _make_command_record(
    builder: Any, bridge: Bridge, do: str, action: ActionButton, answer: Any
) -> None:
    """The record `do:COMMAND`: a number, a text, or any write at all; a put ends once the answer is
    there.
    """

    async def obey(value: object) -> None:
        answer.set(_shorten_text(await bridge.ask("epics", do, value if action.asks else "")))

    common = {"on_update": obey, "always_update": True, "ASG": "COMMAND", "DESC": action.label}
    if action.asks == "number":
        low, high = bridge.bounds[do]
        builder.aOut(
            f"do:{do}", EGU=action.unit, PREC=_DIGITS, LOPR=low, HOPR=high, blocking=True, **common
        )
    elif action.asks == "text":
        builder.longStringOut(f"do:{do}", length=_TEXT_BYTES, blocking=True, **common)
    else:
        builder.boolOut(f"do:{do}", ZNAM="do", ONAM="do", blocking=True, **common)
