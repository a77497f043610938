"""The twin's film, screen and camera, as the acquisition finds them."""

from __future__ import annotations

from firmware_iface.roles import LinkError
from membrane_ctrl.ipc.ring import RingAddress, RingReader
from membrane_ctrl.twin.truth import Truth


class TwinTruth:
    """Where the simulated film is now; call it.

    Parameters
    ----------
    address : RingAddress
        The ring in which the bench process publishes the truth.
    """

    def __init__(self, address: RingAddress) -> None:
        self._reader = RingReader(address)

    def __call__(self) -> Truth:
        """The newest truth. Raises LinkError before the first."""
        message = self._reader.latest()
        if message is None:
            raise LinkError("twin camera: the simulated bench has not started")
        return Truth.unpack(message)

    @property
    def known(self) -> bool:
        """There is one."""
        return self._reader.latest() is not None

    def close(self) -> None:
        """Detach."""
        self._reader.close()
