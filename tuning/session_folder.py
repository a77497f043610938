"""The folder of a session, `<logs>/tuning/<UTC>-<name>/`: what each step left, and which steps are done."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from membrane_ctrl import config_file
from membrane_ctrl.config import Config, LoopConfig
from membrane_ctrl.errors import DeviceError, InputError
from membrane_ctrl.recording.atomic import read_bytes, users, write_text_atomic
from tuning import plain

FORMAT = "membrane-session/1"
STEPS = ("characterise", "identify", "observe", "design", "preview", "apply", "verify")
# What a step leaves; the first file is the sign that it is done.
FILES: dict[str, tuple[str, ...]] = {
    "characterise": ("experiments.json", "experiments.npz"),
    "identify": ("identified.json",),
    "observe": ("disturbance.json", "quiet.npz"),
    "design": ("gains.toml", "proposal.json", "candidates.md"),
    "preview": ("preview.json",),
    "apply": ("applied.json",),
    "verify": ("verified.json", "verify.npz"),
}
_BYTES_MAX = 16_000_000  # a picture is some 100 kB
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


@dataclass(frozen=True, slots=True)
class Head:
    """`session.json`.

    Attributes
    ----------
    format, name, author, source, created_utc : str
        `source` is the run folder or the twin.
    before : LoopConfig
        The last good gains when the session began.
    """

    format: str
    name: str
    author: str
    source: str
    created_utc: str
    before: LoopConfig


@dataclass(frozen=True, slots=True)
class SessionFolder:
    """A session on disk."""

    path: Path
    head: Head
    config: Config

    def file(self, name: str) -> Path:
        """A file in it."""
        return self.path / name

    def content(self, name: str) -> bytes:
        """All of a file that people read. Raises InputError if it is no plain file."""
        path = self.file(name)
        try:
            return read_bytes(users(path), _BYTES_MAX)
        except OSError as error:
            raise InputError(f"{path}: {(error.strerror or str(error)).lower()}") from None

    def candidates(self) -> str:
        """The table of candidates, Markdown of at least a head, a rule and a row. Raises InputError."""
        text = self.content("candidates.md").decode("utf-8", "replace")
        if len(text.splitlines()) < 3:
            raise InputError(f"{self.file('candidates.md')}: damaged; repeat the step design")
        return text

    def done(self, step: str) -> bool:
        """The step has left its result."""
        return self.file(FILES[step][0]).exists()

    def require(self, *steps: str) -> None:
        """Raises InputError naming the first of the steps that is not done."""
        for step in steps:
            if not self.done(step):
                raise InputError(f"{self.path}: {step} is missing; run `membrane-ctrl tune {step}` first")

    def begin(self, step: str) -> None:
        """The step is about to be done (again): what it and the steps behind it left is gone."""
        for later in STEPS[STEPS.index(step) :]:
            for name in FILES[later]:
                self.file(name).unlink(missing_ok=True)


def fresh_folder(parent: Path, name: str, now: datetime) -> Path:
    """Make `<UTC>-<name>` in a folder. Raises InputError for a bad name, DeviceError if it cannot be made."""
    if not _NAME.fullmatch(name):
        raise InputError(
            f"session name {name!r}: use letters, digits, '.', '-' and '_' (at most 64, no '.' in front)"
        )
    stem = f"{now:%Y%m%dT%H%M%SZ}-{name}"
    for number in range(1, 1000):
        path = parent / (stem if number == 1 else f"{stem}-{number}")
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise DeviceError(f"{parent}: cannot be written ({(error.strerror or str(error)).lower()})") from None
        return path
    raise DeviceError(f"{parent}: has a thousand sessions {stem} already")


def create_session(
    logs: Path, name: str, author: str, source: str, config: Config, before: LoopConfig
) -> SessionFolder:
    """Make a session's folder. Raises InputError for a bad name, DeviceError if it cannot be written."""
    now = datetime.now(UTC)
    path = fresh_folder(logs / "tuning", name, now)
    head = Head(FORMAT, name, author, source, now.isoformat(timespec="seconds"), before)
    try:
        plain.write(path / "session.json", head)
        write_text_atomic(path / "config.toml", config_file.dump(config))
    except OSError as error:
        raise DeviceError(f"{logs}: cannot be written ({(error.strerror or str(error)).lower()})") from None
    return SessionFolder(path, head, config)


def open_session(path: Path) -> SessionFolder:
    """An existing session. Raises InputError if it is none."""
    head = plain.read(path / "session.json", Head)
    if head.format != FORMAT:
        raise InputError(f"{path}/session.json: format {head.format!r}, {FORMAT!r} is known")
    return SessionFolder(path, head, config_file.load(path / "config.toml", Config))


def sessions_in(logs: Path) -> list[Path]:
    """All session folders, oldest first."""
    return sorted(path.parent for path in (logs / "tuning").glob("*/session.json"))


def newest_session(logs: Path) -> SessionFolder:
    """The one to go on with. Raises InputError if there is none."""
    found = sessions_in(logs)
    if not found:
        raise InputError(f"{logs / 'tuning'}: no session yet; begin with `membrane-ctrl tune characterise`")
    return open_session(found[-1])
