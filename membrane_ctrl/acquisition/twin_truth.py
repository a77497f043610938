"""The simulated film's present position, from the truth ring of the bench."""

from firmware_iface.roles import LinkError
from membrane_ctrl.processes import ring
from membrane_ctrl.sim.truth import Truth


class TwinTruth:
    """The simulated film's present position, from the truth ring of the bench; callable."""

    def __init__(self, address: ring.RingAddress) -> None:
        self._reader = ring.RingReader(address)

    def __call__(self) -> Truth:
        """Return the newest truth. Raises LinkError before the first."""
        message = self._reader.latest()
        if message is None:
            raise LinkError("twin camera: the simulated bench has not started")
        return Truth.unpack(message)

    @property
    def known(self) -> bool:
        """Whether there is any truth yet."""
        return self._reader.latest() is not None

    def close(self) -> None:
        """Detach."""
        self._reader.close()
