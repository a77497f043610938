"""Shows one telemetry column wherever people look: a program that a changed copy of the source
runs; prints JSON.

python column_bench.py COLUMN RUN [RUN...]: what console, `ctl status`, bridges and viewer have of a
column; the runs must be finished.
"""

from __future__ import annotations

import io
import json
import math
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from membrane_ctrl.bridges.bridge import Bridge
from membrane_ctrl.bridges.mqtt import discovery
from membrane_ctrl.config.bridges import BridgesConfig
from membrane_ctrl.config.schema import Config
from membrane_ctrl.console.model import ConsoleModel
from membrane_ctrl.console.view import ConsolePage
from membrane_ctrl.control_port.ctl import Where, status_lines
from membrane_ctrl.control_port.server import status_table
from membrane_ctrl.model.run_status import RunStatus
from membrane_ctrl.model.telemetry import TelemetryRow
from membrane_ctrl.recorder.blueprint import run_blueprint
from membrane_ctrl.review.viewer.blueprints import ReviewBlueprint
from membrane_ctrl.run_files.run import open_run
from membrane_ctrl.service.feed import HoldFeed
from membrane_ctrl.service.hold_seen import HoldSeen
from membrane_ctrl.service.metrics import render_metrics
from membrane_ctrl.service.published_signals import signal_values

WIDTH, HEIGHT = 200, 60


def row_with(column: str, value: float) -> TelemetryRow:
    """A row of a mirror that is held, with a value."""
    known = dict.fromkeys(TelemetryRow.__dataclass_fields__, 0.0)
    return replace(TelemetryRow(**known), **{"mono_s": 1.0, "state": 4.0, column: value})


def console_page(row: TelemetryRow) -> str:
    """The console of that row, as text."""
    config = Config()
    model = ConsoleModel(config)
    model.add_row(row)
    console = Console(width=WIDTH, height=HEIGHT, record=True, file=io.StringIO())
    console.print(ConsolePage(model.make_view(row.mono_s), config, "logs/a-run"))
    return console.export_text()


def bridge_values(status: RunStatus, column: str) -> dict[str, Any]:
    """The column among the published values, and its entity for Home Assistant."""
    table = status_table(status)
    seen = HoldSeen("a-run", status=table, seen_s=time.monotonic(), problem="")
    bridge = Bridge(HoldFeed(Where()), Config(bridges=BridgesConfig()))
    return {
        "value": signal_values(seen)[column],
        "entity": discovery(bridge, "membrane/mirror")["components"][column],
    }


def viewer_plots(entity: str) -> dict[str, bool]:
    """Whether the blueprints of a run and of a review draw an entity,
    or the means of its seconds.
    """
    config = Config()
    review = ReviewBlueprint(("",), "utc", None, config).make_blueprint()
    found = {}
    for name, blueprint in (("run", run_blueprint(config)), ("review", review)):
        found[name] = entity in " ".join(_contents(blueprint))
    return found


def _contents(part: Any) -> list[str]:
    """The queries of all views of a blueprint."""
    own = getattr(part, "contents", None)
    if isinstance(own, list) and own and isinstance(own[0], str):
        return list(own)
    inner = [*(own or ())] if isinstance(own, list | tuple) else []
    inner += [getattr(part, name) for name in ("root_container",) if hasattr(part, name)]
    return [query for each in inner for query in _contents(each)]


def recorded(folder: Path, column: str) -> dict[str, float]:
    """Mean of the column's known values in a run: of every tick, and of the levels."""
    run = open_run(folder)
    ticks = [value for value in run.ticks([column]).column(column).to_pylist() if value is not None]
    found = {"ticks": math.fsum(ticks) / len(ticks)}
    for window_s in (1.0, 60.0):
        level = [value for value in run.level(window_s)[f"mean_{column}"] if math.isfinite(value)]
        found[f"{window_s:g} s"] = math.fsum(level) / len(level)
    return found


def main() -> None:
    """Print everything as JSON."""
    column, entity, *runs = sys.argv[1:]
    row = row_with(column, 12.34)
    status = RunStatus().after_row(row)
    seen = HoldSeen("a-run", status=status_table(status), seen_s=math.inf, problem="")
    print(
        json.dumps(
            {
                "console": console_page(row),
                "ctl": status_lines({"run": "a-run", **status_table(status)}),
                "bridge": bridge_values(status, column),
                "metrics": render_metrics({"": seen}).decode(),
                "viewer": viewer_plots(entity),
                "recorded": [recorded(Path(run), column) for run in runs],
            }
        )
    )


if __name__ == "__main__":
    main()
