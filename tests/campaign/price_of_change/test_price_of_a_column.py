"""A new telemetry column costs one row of the table and the line that computes it.

The two are written into a copy of the source. Then the column is in the run's tables, in recording
and viewer, in the report, on page and console, at the bridges and in the documentation.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from changed_source import ChangedSource

from tests.support.machine_needs import needs
from tests.support.rrd_reading import entities, scalars

pytestmark = [pytest.mark.campaign, pytest.mark.timeout(1800)]

COLUMN, ENTITY, LABEL = "gas_warmth_c", "/gas/warmth", "warmth of the gas"
ROW = f"""\
{COLUMN}: float = declare_column(
    "{LABEL}",
    "gas less air temperature",
    Plot("Warmth", Group.ENVIRONMENT),
    "{ENTITY}",
    published=True,
)
"""
COMPUTED = f"{COLUMN}=reading.gas_temperature_c - reading.air_temperature_c"
BENCH = Path(__file__).with_name("column_bench.py")
SCENARIO = """
title = "A mirror that is held while the air becomes warmer"
duration_s = 150.0
[config.twin]
scenario = "quiet"
start_error_um = -3.0
[[at]]
time_s = 0.0
event = "daily_temperature"
value = 1.0
[expect]
exit = "done"
faults = []
"""
PAGE = f'''
import pytest
from tests.web import test_page
from tests.worlds import port_run
from dataclasses import replace

@pytest.mark.real_time
async def test_the_page_has_the_column(tmp_path, monkeypatch):
    monkeypatch.setattr(port_run, "ROW", replace(port_run.ROW, {COLUMN}=12.34))
    async with test_page.viewed(tmp_path) as (run, tab):
        await tab.until("document.querySelector('[data-field={COLUMN}]').innerText === '12.34'")
        assert "{LABEL}, °C" in await tab.value("document.body.innerText")
        chart = "/chart?hold=&signals={COLUMN}&span=10+min&utc=True"
        assert await tab.value(f"fetch('{{chart}}').then(r => r.status)") == 200
'''


def apply_change(source: ChangedSource) -> None:
    """Make the change in a copy of the source."""
    source.add_field("ColumnValues", ROW, before="error_um")
    source.add_argument("TelemetryRow", "trim_um", COMPUTED)
    assert source.count_places() == 2


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> ChangedSource:
    """The product with one more column: two places differ."""
    source = ChangedSource.copy_to(tmp_path_factory.mktemp("column"))
    source.copy_more("tests", "docs", "benchmarks")
    apply_change(source)
    return source


@pytest.fixture(scope="module")
def run_dir(source: ChangedSource) -> Path:
    """A run of the twin."""
    scenario = source.folder / "warm.toml"
    scenario.write_text(SCENARIO)
    source.run_program("twin", "play", scenario, "--logs", source.folder / "logs")
    (run_dir,) = (source.folder / "logs").glob("*-warm")
    return run_dir


@pytest.fixture(scope="module")
def shown(source: ChangedSource, run_dir: Path) -> dict[str, Any]:
    """Everything that the bench program prints."""
    found: dict[str, Any] = json.loads(source.run_python(BENCH, COLUMN, ENTITY, run_dir))
    return found


def test_tables_have_it(shown: dict[str, Any]) -> None:
    (means_c,) = shown["recorded"]
    assert means_c["1 s"] == pytest.approx(means_c["ticks"], abs=1e-4)
    assert means_c["60 s"] == pytest.approx(means_c["ticks"], abs=0.01)


def test_the_recording_and_the_viewer_have_it(shown: dict[str, Any], run_dir: Path) -> None:
    for part in sorted(run_dir.glob("*.rrd")):
        assert {ENTITY, f"/overview{ENTITY}"} <= entities(part)
        _, values = scalars(part, ENTITY)
        assert len(values) > 100
    assert shown["viewer"] == {"run": True, "review": True}


def test_the_report_draws_it(source: ChangedSource, run_dir: Path) -> None:
    source.run_program("report", run_dir, "--out", source.folder / "report")
    assert ">Warmth, °C<" in (source.folder / "report" / "report.html").read_text()


def test_console_and_ctl_show_it(shown: dict[str, Any]) -> None:
    assert f"{LABEL} 12.34 °C" in shown["console"]
    assert [LABEL, "12.34", "°C"] in [line.strip().rsplit(maxsplit=2) for line in shown["ctl"]]


def test_bridges_and_metrics_have_it(shown: dict[str, Any]) -> None:
    assert shown["bridge"]["value"] == 12.34
    entity = shown["bridge"]["entity"]
    assert (entity["unit_of_measurement"], entity["device_class"]) == ("°C", "temperature")
    assert f'membrane_{COLUMN}{{hold=""}} 12.34\n' in shown["metrics"]


def test_documents_and_dashboard_have_it(source: ChangedSource) -> None:
    source.run_python("-m", "tests.support.telemetry_pages")
    assert (
        f"| `{COLUMN}` | °C | {LABEL} |"
        in (source.folder / "docs" / "reference" / "telemetry.md").read_text()
    )
    assert f"| `{COLUMN}` | °C |" in (source.folder / "docs" / "how-to" / "bridges.md").read_text()
    assert (
        f"membrane_{COLUMN}{{"
        in (source.folder / "membrane_ctrl" / "examples" / "grafana.json").read_text()
    )


@needs("chromium")
@pytest.mark.real_time
def test_the_page_shows_it(source: ChangedSource) -> None:
    test = source.folder / "tests" / "web" / "test_new_column.py"
    test.write_text(PAGE)
    source.run_python(
        "-m", "pytest", "-q", "-p", "no:cacheprovider", "-o", "asyncio_mode=auto", test
    )


def test_a_replay_decides_the_same(source: ChangedSource, run_dir: Path) -> None:
    assert "identical" in source.run_program("replay", run_dir)
