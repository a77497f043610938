"""`run.json` states the format of a run folder and the program that recorded it."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import pytest

from membrane_ctrl.config.schema import Config
from membrane_ctrl.config.toml_file import load_toml
from membrane_ctrl.model.file_checksums import dumps_checked
from membrane_ctrl.model.program import program_identity, stated_program
from membrane_ctrl.run_files.run_folder import create_run_folder
from membrane_ctrl.run_files.run_head import FORMAT, HEAD_FILE, RunHead, read_run_head
from membrane_ctrl.run_files.run_tables import RunTables
from membrane_ctrl.run_files.table_specs import EVENTS
from membrane_ctrl.run_files.table_store.reader import TableReader


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return create_run_folder(tmp_path, "night", datetime(2026, 11, 21, tzinfo=UTC), Config())


def test_a_new_run_states_format_and_program(folder: Path) -> None:
    notes: list[str] = []
    assert read_run_head(folder, notes) == RunHead(FORMAT, program_identity())
    assert notes == []
    assert program_identity() in (folder / "config.toml").read_text()
    assert load_toml(folder / "config.toml", Config) == Config()


def test_a_run_without_head_has_an_unknown_program(tmp_path: Path) -> None:
    notes: list[str] = []
    assert read_run_head(tmp_path, notes) == RunHead()
    assert notes == []


def test_a_later_format_is_named_with_its_program(folder: Path) -> None:
    table = {
        "schema": f"membrane-run/{FORMAT + 1}",
        "program": "membrane-ctrl 7.0",
        "commit": "0123456789ab",
    }
    (folder / HEAD_FILE).write_text(dumps_checked(table))
    notes: list[str] = []
    assert read_run_head(folder, notes) == RunHead(FORMAT + 1, "membrane-ctrl 7.0 (0123456789ab)")
    (note,) = notes
    assert "recorded by membrane-ctrl 7.0 (0123456789ab)" in note


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "null",
        '{"schema": "membrane-run/x"}',
        '{"schema": 1}',
        "[" * 1000,
        "x" * 100_000,
    ],
    ids=["empty", "torn", "list", "null", "no number", "number", "deep", "long"],
)
def test_a_damaged_head_is_noted_and_not_used(folder: Path, text: str) -> None:
    (folder / HEAD_FILE).write_text(text)
    notes: list[str] = []
    assert read_run_head(folder, notes) == RunHead()
    assert len(notes) == 1
    assert notes[0].startswith(HEAD_FILE)


def test_an_edited_head_is_not_used(folder: Path) -> None:
    table = json.loads((folder / HEAD_FILE).read_text())
    (folder / HEAD_FILE).write_text(json.dumps({**table, "program": "membrane-ctrl 9.9"}))
    notes: list[str] = []
    assert read_run_head(folder, notes) == RunHead()
    assert len(notes) == 1


def test_every_table_states_format_program_and_commit(tmp_path: Path) -> None:
    tables = RunTables(tmp_path)
    tables.add_events([{"mono_s": 1.0, "kind": "why", "why": "x"}])
    tables.close()
    found = TableReader(tmp_path, EVENTS, []).read_metadata()
    assert found["schema"] == "membrane-table/1"
    assert stated_program(found) == program_identity()
