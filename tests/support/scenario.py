"""Expected outcomes of scenario files (docs/reference/scenarios.md), and whether they came."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from firmware_iface.settings import Section
from membrane_ctrl.hold.scenario_file import Scenario
from membrane_ctrl.hold.scenario_run import ScenarioRun
from membrane_ctrl.hold.virtual_run import VirtualTick
from membrane_ctrl.model.events import EventLine
from membrane_ctrl.model.telemetry import FIELDS
from membrane_ctrl.sim.virtual_bench import VirtualBench


class Bound(Section):
    """A telemetry field stays within bounds: every row, or the mean over `mean_s`; and its standard
    deviation.
    """

    field: str
    from_s: float = 0.0
    to_s: Annotated[float, Field(gt=0)] = 1e9
    low: float | None = None
    high: float | None = None
    std_max: Annotated[float, Field(gt=0)] | None = None
    mean_s: Annotated[float, Field(gt=0)] | None = None

    @model_validator(mode="after")
    def _known(self) -> Bound:
        if self.field not in FIELDS:
            raise ValueError(
                f"field = {self.field!r} is not in the telemetry; known are {', '.join(FIELDS)}"
            )
        if self.low is None and self.high is None and self.std_max is None:
            raise ValueError("give low, high or std_max")
        return self


class Expectation(Section):
    """The expected outcome; omitted keys are not checked."""

    exit: Literal["done", "safety_trip", "device_failed", "interrupted"] | None = None
    states: tuple[str, ...] | None = None
    faults: tuple[str, ...] | None = None
    shape_reasons: tuple[str, ...] = ()  # each must be part of a reason that the shape loop gave
    events: tuple[str, ...] = ()  # kinds that must occur
    bounds: tuple[Bound, ...] = ()


class CheckedScenario(Scenario):
    """A scenario with its expected outcome."""

    expect: Expectation  # type: ignore[assignment]


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a scenario.

    Attributes
    ----------
    ticks : tuple of VirtualTick
        All ticks that ran.
    events : tuple of dict
        All events, with `mono_s`.
    bench : VirtualBench
        State at the end.
    """

    ticks: tuple[VirtualTick, ...]
    events: tuple[EventLine, ...]
    bench: VirtualBench

    def of(self, kind: str) -> list[EventLine]:
        """The events of a kind."""
        return [event for event in self.events if event["kind"] == kind]


def play(scenario: CheckedScenario) -> Outcome:
    """Run a scenario in virtual time, from the command `hold` until
    its end and 5 s of aftermath.
    """
    run = ScenarioRun(scenario)
    ticks = tuple(tick for tick in run.ticks() if tick is not None)
    run.bench.advance(5.0)
    events = tuple(
        {**event.to_dict(), "mono_s": tick.row.mono_s} for tick in ticks for event in tick.events
    )
    return Outcome(ticks, events, run.bench)


def failures(expect: Expectation, outcome: Outcome) -> Iterator[str]:
    """Deviations from the expected outcome, a line each."""
    finished = outcome.ticks[-1].outputs.finished if outcome.ticks else None
    exit_name = "none" if finished is None else finished.name.lower()
    found: list[tuple[str, Any, Any]] = [
        ("exit", expect.exit, exit_name),
        ("states", expect.states, tuple(e["state"] for e in outcome.of("state"))),
        ("faults", expect.faults, tuple(e["name"] for e in outcome.of("fault"))),
    ]
    yield from (
        f"{name}: {got}, not {wanted}"
        for name, wanted, got in found
        if wanted is not None and wanted != got
    )
    kinds = {event["kind"] for event in outcome.events}
    yield from (f"no event of kind {kind}" for kind in expect.events if kind not in kinds)
    reasons = [str(event["reason"]) for event in outcome.of("shape")]
    for part in expect.shape_reasons:
        if not any(part in reason for reason in reasons):
            yield f"the shape loop never said {part!r}; it said {reasons}"
    for bound in expect.bounds:
        yield from _broken(bound, outcome)


def _broken(bound: Bound, outcome: Outcome) -> Iterator[str]:
    rows = [tick.row for tick in outcome.ticks if bound.from_s <= tick.row.mono_s <= bound.to_s]
    values = np.array([getattr(row, bound.field) for row in rows])
    where = f"{bound.field} from {bound.from_s:g} s to {bound.to_s:g} s"
    if bound.mean_s is not None and rows:
        bins = ((np.array([row.mono_s for row in rows]) - rows[0].mono_s) / bound.mean_s).astype(
            int
        )
        values = np.array(
            [values[bins == k].mean() for k in range(int(bins[-1]))]
        )  # the last bin is cut
    if not values.size or not np.isfinite(values).all():
        yield f"{where}: not there all the time"
        return
    if bound.low is not None and values.min() < bound.low:
        yield f"{where}: {values.min():.4g}, below {bound.low:g}"
    if bound.high is not None and values.max() > bound.high:
        yield f"{where}: {values.max():.4g}, above {bound.high:g}"
    if bound.std_max is not None and values.std() > bound.std_max:
        yield f"{where}: standard deviation {values.std():.4g}, above {bound.std_max:g}"
