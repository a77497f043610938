"""A second pressure gauge costs three places: its role, its telemetry column, the rule that uses
it.

The places are written into a copy of the source. Its driver is one of those of the first gauge.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from changed_source import ChangedSource
from patient_instruments import INSTRUMENTS

pytestmark = [pytest.mark.campaign, pytest.mark.real_time, pytest.mark.timeout(1800)]

ROLE, FIELD, LABEL = "second_gauge", "second_gauge_pressure_pa", "second gauge pressure"
IN_ROLES = f"""\
{FIELD}: float = field(
    default=math.nan, metadata=_declare_sensor("{ROLE}", "gauge_pressure_pa", "Pa")
)
"""
IN_COLUMNS = f"""\
{FIELD}: float = declare_column(
    "{LABEL}",
    "reading of the second gauge",
    GAUGE,
    "/gas/second_pressure",
    decimals=1,
    published=True,
)
"""
IN_SAFETY = f"""\
Rule(
    code=70, name="gauges_apart", cause="the two gauges contradict each other",
    limit="50 Pa", safe_level=SafeLevel.RAMP_DOWN, seen_in=_TWICE,
    remedy="find out which gauge is wrong",
    seen=lambda o: f"{{o.reading.{FIELD} - o.gauge_pressure_pa:+.1f}} Pa",
    broken=lambda o, c: abs(o.reading.{FIELD} - o.gauge_pressure_pa) > 50.0,
    unseen=lambda o: math.isnan(o.reading.{FIELD}),
)
"""
BENCH = Path(__file__).with_name("sensor_role_bench.py")
TABLE = f"""
[devices.{ROLE}]
driver = "mks_937b"
port = "/dev/ttyUSB3"
timeout_s = 0.9
"""


def apply_change(source: ChangedSource) -> None:
    """Make the change in a copy of the source."""
    source.add_field("BenchReading", IN_ROLES)
    source.add_field("ColumnValues", IN_COLUMNS, before="ambient_pressure_pa")
    source.add_row("Rule", IN_SAFETY)
    assert source.count_places() == 3


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> ChangedSource:
    """The product with a second gauge: three places differ."""
    source = ChangedSource.copy_to(tmp_path_factory.mktemp("gauge"))
    source.copy_more("tests", "docs", "benchmarks")
    apply_change(source)
    return source


@pytest.fixture(scope="module")
def lab(source: ChangedSource) -> Path:
    """A configuration of single instruments, with two gauges."""
    path = source.folder / "lab.toml"
    path.write_text(INSTRUMENTS + TABLE)
    return path


@pytest.fixture(scope="module")
def found(source: ChangedSource, lab: Path) -> dict[str, Any]:
    """Everything that the bench program prints."""
    printed: dict[str, Any] = json.loads(source.run_python(BENCH, ROLE, FIELD, lab))
    return printed


def test_configuration_check_and_wizard_have_it(found: dict[str, Any]) -> None:
    assert found["key"]
    assert found["checked"][ROLE] == "600 Pa"
    assert any(question.startswith(f"{ROLE}: driver, ") for question in found["questions"])


def test_the_rule_judges_it(found: dict[str, Any]) -> None:
    assert (found["same"], found["other"], found["missing"]) == ("", "gauges_apart", "")


def mirror_is_held(events: list[dict[str, Any]]) -> bool:
    """Whether the controller has reached the state `hold`."""
    return any(event["kind"] == "state" and event["state"] == "hold" for event in events)


def test_a_hold_records_and_replays_it(source: ChangedSource, lab: Path) -> None:
    logs = source.folder / "logs"
    run_dir = source.hold_until(mirror_is_held, logs, "gauges", "--devices", lab, more_s=10.0)
    source.run_program("export", run_dir)
    ticks = pq.read_table(run_dir / "export" / "ticks.parquet").to_pydict()
    pairs = zip(ticks[FIELD], ticks["gauge_pressure_pa"], strict=True)
    apart_pa = [second - first for second, first in pairs if None not in (first, second)]
    assert len(apart_pa) > 100
    assert abs(math.fsum(apart_pa)) / len(apart_pa) < 1.0
    assert "identical" in source.run_program("replay", run_dir)
    source.run_program("report", run_dir, "--out", source.folder / "report")
    assert (
        f">{LABEL.removesuffix(' pressure')}<"
        in (source.folder / "report" / "report.html").read_text()
    )


def test_a_driver_for_it_is_written(source: ChangedSource) -> None:
    source.run_program("devices", "new", "acme_gauge", "--role", ROLE, "--to", source.folder)
    assert f"[devices.{ROLE}]" in (source.folder / "acme-gauge-driver" / "lab.toml").read_text()


def test_documents_have_it(source: ChangedSource) -> None:
    source.run_python("-m", "tests.support.telemetry_pages")
    source.run_python("-m", "tests.support.faults_page")
    assert (
        f"| `{FIELD}` | Pa | {LABEL} |"
        in (source.folder / "docs" / "reference" / "telemetry.md").read_text()
    )
    assert (
        "| 70 | `gauges_apart` |"
        in (source.folder / "docs" / "reference" / "faults.md").read_text()
    )
    assert f"[devices.{ROLE}]" in source.run_program("config", "reference")
