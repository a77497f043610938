"""A scenario: what happens to a simulated bench and when, one TOML file each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

from pydantic import Field, model_validator

from firmware_iface.settings import Section
from membrane_ctrl.config import schema, toml_file
from membrane_ctrl.controller.command import Kind
from membrane_ctrl.sim import virtual_bench, virtual_interlocks

SWITCHES: dict[str, Any] = {field.name: field.default for field in fields(virtual_bench.Wrong)}
# Switches of one interlock, which the key `interlock` names
INTERLOCK_SWITCHES: dict[str, Callable[[virtual_interlocks.VirtualInterlocks], set[str]]] = {
    "interlock_open": lambda interlocks: interlocks.open_names,
    "interlock_lost": lambda interlocks: interlocks.lost_names,
}
# the plant refuses values beyond
_FRACTIONS = (
    "pump_share",
    "pump_stuck_fraction",
    "vent_stuck_fraction",
)
_REPEATS_MAX = 100_000
Happening = Literal[
    "ambient",
    "air_temperature",
    "leak",
    "laser_dropout",
    "laser_drift",
    "daily_temperature",
    "pressure_weather",
    "power_cycle",
]
S = TypeVar("S", bound="Scenario")


class ScenarioStep(Section):
    """One thing that happens: exactly one of `wrong`, `event` and `command`."""

    time_s: Annotated[float, Field(ge=0)]
    wrong: str | None = None
    for_s: Annotated[float, Field(gt=0)] | None = None
    every_s: Annotated[float, Field(ge=1e-3)] | None = None
    interlock: str | None = None  # that `wrong` opens or loses
    event: Happening | None = None
    over_s: Annotated[float, Field(ge=0)] = 0.0
    command: str | None = None
    value: float = 1.0
    text: str = ""

    @model_validator(mode="after")
    def _require_one_action(self) -> ScenarioStep:
        """Refuse a step that does nothing or several things, or has times that do not go with
        it.
        """
        # A step does one thing,
        if sum(thing is not None for thing in (self.wrong, self.event, self.command)) != 1:
            raise ValueError("give exactly one of wrong, event and command")
        if (
            self.wrong is not None
            and self.wrong not in SWITCHES
            and self.wrong not in INTERLOCK_SWITCHES
        ):
            known = ", ".join((*SWITCHES, *INTERLOCK_SWITCHES))
            raise ValueError(f"wrong = {self.wrong!r} is unknown; known are {known}")
        if (self.wrong in INTERLOCK_SWITCHES) != (self.interlock is not None):
            raise ValueError(
                f"interlock goes with {' and '.join(INTERLOCK_SWITCHES)}: the name of one"
            )
        if self.wrong in _FRACTIONS and not 0 <= self.value <= 1:
            raise ValueError(
                f"wrong = {self.wrong!r} with value = {self.value:g}: a fraction, 0 to 1"
            )
        # and takes only the times that go with it.
        if self.for_s is not None and self.wrong is None:
            raise ValueError("for_s goes with wrong; an event has over_s")
        if self.over_s and self.event is None:
            raise ValueError("over_s goes with event; what is wrong has for_s")
        if self.every_s is not None and (
            self.wrong is None or self.for_s is None or self.for_s >= self.every_s
        ):
            raise ValueError("every_s goes with wrong and with a for_s shorter than it")
        if self.command is not None and self.command not in get_args(Kind):
            raise ValueError(
                f"command = {self.command!r} is unknown; known are {', '.join(get_args(Kind))}"
            )
        return self


class Scenario(Section):
    """One scenario file; `expect` is for the tests."""

    title: str
    duration_s: Annotated[float, Field(gt=0, le=1e7)] = 60.0
    shapes: bool = False  # the camera measures; its shapes are made from the truth
    config: schema.Config = schema.Config()
    at: tuple[ScenarioStep, ...] = ()
    expect: dict[str, Any] | None = None

    @model_validator(mode="after")
    def _require_times_in_run(self) -> Scenario:
        """Refuse a step that names an unknown interlock, begins after the end, or repeats too
        often.
        """
        names = [interlock.name for interlock in self.config.interlocks]
        for number, at in enumerate(self.at):
            if at.interlock is not None and at.interlock not in names:
                known = ", ".join(names) or "none: add [[config.devices.interlocks]]"
                raise ValueError(
                    f"at.{number}: interlock = {at.interlock!r} is not configured; known: {known}"
                )
            if at.time_s >= self.duration_s:
                raise ValueError(
                    f"at.{number}: time_s = {at.time_s:g} is not before duration_s = "
                    f"{self.duration_s:g}"
                )
            if at.every_s is not None and self.duration_s / at.every_s > _REPEATS_MAX:
                raise ValueError(
                    f"at.{number}: every_s = {at.every_s:g} repeats more than {_REPEATS_MAX} times"
                )
        return self


def load_scenario(path: Path, model: type[S]) -> S:
    """Read a scenario.

    Parameters
    ----------
    path : path
        A file of this package, or a stranger's.
    model : type
        Its schema.

    Raises
    ------
    InputError
        One line that names the file, the field and what would be right.
    """
    return toml_file.load_toml(path, model)
