"""The runbook has a remedy for every notice that can be sent."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from membrane_ctrl import alarms
from membrane_ctrl.config.schema import Config
from membrane_ctrl.control import film_health
from membrane_ctrl.metrology.vibrations import mode_follower
from membrane_ctrl.model import child_events
from membrane_ctrl.model.event_lines import KINDS
from membrane_ctrl.model.notices import NoticeKey, Topic

RUNBOOK = (Path(__file__).parents[2] / "docs" / "how-to" / "operations.md").read_text(
    encoding="utf-8"
)
SOURCES = "".join(path.read_text(encoding="utf-8") for path in Path(*alarms.__path__).glob("*.py"))
BY_SUBJECT = {Topic.CHILD, Topic.MAINTENANCE}  # named by their subjects
OF_EVENTS = {
    NoticeKey(topic).alarm
    for cls in KINDS.values()
    for topic in cls.opens
    if topic not in BY_SUBJECT
}
PLAIN = set(re.findall(r'Sign\("(\w+)"', SOURCES)) | OF_EVENTS
MAINTENANCE = re.findall(
    r'^ +\(?"(\w+)",', Path(film_health.__file__).read_text(encoding="utf-8"), re.MULTILINE
)
VIBRATIONS = re.findall(
    r'_notice\(\s*"(\w+)"', Path(mode_follower.__file__).read_text(encoding="utf-8")
)
RULES = [rule.name for rule in Config().alarms.rules]
CHILDREN = [
    NoticeKey(Topic.CHILD, child).alarm
    for child in (child_events.RECORDER, "acquisition", "screen")
]


def test_the_names_are_found() -> None:
    assert {"fault", "link", "latch", "silent", "control_gone", "run_ended"} <= PLAIN
    assert set(MAINTENANCE) == {"leak_growth", "pump_reserve", "too_tight", "creep"}
    assert set(VIBRATIONS) == {"film_tension", "pump_resonance"}


@pytest.mark.parametrize(
    "name",
    [
        *sorted(PLAIN),
        *(f"maintenance_{name}" for name in MAINTENANCE + VIBRATIONS),
        *RULES,
        *CHILDREN,
    ],
)
def test_the_remedy_is_stated(name: str) -> None:
    assert re.search(rf"^\|.*`{name}`.*\|.+\|.+\|$", RUNBOOK, re.MULTILINE)
