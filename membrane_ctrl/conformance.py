"""`conformance`: whether a board may be trusted with the pump."""

from __future__ import annotations

import asyncio
import json
from dataclasses import asdict

from rich.markup import escape
from rich.table import Table

from firmware_iface.conformance import examine
from firmware_iface.roles import LinkError
from membrane_ctrl.device_lock import locked, modbus_names
from membrane_ctrl.errors import DeviceError, Exit, InputError
from membrane_ctrl.terminal import table_console


def run_conformance(url: str, unit_id: int, as_json: bool) -> int:
    """Test and report; the exit code is that of a rejected measurement when the board fails.

    Raises
    ------
    InputError
        The URL is none.
    DeviceError
        The board is not there, went away, or is another program's.
    """
    try:
        with locked(modbus_names(url, unit_id)):
            findings = asyncio.run(examine(url, unit_id))
    except ValueError as error:
        raise InputError(str(error)) from None
    except LinkError as error:
        raise DeviceError(str(error)) from None
    passed = not any(finding.problem for finding in findings)
    if as_json:
        checks = [asdict(finding) for finding in findings]
        print(json.dumps({"schema": "membrane-conformance/1", "board": url, "passed": passed, "checks": checks}))
    else:
        table = Table("check", "result", "docs/firmware.md")
        for finding in findings:
            table.add_row(finding.check, escape(finding.problem) or "passed", finding.section)
        table_console().print(table)
        table_console().print("conforms" if passed else "does not conform: do not let it run a pump")
    return Exit.DONE if passed else Exit.REJECTED
