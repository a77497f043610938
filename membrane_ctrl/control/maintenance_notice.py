"""A notice of a slow deterioration that needs maintenance."""

from dataclasses import dataclass

# Warn again only after a clear improvement.
WITHDRAWN_BELOW = 0.9


@dataclass(frozen=True, slots=True)
class MaintenanceNotice:
    """A maintenance notice; it no longer applies if it is not `bad`."""

    name: str
    message: str
    bad: bool = True
