"""Probes emulated single instruments, each in its own protocol."""

import asyncio
import contextlib

from firmware_iface.emulators.pump_board import BoardSample
from membrane_ctrl.commissioning import check
from membrane_ctrl.config.schema import DevicesConfig
from membrane_ctrl.instruments import role_drivers
from membrane_ctrl.sim import lab, plant

_STEP_S = 0.005


class SteppedPlant:
    """A `BoardPlant` that moves only while it is asked to."""

    def __init__(self, mirror: plant.Plant) -> None:
        self._mirror = mirror
        self._sample = mirror.sample()

    def sample(self) -> BoardSample:
        """The newest sample."""
        return self._sample

    def actuate(self, pump_fraction: float, vent_fraction: float) -> None:
        """Drive pump and vent, from now on.

        Parameters
        ----------
        pump_fraction : float
            0 (off) to 1 (full power).
        vent_fraction : float
            0 (closed) to 1 (open).
        """
        self._mirror.actuate(pump_fraction, vent_fraction)

    async def keep_moving(self) -> None:
        """Advance in real time."""
        while True:
            self._mirror.advance(_STEP_S)
            self._sample = self._mirror.sample()
            await asyncio.sleep(_STEP_S)


async def probe_instruments(mirror: plant.Plant, devices: DevicesConfig) -> list[check.DeviceProbe]:
    """Emulate the instruments, probe them with their drivers, and switch them off.

    Parameters
    ----------
    mirror : Plant
        What the emulated sensors measure; it advances in real time meanwhile.
    devices : DevicesConfig
        Single instruments; their ports are replaced by emulated ones.

    Returns
    -------
    list of DeviceProbe
        One for each role; a device that fails is reported in its probe, and nothing is raised.
    """
    moving = SteppedPlant(mirror)
    emulated = lab.Lab(moving, devices)
    moved = await emulated.start()
    task = asyncio.create_task(moving.keep_moving())
    try:
        return await check.probe_roles(role_drivers.make_role_devices(moved))
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        await emulated.stop()
