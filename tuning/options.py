"""Options of the subcommands of `tune`."""

from dataclasses import dataclass
from pathlib import Path

from membrane_ctrl.config.schema import Config
from membrane_ctrl.control_port.ctl import Where
from tuning.identification.experiments import FULL, SHORT, Plan
from tuning.proposal.verification import STAGES


@dataclass(frozen=True, slots=True)
class TuneOptions:
    """Options of the command line."""

    config: Config
    twin: bool
    where: Where
    logs: Path
    session: Path | None
    name: str
    author: str
    reason: str
    limit_um: float
    observe_s: float
    verify_s: float
    take_over: bool
    yes: bool
    choose: str
    json: bool
    page: bool = False
    short: bool = False
    wait: bool = False

    @property
    def plan(self) -> Plan:
        """Of the experiments."""
        return SHORT if self.short else FULL

    @property
    def stages(self) -> tuple[tuple[float, float], ...]:
        """Stages of the verification that fit in the time available; none earlier: one gust is half
        of 30 s.
        """
        early = tuple(stage for stage in STAGES[:-1] if stage[0] < self.verify_s)
        return (*early, (self.verify_s, STAGES[-1][1]))
