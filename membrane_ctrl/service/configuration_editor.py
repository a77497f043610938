"""Reads, checks and saves the configurations of a folder, for viewers of the page and programs.

A configuration decides what may move and which files are read, so all of this needs the role
`tune`. Names come from strangers: only plain names of files directly in the folder are taken, and
links are not followed. The former file is kept beside it, in `former/`.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from membrane_ctrl.config import configuration_file
from membrane_ctrl.controller import cross_check
from membrane_ctrl.model import errors, files
from membrane_ctrl.service.hold_starter import is_configuration_name

FORMER_FOLDER = "former"
TEXT_BYTES_MAX = 200_000
_FORMER_MOST = 50  # of a configuration
_FORMER_STAMP = "%Y%m%dT%H%M%S.%fZ"
_DIGEST_DIGITS = 16


@dataclass(frozen=True, slots=True)
class ConfigurationText:
    """A configuration as it is in its file; `digest` identifies this text."""

    name: str
    text: str
    digest: str


@dataclass(frozen=True, slots=True)
class CheckedText:
    """What is wrong with a text: `errors` refuse it, `warnings` do not."""

    errors: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def is_usable(self) -> bool:
        """Whether a hold would accept it, as far as the text shows."""
        return not self.errors


class ConfigurationEditor:
    """The configurations of one folder.

    Parameters
    ----------
    folder : Path
        Its files `NAME.toml` are the configurations; others are left alone.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder.resolve()
        self._lock = threading.Lock()

    def read(self, name: str) -> ConfigurationText:
        """Return a configuration. Raises InputError without one."""
        path = self._find_path(name)
        try:
            text = files.read_text(path, TEXT_BYTES_MAX)
        except OSError as error:
            raise errors.InputError(f"{name}: {errors.os_reason(error)}") from None
        except UnicodeDecodeError:
            raise errors.InputError(f"{name}: not UTF-8 text") from None
        return ConfigurationText(name, text, _digest(text))

    def check(self, name: str, text: str) -> CheckedText:
        """Check a text that is to become a configuration: syntax, values, and how they fit
        together. Devices are checked when a hold starts.

        Parameters
        ----------
        name : str
            Of the configuration.
        text : str
            TOML.

        Returns
        -------
        CheckedText
            The errors and warnings.

        Raises
        ------
        InputError
            The name is wrong.
        """
        path = self._find_path(name)
        if len(text.encode("utf-8", "replace")) > TEXT_BYTES_MAX:
            return CheckedText((f"{name}: longer than {TEXT_BYTES_MAX} bytes",))
        try:
            config = configuration_file.parse_configuration(text, path)
        except errors.CommandError as error:
            return CheckedText(self._without_folder(error.lines))
        except OSError as error:
            return CheckedText((f"{name}: {errors.os_reason(error)}",))
        findings = cross_check.cross_check(config)
        return CheckedText(
            tuple(each.line(name) for each in findings if each.severity == "error"),
            tuple(each.line(name) for each in findings if each.severity == "warning"),
        )

    def save(self, name: str, text: str, digest: str, who: str) -> ConfigurationText:
        """Save a configuration that passes the check, and keep the former file.

        Parameters
        ----------
        name : str
            Of the configuration, which is that of the file without `.toml`.
        text : str
            The whole file, with comments, as the viewer has edited it.
        digest : str
            Of the text that was edited; empty for a new configuration.
        who : str
            For the service's log.

        Returns
        -------
        ConfigurationText
            As saved.

        Raises
        ------
        InputError
            Wrong name; the check finds errors; somebody else has changed the file meanwhile.
        DeviceError
            The folder cannot be written.
        """
        path = self._find_path(name)
        checked = self.check(name, text)
        if not checked.is_usable:
            raise errors.InputError("; ".join(checked.errors))
        # Two people may edit one file: only a text that was made from the present file replaces it
        with self._lock:
            former = self.read(name) if path.exists() or path.is_symlink() else None
            if (former.digest if former is not None else "") != digest:
                raise errors.InputError(
                    f"{name}: another person has changed it meanwhile; load it again"
                )
            with errors.convert_write_errors(path, errors.DeviceError):
                if former is not None:
                    self._keep_former(former)
                mode = path.stat().st_mode & 0o777 if former is not None else 0o640
                files.write_text_atomic(path, text)
                path.chmod(mode)
        print(f"membrane-ctrl serve: {who} has saved {name}", file=sys.stderr, flush=True)
        return ConfigurationText(name, text, _digest(text))

    def list_former(self, name: str) -> list[str]:
        """Return the former files of a configuration, newest first. Raises InputError for a wrong
        name.
        """
        self._find_path(name)
        stamp = re.compile(re.escape(name) + r"-\d{8}T\d{6}\.\d{6}Z\.toml")
        found: list[str] = []
        with contextlib.suppress(OSError):
            found = [
                each.name
                for each in (self._folder / FORMER_FOLDER).iterdir()
                if stamp.fullmatch(each.name)
            ]
        return sorted(found, reverse=True)

    def _keep_former(self, former: ConfigurationText) -> None:
        """Write the former text beside the file; drop the oldest of too many. Raises OSError."""
        folder = files.make_folder(self._folder / FORMER_FOLDER)
        stamp = datetime.now(UTC).strftime(_FORMER_STAMP)
        files.write_text_atomic(folder / f"{former.name}-{stamp}.toml", former.text)
        for name in self.list_former(former.name)[_FORMER_MOST:]:
            (folder / name).unlink(missing_ok=True)

    def _find_path(self, name: str) -> Path:
        if not is_configuration_name(name):
            raise errors.InputError(f"{name[:80]!r}: not the name of a configuration")
        return self._folder / f"{name}.toml"

    def _without_folder(self, lines: Sequence[str]) -> tuple[str, ...]:
        """Return messages that name the file without its folder."""
        return tuple(line.replace(f"{self._folder}/", "") for line in lines)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "backslashreplace")).hexdigest()[:_DIGEST_DIGITS]
