"""Tables of the figure that another number of Zernike terms wrote: named and left out, never read
as others.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.run_files import table_specs
from membrane_ctrl.run_files.table_store import journal, spec
from membrane_ctrl.run_files.table_store.reader import TableReader
from membrane_ctrl.run_files.table_store.spec import TableSpec
from membrane_ctrl.run_files.table_store.writer import TableWriter

ROWS = 20


def spec_of(terms: int, stated: bool = True) -> TableSpec:
    """The table of covariances of a program with another number of terms."""
    usual = table_specs.COVARIANCES
    fields = [
        usual.schema.field("time_s"),
        pa.field("covariance_um2", pa.list_(pa.float32(), terms**2)),
    ]
    about = {**(usual.schema.metadata or {}), b"zernike_terms": str(terms).encode()}
    if not stated:
        del about[b"zernike_terms"]
    return replace(usual, schema=pa.schema(fields, metadata=about))


def write_rows(run_dir: Path, table: TableSpec, close: bool) -> Path:
    """Write rows whose every number is its own place; returns the file."""
    writer = TableWriter(run_dir, table)
    size = table.schema.field("covariance_um2").type.list_size
    values = pa.array(np.arange(ROWS * size, dtype=np.float32))
    columns = [pa.array(np.arange(float(ROWS))), pa.FixedSizeListArray.from_arrays(values, size)]
    writer.add_rows(pa.record_batch(columns, schema=table.schema))
    writer.sync_rows()
    if close:
        writer.close()
    place = spec.part_path if close else spec.journal_path
    return place(run_dir / table.name, 0)


def read_rows(run_dir: Path) -> tuple[int, list[str]]:
    """Number of readable rows, and the notes."""
    notes: list[str] = []
    tables = list(TableReader(run_dir, table_specs.COVARIANCES, notes).iterate_tables())
    return sum(table.num_rows for table in tables if "covariance_um2" in table.column_names), notes


@pytest.mark.parametrize("close", [False, True], ids=["journal", "part"])
@pytest.mark.parametrize("terms", [ZERNIKE_TERMS - 1, ZERNIKE_TERMS + 1, 2 * ZERNIKE_TERMS])
def test_another_number_is_named(tmp_path: Path, terms: int, close: bool) -> None:
    path = write_rows(tmp_path, spec_of(terms), close)
    wanted = (
        f"covariances/{path.name}: written with zernike terms = {terms}, this program has "
        f"{ZERNIKE_TERMS}: left out"
    )
    assert read_rows(tmp_path) == (0, [wanted])


@pytest.mark.parametrize("close", [False, True], ids=["journal", "part"])
def test_the_own_number_is_read(tmp_path: Path, close: bool) -> None:
    write_rows(tmp_path, table_specs.COVARIANCES, close)
    assert read_rows(tmp_path) == (ROWS, [])


@pytest.mark.parametrize("close", [False, True], ids=["journal", "part"])
def test_a_file_that_states_no_number_is_read_by_the_size_of_its_lists(
    tmp_path: Path, close: bool
) -> None:
    path = write_rows(tmp_path, spec_of(ZERNIKE_TERMS + 1, stated=False), close)
    assert read_rows(tmp_path) == (0, [f"covariances/{path.name}: without covariance_um2"])


@pytest.mark.parametrize("terms", [ZERNIKE_TERMS - 1, ZERNIKE_TERMS + 1, 2 * ZERNIKE_TERMS])
def test_rows_without_their_schema_are_not_cut_at_other_places(tmp_path: Path, terms: int) -> None:
    """Arrow reads lists of 66 numbers as lists of 36, if nothing compares their lengths."""
    path = write_rows(tmp_path, spec_of(terms), close=False)
    data = path.read_bytes()
    schema_frame = journal.find_frames(data)[0]
    path.write_bytes(bytes(schema_frame.end) + data[schema_frame.end :])
    rows, notes = read_rows(tmp_path)
    assert rows == 0
    assert len(notes) == 1
