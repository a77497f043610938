"""A year of ten mirrors at minute levels: its size, and the time and memory of a question to it.

The runs last a week. Their numbers are drawn at random, which no file format makes smaller than
those of a mirror. The question is asked as docs/how-to/data.md shows: the standard deviation of the
error and the change of the figure, by month and mirror.

python -m benchmarks mirror_years
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tempfile
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pyarrow as pa

from membrane_ctrl.run_files import table_specs
from membrane_ctrl.run_files.table_store.disk import Disk
from membrane_ctrl.run_files.table_store.part_writer import write_part
from membrane_ctrl.run_files.table_store.spec import TableSpec, part_path
from tests.support.figures import Figure, at_most

MIRRORS, WEEKS, DAYS = 10, 52, 7
MINUTES = 1440
HOLD = 4
MOST_S, MOST_GB = 10.0, 2.0
_PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "data.md"
_ASKED = """
import json, resource, time
begun_s = time.perf_counter()
{example}
lasted_s = time.perf_counter() - begun_s
peak_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
used = resource.getrusage(resource.RUSAGE_SELF)
print(json.dumps([lasted_s, peak_kb, len(table), used.ru_utime + used.ru_stime]))
"""


def run() -> list[Figure]:
    """The benchmark."""
    with tempfile.TemporaryDirectory() as folder:
        years = Path(folder)
        _write_years(years)
        size_bytes = sum(path.stat().st_size for path in years.rglob("*.parquet"))
        files = sum(1 for _ in years.rglob("*.parquet"))
        lasted_s, peak_kb, rows, used_s = _ask(years)
    months = len({_week(number).strftime("%Y%m") for number in range(WEEKS)})
    if rows != MIRRORS * months:
        raise RuntimeError(f"{rows} rows, not one for each mirror and month")
    return [
        at_most("a year of ten mirrors, minutes of telemetry and figures", size_bytes / 1e9, "GB"),
        at_most("its files", float(files), ""),
        at_most("standard deviation and figure change by month and mirror", lasted_s, "s", MOST_S),
        at_most("... processor time", used_s, "s"),
        at_most("... memory of the program", peak_kb / 1e6, "GB", MOST_GB),
    ]


def _week(number: int) -> datetime:
    return datetime(2026, 1, 1, tzinfo=UTC) + timedelta(weeks=number)


def _write_years(years: Path) -> None:
    """Write the weeks of one mirror, and copy them for the others."""
    rng = np.random.default_rng(1)
    first = years / "mirror0"
    for number in range(WEEKS):
        folder = first / f"{_week(number):%Y%m%dT%H%M%SZ}-week"
        for spec in (table_specs.LEVELS[60.0], table_specs.FIGURE_MINUTES):
            _write_week(folder / spec.name, table_specs.with_origin(spec), rng)
    for number in range(1, MIRRORS):
        shutil.copytree(first, years / f"mirror{number}")


def _write_week(folder: Path, spec: TableSpec, rng: np.random.Generator) -> None:
    folder.mkdir(parents=True)
    for day in range(DAYS):
        time_s = 60.0 * (MINUTES * day + np.arange(MINUTES))
        columns = [_draw_column(field, time_s, rng) for field in spec.schema]
        table = pa.Table.from_arrays(columns, schema=spec.schema)
        write_part(Disk(), part_path(folder, day), day, MINUTES * day, [table], spec.time_name)


def _draw_column(field: pa.Field, time_s: np.ndarray, rng: np.random.Generator) -> pa.Array:
    if field.name == "time_s":
        return pa.array(time_s)
    if field.name == "state":
        return pa.array(np.full(time_s.size, HOLD))
    if pa.types.is_integer(field.type):
        return pa.array(np.full(time_s.size, 30))
    if pa.types.is_fixed_size_list(field.type):
        values = rng.normal(size=time_s.size * field.type.list_size).astype(np.float32)
        return pa.FixedSizeListArray.from_arrays(pa.array(values), type=field.type)
    return pa.array(rng.normal(size=time_s.size), field.type)


def _ask(years: Path) -> tuple[float, float, int, float]:
    """Time, peak memory in kB, rows of the answer, and processor time of the page's example."""
    (example,) = (
        text
        for text in re.findall(r"```python\n(.*?)```", _PAGE.read_text("utf-8"), re.DOTALL)
        if "figures_60s" in text
    )
    answered = subprocess.run(
        [sys.executable, "-c", _ASKED.format(example=example)],
        cwd=years,
        capture_output=True,
        text=True,
        check=True,
    )
    lasted_s, peak_kb, rows, used_s = json.loads(answered.stdout.splitlines()[-1])
    return lasted_s, peak_kb, rows, used_s
