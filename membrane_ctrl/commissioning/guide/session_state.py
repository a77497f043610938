"""What a commissioning session remembers: `session.json` in its folder, written after each answer.

The configuration is beside it, `lab.toml`: that file, with what a person changed in it, is what the
next stage starts from.
"""

from enum import StrEnum
from pathlib import Path
from typing import Any

import tomli_w
from pydantic import BaseModel, ConfigDict, ValidationError

from membrane_ctrl.commissioning.guide.mirror_design import MirrorFacts
from membrane_ctrl.config import toml_file
from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import errors, files

_SCHEMA = "membrane-commissioning/1"
_NAME, CONFIGURATION = "session.json", "lab.toml"
HTML, PDF = "report.html", "report.pdf"
_HEAD = (
    "# Written by `membrane-ctrl commission`; `membrane-ctrl config explain KEY` explains a key.\n"
)
TomlTable = dict[str, Any]


class CheckVerdict(StrEnum):
    """The result of a check."""

    PASSED = "passed"
    FAILED = "failed"
    NOT_DONE = "not done"
    NOTED = "noted"


class CheckRecord(BaseModel):
    """One measured or confirmed fact."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    measured: str
    verdict: CheckVerdict
    limit: str = ""
    remedy: str = ""


class StageRecord(BaseModel):
    """A finished stage."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    stage: str
    finished_utc: str
    checks: tuple[CheckRecord, ...] = ()

    @property
    def failed(self) -> tuple[CheckRecord, ...]:
        """Its failed checks."""
        return tuple(check for check in self.checks if check.verdict == CheckVerdict.FAILED)


class SessionState(BaseModel):
    """The state of a session."""

    model_config = ConfigDict(extra="forbid")

    schema_name: str = _SCHEMA
    created_utc: str
    author: str
    simulated: bool
    answers: dict[str, str] = {}
    records: list[StageRecord] = []
    facts: MirrorFacts | None = None
    lent: dict[str, float | bool] = {}
    """Configuration keys that a stage has changed for its own time, with their values before."""

    def find_record(self, stage: str) -> StageRecord | None:
        """The record of a stage, if it is finished."""
        return next((record for record in self.records if record.stage == stage), None)

    def add_record(self, record: StageRecord) -> None:
        """Add a record in place of an earlier one of the same stage."""
        self.remove_record(record.stage)
        self.records.append(record)

    def remove_record(self, stage: str) -> None:
        """Forget that a stage was finished."""
        self.records[:] = [record for record in self.records if record.stage != stage]


def read_state(folder: Path) -> SessionState | None:
    """Read the state of a session; None if the folder has none.

    Raises InputError for a damaged file or one of another version.
    """
    path = folder / _NAME
    try:
        text = files.read_text(path)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise errors.InputError(f"{path}: cannot be read ({errors.os_reason(error)})") from None
    try:
        state = SessionState.model_validate_json(text)
    except ValidationError:
        raise errors.InputError(
            f"{path}: damaged; name another folder, or remove this file to begin again"
        ) from None
    if state.schema_name != _SCHEMA:
        raise errors.InputError(f"{path}: format {state.schema_name}, expected {_SCHEMA}")
    return state


def write_state(folder: Path, state: SessionState) -> None:
    """Write the state durably, in place of the former one.

    Parameters
    ----------
    folder : Path
        Of the session; gets `session.json`.
    state : SessionState
        All of it.

    Raises
    ------
    DeviceError
        The file cannot be written.
    """
    path = folder / _NAME
    with errors.convert_write_errors(path, errors.DeviceError):
        files.write_text_atomic(path, state.model_dump_json(indent=1) + "\n")


def read_tables(folder: Path) -> TomlTable:
    """The tables of the session's configuration; empty before it is written."""
    path = folder / CONFIGURATION
    if not path.exists():
        return {}
    return toml_file.read_toml(path)


def write_tables(folder: Path, tables: TomlTable) -> Config:
    """Check tables, then write them durably as the session's configuration.

    Parameters
    ----------
    folder : Path
        Of the session; gets `lab.toml`.
    tables : TomlTable
        The whole configuration; comments of the former file are lost.

    Returns
    -------
    Config
        The tables with all defaults.

    Raises
    ------
    InputError
        The tables are refused; the file stays as it is.
    DeviceError
        The file cannot be written.
    """
    path = folder / CONFIGURATION
    config = toml_file.parse_tables(tables, Config, str(path))
    with errors.convert_write_errors(path, errors.DeviceError):
        files.write_text_atomic(path, _HEAD + tomli_w.dumps(tables))
    return config


def set_keys(tables: TomlTable, table: str, **keys: Any) -> None:
    """Set keys in place.

    Parameters
    ----------
    tables : TomlTable
        The whole configuration; changed.
    table : str
        Dotted name, such as `optics.mirror`; missing tables are added.
    **keys : object
        Values that TOML can hold.
    """
    target = tables
    for name in table.split("."):
        target = target.setdefault(name, {})
    target.update(keys)


def restore_lent_keys(
    folder: Path, state: SessionState, names: tuple[str, ...] | None = None
) -> tuple[str, ...]:
    """Write back what a stage has changed for its own time.

    A stage does it at its end. What is killed meanwhile leaves it to the next start.

    Parameters
    ----------
    folder : Path
        Of the session.
    state : SessionState
        Holds the lent keys with their former values; changed and stored.
    names : tuple of str, optional
        Of the keys; all by default.

    Returns
    -------
    tuple of str
        The names of the keys that were restored.

    Raises
    ------
    InputError, DeviceError
        A file is damaged or cannot be written.
    """
    lent = {name: state.lent[name] for name in names or tuple(state.lent)}
    if not lent:
        return ()
    tables = read_tables(folder)
    for name, value in lent.items():
        table, _, key = name.rpartition(".")
        set_keys(tables, table, **{key: value})
    write_tables(folder, tables)
    for name in lent:
        del state.lent[name]
    write_state(folder, state)
    return tuple(lent)
