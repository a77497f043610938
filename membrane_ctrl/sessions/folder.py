"""The folder of a session, `<logs>/tuning/<UTC>-<name>/`: the results of its steps, and which steps
are done.
"""

import re
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import (
    Protocol,
    TypeVar,
)

from membrane_ctrl.config import schema, toml_file
from membrane_ctrl.model import errors, files
from membrane_ctrl.sessions.session_json import SCHEMA, T, read_session_file, write_session_file

STEPS = ("characterise", "identify", "observe", "design", "preview", "apply", "verify")
# The results of a step; the first file marks it as done.
FILES: dict[str, tuple[str, ...]] = {
    "characterise": ("experiments.json", "experiments.npz", "held.npz"),
    "identify": ("identified.json",),
    "observe": ("disturbance.json", "quiet.npz"),
    "design": ("gains.toml", "proposal.json", "candidates.md"),
    "preview": ("preview.json",),
    "apply": ("applied.json",),
    "verify": ("verified.json", "verify.npz"),
}
_BYTES_MAX = 16_000_000  # a picture is some 100 kB
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
H = TypeVar("H", bound="Head")


@dataclass(frozen=True, slots=True)
class SessionHead:
    """`session.json`."""

    name: str
    author: str
    source: str  # a run folder, or the twin
    created_utc: str
    before: schema.LoopConfig  # the last good gains when the session began


@dataclass(frozen=True, slots=True)
class SessionFolder:
    """A session on disk."""

    path: Path
    head: SessionHead
    config: schema.Config

    def file_path(self, name: str) -> Path:
        """Path of a file in the folder."""
        return self.path / name

    def read_content(self, name: str) -> bytes:
        """The content of a file for people. Raises InputError if it is not a regular file."""
        path = self.file_path(name)
        try:
            return files.read_bytes(files.resolve_user_path(path), _BYTES_MAX)
        except OSError as error:
            raise errors.InputError(f"{path}: {errors.os_reason(error)}") from None

    def read_candidates(self) -> str:
        """The table of candidates, Markdown with at least a head, a rule and a row. Raises
        InputError.
        """
        text = self.read_content("candidates.md").decode("utf-8", "replace")
        if len(text.splitlines()) < 3:
            raise errors.InputError(
                f"{self.file_path('candidates.md')}: damaged; repeat the step design"
            )
        return text

    def read_result(self, step: str, name: str, kind: type[T]) -> T:
        """Read a step's result.

        Parameters
        ----------
        step : str
            Name of the step that makes the file, for the error.
        name : str
            Of its file.
        kind : type
            What the file holds.

        Raises
        ------
        InputError
            If the step is not done, or the file is damaged.
        """
        self.require_done(step)
        return read_session_file(self.file_path(name), kind)

    def is_done(self, step: str) -> bool:
        """Whether the step has left its result."""
        return self.file_path(FILES[step][0]).exists()

    def require_done(self, *steps: str) -> None:
        """Raises InputError naming the first step that is not done."""
        for step in steps:
            if not self.is_done(step):
                raise errors.InputError(
                    f"{self.path}: {step} is missing; run `membrane-ctrl tune {step}` first"
                )

    def begin_step(self, step: str) -> None:
        """Prepare a step, possibly again: remove its results and those of later steps."""
        for later in STEPS[STEPS.index(step) :]:
            for name in FILES[later]:
                try:
                    self.file_path(name).unlink(missing_ok=True)
                except OSError as error:  # a folder in its place
                    raise errors.InputError(
                        f"{self.file_path(name)}: cannot be removed ({errors.os_reason(error)})"
                    ) from None


def restart_session(
    session: SessionFolder, before: schema.LoopConfig, pump: schema.PumpConfig
) -> SessionFolder:
    """Restart the session on other gains and another curve of the pump, which are in use.

    Parameters
    ----------
    session : SessionFolder
        Its later steps are not done any more.
    before : LoopConfig
        The gains from which it starts.
    pump : PumpConfig
        The curve.
    """
    session.begin_step(STEPS[0])
    head = replace(session.head, before=before)
    config = session.config.model_copy(update={"loop": before, "pump": pump})
    files.write_text_atomic(session.file_path("config.toml"), toml_file.dump_toml(config))
    write_session_file(session.file_path("session.json"), head)
    return SessionFolder(session.path, head, config)


def make_session_folder(parent: Path, name: str, now: datetime) -> Path:
    """Make `<UTC>-<name>` in a folder.

    Parameters
    ----------
    parent : Path
        Folder of the sessions; made if it is missing.
    name : str
        1 to 64 letters, digits, dots, dashes and underscores, no dot in front.
    now : datetime
        In UTC; a second session of this second and name gets the suffix `-2`.

    Raises
    ------
    InputError
        The name has other characters.
    DeviceError
        The folder cannot be written.
    """
    if not _NAME.fullmatch(name):
        raise errors.InputError(
            f"session name {name!r}: use letters, digits, '.', '-' and '_' (at most 64, no "
            "'.' in front)"
        )
    stem = f"{now:%Y%m%dT%H%M%SZ}-{name}"
    for number in range(1, 1000):
        path = parent / (stem if number == 1 else f"{stem}-{number}")
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise errors.DeviceError(
                f"{parent}: cannot be written ({errors.os_reason(error)})"
            ) from None
        return path
    raise errors.DeviceError(f"{parent}: already has a thousand sessions {stem}")


class Head(Protocol):
    """The fields common to every kind of `session.json`."""

    @property
    def created_utc(self) -> str:
        """ISO 8601."""
        ...


def begin_session(
    parent: Path, name: str, head: Head, config: schema.Config, head_schema: str = SCHEMA
) -> Path:
    """Make the folder of a session.

    Parameters
    ----------
    parent : path
        Folder of the sessions.
    name : str
        1 to 64 letters, digits, dots, dashes and underscores; the folder gets the time in front.
    head : Head
        Content of its `session.json`.
    config : Config
        As the hold has it, stored beside the head.
    head_schema : str
        Format of that file, with its version.

    Raises
    ------
    InputError
        For a bad name.
    DeviceError
        If it cannot be written.
    """
    path = make_session_folder(parent, name, datetime.fromisoformat(head.created_utc))
    with errors.convert_write_errors(path, errors.DeviceError):
        files.write_text_atomic(path / "config.toml", toml_file.dump_toml(config))
        write_session_file(path / "session.json", head, head_schema)
    return path


def read_session(path: Path, kind: type[H], head_schema: str = SCHEMA) -> tuple[H, schema.Config]:
    """Read head and configuration of a session.

    Parameters
    ----------
    path : path
        Folder of the session.
    kind : type
        Of the head.
    head_schema : str
        Format that its `session.json` must have.

    Raises
    ------
    InputError
        If it is not one.
    """
    head = read_session_file(path / "session.json", kind, head_schema)
    return head, toml_file.load_toml(path / "config.toml", schema.Config)


def now_utc() -> str:
    """ISO 8601, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def create_session(
    logs: Path,
    name: str,
    author: str,
    source: str,
    config: schema.Config,
    before: schema.LoopConfig,
) -> SessionFolder:
    """Start a tuning session.

    Parameters
    ----------
    logs : path
        Folder of the runs.
    name, author : str
        Of the session's folder, and who tunes.
    source : str
        Name of the hold, or "twin".
    config : Config
        As the hold, or the twin, has it.
    before : LoopConfig
        The gains in use.

    Raises
    ------
    InputError, DeviceError
        As `begin_session`.
    """
    head = SessionHead(name, author, source, now_utc(), before)
    return SessionFolder(begin_session(logs / "tuning", name, head, config), head, config)


def open_session(path: Path) -> SessionFolder:
    """Open an existing tuning session. Raises InputError if it is not one."""
    return SessionFolder(path, *read_session(path, SessionHead))


def find_newest_session(logs: Path) -> SessionFolder:
    """The newest session, to continue. Raises InputError if there is none."""
    found = max((logs / "tuning").glob("*/session.json"), default=None)
    if found is None:
        raise errors.InputError(
            f"{logs / 'tuning'}: no session yet; start with `membrane-ctrl tune characterise`"
        )
    return open_session(found.parent)
