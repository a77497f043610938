"""From the configuration's words to a bench of devices."""

from __future__ import annotations

from firmware_iface.drivers.pump_board import PumpBoard
from firmware_iface.roles import Bench
from membrane_ctrl.config import DevicesConfig


def open_bench(devices: DevicesConfig) -> Bench:
    """The bench that the configuration names, not yet connected."""
    return PumpBoard(devices.board, devices.unit_id, devices.timeout_s, devices.watchdog_s)
