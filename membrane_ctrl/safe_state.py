"""`safe`: writes pump 0 to the devices of a configuration and goes; for `ExecStopPost` and for a person in doubt.

Independent of a hold: it knows nothing of runs, rings or states, and works when the control process is long dead.
"""

from __future__ import annotations

import asyncio
import math
import sys

from firmware_iface.roles import BenchCommand, LinkError
from membrane_ctrl.bench import connect, open_bench
from membrane_ctrl.config import Config, DevicesConfig
from membrane_ctrl.errors import DeviceError, Exit, InputError


def make_safe(config: Config, source: str) -> int:
    """Pump 0, the vent as it is. Raises InputError without devices, DeviceError if they cannot be reached."""
    if config.devices is None:
        raise InputError(f"{source}: devices: missing; there is nothing to make safe")
    print(asyncio.run(_make_safe(config.devices)), file=sys.stderr)
    return Exit.DONE


async def _make_safe(devices: DevicesConfig) -> str:
    bench = open_bench(devices)
    try:
        await connect(bench, devices)
        reading = await bench.read()
        # a mirror that is being vented goes on being vented
        vent_fraction = reading.vent_fraction if math.isfinite(reading.vent_fraction) else 0.0
        await bench.write(BenchCommand(0.0, min(max(vent_fraction, 0.0), 1.0)))
        after = await bench.read()
    except LinkError as error:
        raise DeviceError(f"{devices.name}: {error}; the board's watchdog stops the pump by itself") from None
    finally:
        await bench.close()
    latched = f", faults latched {after.latched_faults:#x}" if after.latched_faults else ""
    return f"{devices.name}: pump 0, vent {vent_fraction:.2f}{latched}"
