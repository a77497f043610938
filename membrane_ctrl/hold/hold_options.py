"""Options of the command `hold`."""

from dataclasses import dataclass
from pathlib import Path

from membrane_ctrl.config.schema import Config


@dataclass(frozen=True, slots=True)
class HoldOptions:
    """Options of the command line."""

    config: Config
    source: str  # origin of the configuration, for messages
    twin: bool
    duration_s: float | None
    name: str
    logs_dir: Path | None
    clear_faults: bool
    json: bool
    standby: bool = False  # wait for `ctl hold`
    autotune: bool = False  # a short tuning session once the mirror is held
    # the twin answers as the instruments of the configuration, not as the pump board
    lab: bool = False
    configuration: Path | None = None  # the file
    service: bool = False  # start a service with a page if none is there
