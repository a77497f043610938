"""Events: what happened at a tick, one line each in `events.jsonl`."""

from typing import Any

Event = dict[str, Any]  # one line of events.jsonl, without its times
