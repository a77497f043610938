"""What an event is: one class with its fields, level, sentence, and the notices that it opens or
closes.

Recorder, summary, alarms, page, console, report and bridges read the class. As JSON, events are the
lines of `events.jsonl`, without their times. A field is a key of the line (`from_` is "from", a
Python keyword). Keys with None as default are omitted if None.
"""

from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, dataclass, fields
from enum import StrEnum
from typing import Any, ClassVar, dataclass_transform

from membrane_ctrl.model import prose
from membrane_ctrl.model.notices import Notice, NoticeChanges, NoticeKey, Notices, Severity, Topic

EventLine = dict[str, Any]  # of `events.jsonl`, with or without its times

KINDS: dict[str, type["Event"]] = {}

# Keys of a line that are not the event's own.
_ENVELOPE = frozenset({"time_utc", "mono_s", "kind", "crc32"})


class LogLevel(StrEnum):
    """How logs mark an event."""

    INFO = "INFO"
    WARNING = "WARN"  # somebody should look at it
    ERROR = "ERROR"  # the run is affected


@dataclass_transform(frozen_default=True)
@dataclass(frozen=True)
class Event:
    """The base of all kinds; derived classes are frozen dataclasses, defined with these keywords.

    Parameters
    ----------
    kind : str
        Kind of the lines.
    sentence : str
        Template of the sentence (`prose.fill_template`) over the keys of the line and properties
        of the class.
    level : LogLevel
    opens, closes : tuple of Topic
        Topics of the notices that it may open or close.
    subject : str
        Field that names which of several notices under the topic; empty: there is one.
    severity, delay_s
        Of the alarm about the notice (`Notice`).
    notable : bool
        Logs and reports show it although it has no level and changes no notice.
    urgent : bool
        It is synced to the disk at once: a power cut may follow.
    """

    # of the lines; `kind` of an instance is the same, unless it is unknown
    line_kind: ClassVar[str] = ""
    _template: ClassVar[str] = "{message}"
    _level: ClassVar[LogLevel] = LogLevel.INFO
    _subject: ClassVar[str] = ""
    _severity: ClassVar[Severity] = "warning"
    _delay_s: ClassVar[float] = 0.0
    _notable: ClassVar[bool] = False
    urgent: ClassVar[bool] = False
    opens: ClassVar[tuple[Topic, ...]] = ()
    closes: ClassVar[tuple[Topic, ...]] = ()
    # the fields, each with its key in the line
    keys: ClassVar[tuple[tuple[Field[Any], str], ...]] = ()

    def __init_subclass__(
        cls,
        *,
        kind: str = "",
        sentence: str = "{message}",
        level: LogLevel = LogLevel.INFO,
        opens: tuple[Topic, ...] = (),
        closes: tuple[Topic, ...] = (),
        subject: str = "",
        severity: Severity = "warning",
        delay_s: float = 0.0,
        notable: bool = False,
        urgent: bool = False,
    ) -> None:
        dataclass(frozen=True)(cls)
        cls.line_kind = kind
        cls._template = sentence
        cls._level = level
        cls.opens = opens
        cls.closes = closes
        cls._subject = subject
        cls._severity = severity
        cls._delay_s = delay_s
        cls._notable = notable
        cls.urgent = urgent
        cls.keys = tuple((field, field.name.rstrip("_")) for field in fields(cls))
        if kind:
            KINDS[kind] = cls

    @property
    def kind(self) -> str:
        """Kind as in the line."""
        return self.line_kind

    @property
    def level(self) -> LogLevel:
        """How logs mark it."""
        return self._level

    @property
    def sentence(self) -> str:
        """One sentence on the event for people, with the remedy if there is one;
        else its fields.
        """
        template = self._choose_template()
        line = self.to_dict()
        values = {
            name: getattr(self, name) for name in prose.fields_of(template) if hasattr(self, name)
        } | line
        shown = {
            name: ", ".join(map(str, v)) if isinstance(v, tuple | list) else v
            for name, v in values.items()
        }
        try:
            filled = prose.fill_template(template, shown)
        except (ValueError, TypeError):  # a number that is none
            filled = None
        if filled is not None:
            return filled
        return list_fields(line)

    @property
    def opens_notice(self) -> bool:
        """Whether it opens its notice, not closes it; for kinds that may do either."""
        return bool(self.opens)

    @property
    def notable(self) -> bool:
        """Whether logs and reports show it."""
        return (
            self._notable
            or self.level is not LogLevel.INFO
            or bool(self.opens)
            or bool(self.closes)
        )

    @property
    def plot_mark(self) -> str:
        """The vertical line that it draws across plots over time (`streams.MARKS`); empty: none."""
        return ""

    def notice_changes(self, standing: Notices) -> NoticeChanges:
        """Return the notices that it closes and opens, given those that stand."""
        subject = str(getattr(self, self._subject)) if self._subject else ""
        if self.opens and self.opens_notice:
            return NoticeChanges(opened=(self._make_notice(NoticeKey(self.opens[0], subject)),))
        return NoticeChanges(closed=tuple(NoticeKey(topic, subject) for topic in self.closes))

    def _make_notice(self, key: NoticeKey) -> Notice:
        return Notice(key, self.sentence, self._severity, self._delay_s)

    def _choose_template(self) -> str:
        return self._template

    def to_dict(self) -> EventLine:
        """The line, without its times."""
        values = (
            (key, getattr(self, field.name), field.default is MISSING) for field, key in self.keys
        )
        return {"kind": self.kind} | {
            key: value for key, value, is_required in values if is_required or value is not None
        }

    def numbers(self) -> tuple[float, ...]:
        """Numbers and codes of the event, in the order of its fields; texts and missing values are
        left out.

        Together with `kind` they identify what happened, independently of the wording: the checksum
        of a tick covers them. A table counts with its numbers, in the order of its keys.
        """
        return tuple(
            number for field, _ in self.keys for number in _numbers_in(getattr(self, field.name))
        )


def _numbers_in(value: object) -> Iterator[float]:
    if isinstance(value, StrEnum):
        yield float(list(type(value)).index(value))
    elif isinstance(value, bool | int | float):
        yield float(value)
    elif isinstance(value, Mapping):
        for key in sorted(value):
            yield from _numbers_in(value[key])
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _numbers_in(item)


def list_fields(line: EventLine) -> str:
    """Return the kind and the fields of a line in words, for an event without a sentence."""
    kind = str(line.get("kind", "?"))
    shown = {
        key: value
        for key, value in line.items()
        if key not in _ENVELOPE and value not in (None, "")
    }
    details = [
        f"{key} {value:.6g}" if isinstance(value, float) else f"{key} {value}"
        for key, value in shown.items()
    ]
    return prose.for_people(f"{kind}: {', '.join(details)}" if details else kind)


class UnknownEvent(Event):
    """An event of an unknown kind, or with unexpected fields."""

    line: EventLine

    @property
    def kind(self) -> str:
        """Kind as in the line; "?" if missing."""
        return str(self.line.get("kind", "?"))

    @property
    def sentence(self) -> str:
        """Its message, else its fields."""
        message = self.line.get("message")
        if isinstance(message, str) and message:
            return prose.fill_template("{message}", {"message": message}) or message
        return list_fields(self.line)

    def to_dict(self) -> EventLine:
        """The line, unchanged."""
        return dict(self.line)
