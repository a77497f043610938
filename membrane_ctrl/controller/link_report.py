"""What the links to the devices show in a tick, beside the readings."""

from dataclasses import dataclass

from firmware_iface.roles import NO_LINK_STATE, LinkState


@dataclass(frozen=True, slots=True)
class LinkReport:
    """Waiting, failures and silent sensors, so that a fault of a link is not taken for another.

    Attributes
    ----------
    wait_ms : float
        How long the last tick waited for the devices, without the time in which the program itself
        did not run; 0 for a wait that no tick notices.
    message : str
        Why the devices gave no valid answer to this tick's reading or the last tick's command;
        empty if they did. For people.
    devices : LinkState
        What the bench has recorded of its single devices.
    """

    wait_ms: float = 0.0
    message: str = ""
    devices: LinkState = NO_LINK_STATE

    def explain_silence(self, role: str) -> str:
        """Why there is no value of a role, for people; empty if its link is not the reason."""
        return dict(self.devices.silent).get(role, self.message)

    def explain_wait(self) -> str:
        """For what the last tick waited, for people; empty if it did not."""
        if not self.wait_ms:
            return ""
        device = self.devices.slowest or "the device"
        return f"{self.wait_ms:.0f} ms of waiting for {device}"
