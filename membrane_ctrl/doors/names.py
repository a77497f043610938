"""What every door publishes: one table of names with units, their values, and who may act through a door."""

import asyncio
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from membrane_ctrl.config.schema import Config
from membrane_ctrl.control_port.ctl import Where, lock_lines
from membrane_ctrl.control_port.protocol import TEXT_BYTES
from membrane_ctrl.web.access import ACTIONS, STOP, Action, WebUser, may, request
from membrane_ctrl.web.feed import HoldFeed, HoldSeen

Value = float | str | None  # None: not known

_WAITING_MOST = 8

COMMANDS = {str(action.do): action for action in (*ACTIONS, STOP)}


@dataclass(frozen=True, slots=True)
class Published:
    """A published value; without a unit it is a text."""

    name: str
    unit: str
    says: str


_TICK = (
    Published("error_um", "um", "setpoint minus laser"),
    Published("setpoint_um", "um", "setpoint of the loop, with the trim"),
    Published("target_um", "um", "end of the setpoint's ramp"),
    Published("displacement_um", "um", "laser reading, or the optics' on a bench held without a laser"),
    Published("trim_um", "um", "shape loop's part of the setpoint"),
    Published("flow_um_per_s", "um/s", "pump's flow, as motion of the centre"),
    Published("leak_um_per_s", "um/s", "leak, as motion of the centre"),
    Published("pump_fraction", "1", "pump command, share of full scale"),
    Published("vent_fraction", "1", "vent command, share of full scale"),
    Published("gauge_pressure_pa", "Pa", "pressure in the mirror above ambient"),
    Published("ambient_pressure_pa", "Pa", "barometer"),
    Published("air_temperature_c", "°C", "air around the mirror"),
    Published("gas_temperature_c", "°C", "gas in the mirror"),
    Published("lateness_ms", "ms", "how late the newest tick began"),
    Published("missed_ticks", "1", "missed ticks of the run"),
)
_TERMS = range(4, 12)  # Noll: defocus to the first spherical term
_FIGURE = (
    Published("sag_um", "um", "sag of the newest figure"),
    Published("sag_sigma_um", "um", "its standard deviation from noise"),
    Published("figure_age_s", "s", "age of that figure"),
    *(Published(f"z{j}_um", "um", f"its Zernike term j = {j} (Noll, RMS)") for j in _TERMS),
)
_TEXTS = (
    Published("state", "", "state of the hold, or `no contact`"),
    Published("why", "", "the one-line reason"),
    Published("run", "", "name of the run"),
    Published("fault", "", "the fault with its cause and remedy; empty without one"),
    Published("locks", "", "the locks: text, author, time and word of each; empty without one"),
    Published("interlocks", "", "the open interlocks with their texts; empty without one"),
    Published("notices", "", "maintenance notices, and what fails in the recording"),
    Published("figure_verdict", "", "verdict on the newest figure"),
    Published("answer", "", "what became of the last command of any door"),
)
TABLE = (*_TEXTS, *_TICK, *_FIGURE)


def values(seen: HoldSeen) -> dict[str, Value]:
    """The values of `TABLE` except `answer`; None, or `no contact`, instead of old ones."""
    found: dict[str, Value] = {each.name: None for each in TABLE if each.name != "answer"}
    found["run"] = seen.name
    if seen.silent:
        return {**found, "state": "no contact", "why": seen.silent}
    status, row = seen.status, seen.status.get("row") or {}
    fault = status.get("fault")
    notices = [str(each) for part in ("maintenance", "recording") for each in status.get(part, {}).values()]
    found |= {
        "state": str(status.get("state", "")),
        "why": str(status.get("why") or "as it should be"),
        "fault": "{code} {name}: {cause}; {remedy}".format_map(fault) if fault else "",
        "locks": "; ".join(lock_lines(status)),
        "interlocks": "; ".join(str(each) for each in status.get("interlocks", {}).values()),
        "notices": "; ".join(notices),
    }
    found |= {each.name: row.get(each.name) for each in _TICK}
    if seen.figure is not None:
        age_s = (row.get("mono_s") or math.nan) - seen.figure.time_s
        found |= {"figure_verdict": seen.figure.verdict, "figure_age_s": age_s}
        found |= {"sag_um": seen.figure.sag_um, "sag_sigma_um": seen.figure.sag_sigma_um}
        found |= {f"z{j}_um": float(seen.figure.coeffs_um[j - 1]) for j in _TERMS}
    return {name: None if isinstance(v, float) and not math.isfinite(v) else v for name, v in found.items()}


class Door:
    """What a door knows and may do: the values, and commands by role; shared by all doors of the process."""

    def __init__(self, feed: HoldFeed, config: Config) -> None:
        self.feed = feed
        self.settings = config.doors
        limits, flow_max = config.limits, config.loop.flow_most_um_per_s(config.pump)
        # what the hold would accept; it judges by itself
        self.bounds: dict[str, tuple[float, float]] = {
            "setpoint": (limits.displacement_min_um, limits.displacement_max_um),
            "manual": (0.0, flow_max),
        }
        self._answer = ""
        self._turn, self._waiting = asyncio.Lock(), 0
        self.opening = asyncio.Lock()  # one door after the other: a server blocks the event loop while it opens

    @classmethod
    def to(cls, config: Config, logs: Path | None, socket: Path | None) -> "Door":
        """A door to the hold of a configuration, or to another one."""
        folder = logs or Path(config.recording.logs_dir)
        return cls(HoldFeed(Where(socket or config.port.socket_in(folder), logs=folder)), config)

    def values(self) -> dict[str, Value]:
        """The values of `TABLE` now."""
        return {**values(self.feed.seen), "answer": self._answer}

    @property
    def live(self) -> bool:
        """Whether the values are those of a hold that answers."""
        return not self.feed.seen.silent

    @property
    def commands(self) -> dict[str, Action]:
        """The commands that the settings allow; the hold may still refuse them."""
        user = WebUser("", self.settings.role)
        return {name: action for name, action in COMMANDS.items() if may(user, "tune", action)}

    async def ask(self, by: str, name: str, given: Any = "") -> str:
        """Send a command for the door `by`; returns what became of it, in one line."""
        self._answer = f"{time.strftime('%H:%M:%S', time.gmtime())} UTC, {by}: {await self._asked(by, name, given)}"
        return self._answer

    async def _asked(self, by: str, name: str, given: Any) -> str:
        action = COMMANDS.get(name)
        if action is None:
            return "no such command"
        if not may(WebUser(by, self.settings.role), self.feed.seen.role, action):
            return f"{name} refused: needs the role {action.role}"
        try:
            text = str(given)
            if len(text) > TEXT_BYTES:  # the port would drop a client that sends too much
                raise ValueError(f"{name} refused: longer than {TEXT_BYTES} bytes")
            asked = request(action, f"door: {by}", text)
            asked["on_behalf"] = {"via": "bridge", "name": by, "role": self.settings.role}
        except ValueError as error:
            return str(error)
        return await self._in_turn(asked)

    async def _in_turn(self, asked: dict[str, Any]) -> str:
        """One request after the other: the port would drop clients of one name that crowd it, the feed among them."""
        if self._waiting >= _WAITING_MOST and asked["do"] != STOP.do:
            return f"{asked['do']} refused: too many commands at once"
        self._waiting += 1
        try:
            async with self._turn:
                return await asyncio.to_thread(self.feed.ask, asked)
        finally:
            self._waiting -= 1
