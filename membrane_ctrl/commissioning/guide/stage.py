"""A stage of a session: what it does, what must be seen, and its checks."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from membrane_ctrl.commissioning.guide.bench_access import BenchAccess
from membrane_ctrl.commissioning.guide.dialogue import Dialogue
from membrane_ctrl.commissioning.guide.mirror_design import MirrorFacts
from membrane_ctrl.commissioning.guide.session_state import (
    CheckRecord,
    CheckVerdict,
    SessionState,
    TomlTable,
    read_tables,
    restore_lent_keys,
    set_keys,
    write_state,
    write_tables,
)
from membrane_ctrl.commissioning.guide.threshold import Threshold
from membrane_ctrl.config import toml_file
from membrane_ctrl.config.schema import Config, DevicesConfig
from membrane_ctrl.model import errors


class StageFailedError(Exception):
    """A stage cannot be finished; the message states why and what to do."""


@dataclass(frozen=True, slots=True)
class SessionPlan:
    """How long a session measures.

    Attributes
    ----------
    inflation_shares : tuple of float
        Depths at which the first inflation waits for a person, as shares of the sag.
    settled_s : float
        Time held at each before it is measured.
    leak_s : float
        Time with the pump off, in which the leak lowers the mirror.
    hold_s : float
        Time of the last hold.
    """

    inflation_shares: tuple[float, ...] = (0.1, 0.35, 0.6, 0.8, 0.9, 1.0)
    settled_s: float = 20.0
    leak_s: float = 60.0
    hold_s: float = 3600.0


@dataclass(slots=True)
class StageContext:
    """What a stage works with; it collects the stage's checks."""

    folder: Path
    state: SessionState
    dialogue: Dialogue
    access: BenchAccess
    plan: SessionPlan = SessionPlan()
    checks: list[CheckRecord] = field(default_factory=list)

    @property
    def facts(self) -> MirrorFacts:
        """The mirror's data, stated in the first stage."""
        if self.state.facts is None:
            raise StageFailedError("the mirror's data are missing: go back to the first stage")
        return self.state.facts

    @property
    def config(self) -> Config:
        """The configuration as it is in the session's folder."""
        return toml_file.parse_tables(read_tables(self.folder), Config, str(self.folder))

    @property
    def devices(self) -> DevicesConfig:
        """The configured devices."""
        devices = self.config.devices
        if devices is None:
            raise StageFailedError("no devices are configured: go back to the stage `devices`")
        return devices

    def set_keys(self, table: str, **keys: Any) -> None:
        """Set keys of a table in the configuration file; the other keys stay.

        Parameters
        ----------
        table : str
            Dotted name, such as `optics.mirror`; it may be missing.
        **keys : object
            Values that TOML can hold, in the units of their keys.

        Raises
        ------
        StageFailedError
            The configuration would be refused; the file stays as it is.
        """
        tables = read_tables(self.folder)
        set_keys(tables, table, **keys)
        self._write(tables)

    @contextlib.contextmanager
    def lend_keys(self, table: str, **keys: float | bool) -> Iterator[None]:
        """Change keys of a table for a time; a killed session restores them at its next start.

        Parameters
        ----------
        table : str
            A top-level table, such as `limits`.
        **keys : float or bool
            Values for the block, in the units of their keys.
        """
        # The former values are on the disk before the file changes: whenever the process dies,
        # the next start knows what to restore.
        present = getattr(self.config, table)
        names = tuple(f"{table}.{key}" for key in keys)
        self.state.lent |= {f"{table}.{key}": getattr(present, key) for key in keys}
        write_state(self.folder, self.state)
        self.set_keys(table, **keys)
        try:
            yield
        finally:
            restore_lent_keys(self.folder, self.state, names)

    def remove_keys(self, table: str, *names: str) -> None:
        """Remove keys or tables from the configuration file, so that their defaults apply.

        Parameters
        ----------
        table : str
            Dotted name of the table that holds them, such as `optics.mirror`; it may be missing.
        *names : str
            Such as `front_film`; those that are not there are left out.
        """
        tables = read_tables(self.folder)
        target = tables
        for part in table.split("."):
            target = target.get(part, {})
        removed = [name for name in names if target.pop(name, None) is not None]
        if removed:
            self._write(tables)

    def replace_table(self, table: str, content: TomlTable) -> None:
        """Replace a top-level table of the configuration file.

        Parameters
        ----------
        table : str
            Such as `devices`; added if it is missing.
        content : TomlTable
            All its keys: none of the former ones stays.

        Raises
        ------
        StageFailedError
            The configuration would be refused; the file stays as it is.
        """
        tables = read_tables(self.folder)
        tables[table] = content
        self._write(tables)

    def judge(self, name: str, measured: float, threshold: Threshold, remedy: str = "") -> bool:
        """Record a measured value against its limit.

        Parameters
        ----------
        name : str
            What was measured, as the report names it.
        measured : float
            In the unit of the threshold.
        threshold : Threshold
            Its limit.
        remedy : str
            What to do if it is not met.

        Returns
        -------
        bool
            Whether it is met.
        """
        is_met = threshold.is_met(measured)
        verdict = CheckVerdict.PASSED if is_met else CheckVerdict.FAILED
        text = f"{measured:.3g} {threshold.unit}".rstrip()
        self._add(
            CheckRecord(
                name=name,
                measured=text,
                verdict=verdict,
                limit=threshold.words,
                remedy="" if is_met else remedy,
            )
        )
        return is_met

    def require(self, name: str, is_right: bool, seen: str, remedy: str = "") -> bool:
        """Record what was seen, as passed or failed.

        Parameters
        ----------
        name : str
            What was checked, as the report names it.
        is_right : bool
            Whether it passed.
        seen : str
            What was seen, in words.
        remedy : str
            What to do if it did not pass.

        Returns
        -------
        bool
            Whether it passed.
        """
        verdict = CheckVerdict.PASSED if is_right else CheckVerdict.FAILED
        self._add(
            CheckRecord(
                name=name, measured=seen, verdict=verdict, remedy="" if is_right else remedy
            )
        )
        return is_right

    def note(self, name: str, seen: str) -> None:
        """Record a fact without a verdict.

        Parameters
        ----------
        name : str
            What it is about, as the report names it.
        seen : str
            The fact, with its unit.
        """
        self._add(CheckRecord(name=name, measured=seen, verdict=CheckVerdict.NOTED))

    def leave_out(self, name: str, why: str) -> None:
        """Record that a check was not done; the bench is then not accepted.

        Parameters
        ----------
        name : str
            The check, as the report names it.
        why : str
            The reason, for the person who reads the report.
        """
        self._add(CheckRecord(name=name, measured=why, verdict=CheckVerdict.NOT_DONE))

    def _add(self, check: CheckRecord) -> None:
        self.checks.append(check)
        self.dialogue.display.show_check(check)

    def _write(self, tables: TomlTable) -> None:
        try:
            write_tables(self.folder, tables)
        except errors.InputError as error:
            raise StageFailedError(str(error)) from None


@dataclass(frozen=True, slots=True)
class CommissioningStage:
    """One stage.

    Attributes
    ----------
    step : int
        Number of its step in the session, from 1.
    name : str
        Key in the session's state.
    does, look_for : str
        For people: what it does, and what must be seen.
    run : callable
        Asks, acts and records checks.
    must_pass : bool
        Whether a failed check keeps the session from the next stage: gas may not move then.
    is_needed : callable
        Whether the bench has what it tests.
    """

    step: int
    name: str
    does: str
    look_for: str
    run: Callable[[StageContext], None]
    must_pass: bool = False
    is_needed: Callable[[SessionState, TomlTable], bool] = lambda state, tables: True
