"""docs/reference/events.md, made from the classes of events: `python -m
tests.support.events_page [--check]`.
"""

import argparse
import inspect
import sys
from dataclasses import MISSING
from enum import StrEnum
from pathlib import Path
from types import NoneType, UnionType
from typing import Any

from membrane_ctrl.model import events
from membrane_ctrl.model.event_base import Event
from membrane_ctrl.model.event_lines import KINDS
from membrane_ctrl.model.notices import NoticeKey, Topic

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "events.md"
_NOT_RECORDED = frozenset({"alive"})  # between processes only
_TYPES = {
    str: "text",
    int: "integer",
    float: "number",
    bool: "true or false",
    tuple[str, ...]: "list of texts",
    Any: "any",
}
_BY_SUBJECT = {Topic.CHILD: "CHILD_ended", Topic.MAINTENANCE: "maintenance_NAME"}
_INTRODUCTION = """\
Generated from the classes of events in `membrane_ctrl/model` (`make generate`). An event is one class; its lines in `events.jsonl` have the keys `time_utc`, `mono_s` (second of the run), `kind`, those listed here, and `crc32`. A
key in brackets is left out if it has no value. A program that does not know a kind can show its `message`, if it has
one, or its keys. The sentence is what console, page, timeline, report and alarms show; a part in brackets is left
out if one of its keys has no value.

*Notice*: the alarm that the event raises (+) or ends (-); some kinds do either, depending on their keys. Displays
list a notice until it ends. [Operations](../how-to/operations.md) has what to do about each.""".splitlines()  # noqa: E501


def events_page() -> str:
    """All kinds of events as Markdown."""
    lines = ["# Events", "", *_INTRODUCTION]
    for heading, of_controller in (("Of the controller", True), ("Of the other processes", False)):
        lines += [
            "",
            f"## {heading}",
            "",
            "| kind | meaning | keys | level | notice | sentence |",
            "|---|---|---|---|---|---|",
        ]
        kinds = {
            kind: cls
            for kind, cls in KINDS.items()
            if (cls.__module__ == events.__name__) == of_controller
        }
        lines += [
            _row(kind, cls) for kind, cls in sorted(kinds.items()) if kind not in _NOT_RECORDED
        ]
    return "\n".join([*lines, ""])


def _row(kind: str, cls: type[Event]) -> str:
    meaning = (inspect.getdoc(cls) or "").split("\n\n")[0].replace("\n", " ")
    keys = ", ".join(
        _describe_key(key, field.type, field.default is MISSING) for field, key in cls.keys
    )
    level = "by its keys" if cls.level is not Event.level else cls._level.value
    notices = [f"+`{_name_alarm(topic)}`" for topic in cls.opens] + [
        f"-`{_name_alarm(topic)}`" for topic in cls.closes
    ]
    cells = (f"`{kind}`", meaning, keys, level, " ".join(notices), f"`{cls._template}`")
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _describe_key(key: str, hint: Any, is_required: bool) -> str:
    types = hint.__args__ if isinstance(hint, UnionType) else (hint,)
    shown = [each for each in types if is_required or each is not NoneType]
    words = " or ".join(map(_describe_type, shown))
    return f"`{key}` {words}" if is_required else f"[`{key}` {words}]"


def _describe_type(hint: Any) -> str:
    if hint is NoneType:
        return "null"
    if isinstance(hint, type) and issubclass(hint, StrEnum):
        return " or ".join(f"`{code.value}`" for code in hint)
    return _TYPES[hint]


def _name_alarm(topic: Topic) -> str:
    return _BY_SUBJECT.get(topic) or NoticeKey(topic).alarm


def main(arguments: list[str] | None = None) -> int:
    """Write the page, or say that it is out of date; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.support.events_page", description=__doc__
    )
    parser.add_argument(
        "--check", action="store_true", help="write nothing; exit with 1 if the page is out of date"
    )
    check = parser.parse_args(arguments).check
    text = events_page()
    if PAGE.exists() and PAGE.read_text(encoding="utf-8") == text:
        return 0
    if check:
        print(f"{PAGE} is out of date: run python -m tests.support.events_page", file=sys.stderr)
        return 1
    PAGE.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
