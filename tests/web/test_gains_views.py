"""What the sliders show: sessions and runs by name, curves, and what is refused."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from membrane_ctrl.config.schema import Config, LoopConfig
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.sessions.folder import create_session
from membrane_ctrl.sessions.live_log import LiveLog
from membrane_ctrl.web.gains_charts import CHARTS
from membrane_ctrl.web.gains_views import GainsViews
from tests.support import review_runs
from tests.worlds.designed_session import PLANT, make_designed_session


def views_of(logs: Path | None) -> GainsViews:
    return GainsViews({"": SimpleNamespace(logs=logs)})  # type: ignore[dict-item]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs with a session that has a design, and one that has only begun."""
    logs = tmp_path_factory.mktemp("logs")
    make_designed_session(logs)
    create_session(logs, "begun", "eve", "twin", Config(), LoopConfig())
    review_runs.written(logs, 0.2)
    return logs


def name_of(folder: Path) -> str:
    (path,) = folder.glob("tuning/*-made")
    return f"tuning/{path.name}"


async def test_sessions_with_a_weather_and_long_runs_are_listed(folder: Path) -> None:
    session, run = await views_of(folder).list_sources("")
    assert session == name_of(folder)
    assert (folder / run / "ticks").is_dir()
    assert await views_of(folder / "none").list_sources("") == []
    with pytest.raises(InputError, match="on another machine"):
        await views_of(None).list_sources("")


@pytest.mark.parametrize(
    "name", ["", "..", "../x", "tuning/../..", "/etc", "tuning//x", "a/b", ".x", "x" * 300, "a\0b"]
)
async def test_names_of_strangers_reach_no_file(folder: Path, name: str) -> None:
    with pytest.raises(InputError):
        await views_of(folder).open_source("", name)


async def test_the_table_and_the_charts_are_of_the_same_gains(folder: Path) -> None:
    views, name = views_of(folder), name_of(folder)
    source = await views.open_source("", name)
    assert source.takes_gains
    assert list(source.settings)[:2] == ["present", "proposed"]
    exact = await views.explore("", name, "proposed", None)
    assert exact.heads == ("present", "proposed", "yours")
    by_title = {title: cells for title, *cells in exact.rows}
    assert by_title["K, 1/s"][1] == by_title["K, 1/s"][2]
    assert exact.refusal == ""
    # SIMC by another way: K = 1 / (k (tc + d))
    moved = await views.explore("", name, "proposed", (2.0, 4.0, 0.1))
    delay_s = moved.loop["ti_s"] / 4.0 - 2.0
    assert moved.loop["kp_per_s"] == pytest.approx(1 / (PLANT.gain * (2.0 + delay_s)), rel=0.1)
    assert delay_s == pytest.approx(PLANT.delay_s + 0.11, rel=0.15)
    charts: dict[str, Any] = json.loads(gzip.decompress(moved.charts))
    assert set(charts) == set(CHARTS)
    step = charts["responses"]["series"][2]["data"]
    assert (charts["responses"]["series"][2]["name"], step[0][1]) == ("yours", 0.0)
    assert step[-1][1] == pytest.approx(1.0, abs=0.02)
    assert "--trial 5m" in moved.command
    far = await views.explore("", name, "present", (1e9, 1e9, 1e9))
    assert far.loop["measurement_filter_s"] == 2.0


async def test_gains_without_margin_are_shown_and_refused(folder: Path) -> None:
    views, name = views_of(folder), name_of(folder)
    lively = await views.explore("", name, "present", (1e-3, 2.0, 0.01))
    assert "Ms" in lively.refusal or lively.refusal == "unstable"
    with pytest.raises(InputError, match="not saved"):
        await views.save("", name, lively.loop, "ada")
    with pytest.raises(InputError, match="not among present, proposed"):
        await views.explore("", name, "best", None)


async def test_a_session_that_runs_takes_no_gains(folder: Path) -> None:
    views, name = views_of(folder), name_of(folder)
    found = await views.explore("", name, "proposed", None)
    log = LiveLog(folder / name, 50.0, print)
    log.log_entry("step", "preview", planned_s=0.0, after_s=60.0)
    with pytest.raises(InputError, match="the session runs"):
        await views.save("", name, found.loop, "ada")
    log.log_entry("ended", "done")
    assert "tune apply" in await views.save("", name, found.loop, "ada")


async def test_a_run_is_explored_with_the_plant_of_the_newest_session(folder: Path) -> None:
    views = views_of(folder)
    run = (await views.list_sources(""))[-1]
    source = await views.open_source("", run)
    assert run in source.text
    assert not source.takes_gains
    assert list(source.settings) == ["present"]
    found = await views.explore("", run, "present", None)
    assert found.heads == ("present", "yours")
    with pytest.raises(InputError, match="only a session"):
        await views.save("", run, found.loop, "ada")
