"""Starts holds as programs that outlive the service.

Under systemd, a hold is a unit `membrane-hold@NAME.service`, and NAME is that of its configuration.
Without systemd, it is a program in a session of its own, which no signal to the service's group
reaches. The service is never needed again: it follows the hold by its socket, as it follows a hold
that a person started.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from membrane_ctrl.config import schema, toml_file
from membrane_ctrl.config.port import SOCKET_NAME
from membrane_ctrl.control_port import sockets
from membrane_ctrl.model import errors, files, terminal

TWIN = "twin"
LOG_NAME = "hold.log"
UNIT_PREFIX = "membrane-hold@"
_CONFIGURATION_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_CONFIGURATIONS_MOST = 100
_SYSTEMCTL_S = 120.0  # `Type=notify`: systemctl waits for the first tick
_LOG_BYTES_MAX = 1_000_000
_TAIL_BYTES = 4000
_TAIL_LINES = 5
# ends of which the run's record states the cause
_STATED_BY_RUN = (errors.Exit.DONE, errors.Exit.INTERRUPTED, errors.Exit.SAFETY_TRIP)


@dataclass(frozen=True, slots=True)
class Configuration:
    """What a hold can be started with.

    Attributes
    ----------
    name : str
        Of the file, without `.toml`; `twin` for the simulated bench.
    file : Path or None
        None: the defaults on the simulated bench.
    has_devices : bool
        Whether it names devices; else the hold has the simulated bench.
    problem : str
        Why it cannot be used; empty if it can.
    """

    name: str
    file: Path | None
    has_devices: bool = False
    problem: str = ""


@dataclass(frozen=True, slots=True)
class StartOptions:
    """How a hold is started."""

    standby: bool = False
    clear_faults: bool = False

    @property
    def words(self) -> list[str]:
        """The options of `membrane-ctrl hold`."""
        given = {"--standby": self.standby, "--clear-faults": self.clear_faults}
        return [word for word, is_given in given.items() if is_given]


class HoldStarter:
    """Starts holds, one at a time.

    Parameters
    ----------
    logs : Path
        Folder of their runs.
    configurations : Path
        Folder of their configurations.
    units : bool
        Start units of systemd.
    """

    def __init__(self, logs: Path, configurations: Path, units: bool) -> None:
        self.logs = logs
        self._configurations = configurations
        self._units = units
        # On Linux each thread has a niceness, and a program inherits that of the thread that
        # starts it. This thread begins before the service lowers its own priority.
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="hold starter")
        self._thread.submit(os.getpid).result()
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._failure = ""

    def list_configurations(self) -> list[Configuration]:
        """Return the configurations of the folder by name, those that cannot be read with the
        reason; the simulated bench first, unless holds are units of systemd.
        """
        found = [] if self._units else [Configuration(TWIN, None)]
        with suppress(OSError):
            paths = sorted(self._configurations.glob("*.toml"))[:_CONFIGURATIONS_MOST]
            found += [
                _read_configuration(file) for file in paths if is_configuration_name(file.stem)
            ]
        return [each for each in found if each.has_devices or each.problem or not self._units]

    def find_configuration(self, name: str) -> Configuration:
        """Return a configuration that a hold can be started with. Raises InputError."""
        known = {each.name: each for each in self.list_configurations()}
        chosen = known.get(name)
        if chosen is None:
            raise errors.InputError(
                f"{name}: no such configuration; known: {', '.join(known) or 'none'}"
            )
        if chosen.problem:
            raise errors.InputError(chosen.problem)
        return chosen

    def is_running(self) -> bool:
        """Whether the program that was started last still runs; False for a unit."""
        with self._lock:
            if self._process is None:
                return False
            code = self._process.poll()
            if code is None:
                return True
            self._process = None
            if code < 0:
                name = signal.Signals(-code).name
                self._failure = f"the hold was ended by {name}; its output is in {LOG_NAME}"
            elif code not in _STATED_BY_RUN:
                self._failure = f"the hold ended with code {code}: {self._read_tail()}"
            return False

    @property
    def failure(self) -> str:
        """Why the last start failed; empty if it did not, or while it lasts."""
        self.is_running()
        with self._lock:
            return self._failure

    def can_start(self) -> bool:
        """Whether no hold runs, also none that is about to listen or to end."""
        return not self.is_running() and not sockets.is_listening(self.logs / SOCKET_NAME)

    def start_hold(self, name: str, who: str, options: StartOptions) -> Future[None]:
        """Start a hold with a configuration.

        Parameters
        ----------
        name : str
            Of a configuration.
        who : str
            For the service's log.
        options : StartOptions
            Whether it waits in standby, and clears latched faults.

        Returns
        -------
        Future
            Done when the program is started, or the unit is ready.

        Raises
        ------
        InputError
            No such configuration, or it cannot be used; or a hold runs.
        """
        chosen = self.find_configuration(name)
        if not self.can_start():
            raise errors.InputError("a hold runs already; stop it before")
        words = " ".join([name, *options.words])
        print(f"membrane-ctrl serve: {who} starts a hold: {words}", file=sys.stderr, flush=True)
        start = self._start_unit if self._units else self._start_program
        return self._thread.submit(start, chosen, options)

    def close(self) -> None:
        """Forget a hold that was started; it continues."""
        self._thread.shutdown()
        with self._lock:
            if self._process is not None:
                # it is not ours to wait for: without a code its end would be reported as a leak
                self._process.returncode = 0
                self._process = None

    def _start_unit(self, chosen: Configuration, options: StartOptions) -> None:
        """Start the unit of systemd for a configuration, and wait until it is ready; keeps why it
        failed.
        """
        unit = f"{UNIT_PREFIX}{chosen.name}.service"
        self.note_failure("")
        words = ["systemctl", "--no-ask-password", "start", unit]
        given = options_file(self.logs, chosen.name)
        try:
            # read by the unit at this start only: a restart by systemd has no options
            files.write_text_atomic(given, f"HOLD_OPTIONS={' '.join(options.words)}\n")
            done = subprocess.run(
                words, capture_output=True, text=True, check=False, timeout=_SYSTEMCTL_S
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            self.note_failure(f"systemctl start {unit}: {error}")
            return
        finally:
            given.unlink(missing_ok=True)
        if done.returncode != 0:
            reason = terminal.one_line(done.stderr.strip() or "no reason given")
            self.note_failure(f"{reason} See `journalctl -u {unit}`")

    def _start_program(self, chosen: Configuration, options: StartOptions) -> None:
        """Start the command `hold` in a session of its own, which outlives the service."""
        words = [sys.executable, "-m", "membrane_ctrl", "hold", "--logs", str(self.logs)]
        words += ["--name", chosen.name, *options.words]
        if chosen.file is not None:
            words += ["--config", str(chosen.file)]
        if not chosen.has_devices:
            words.append("--twin")
        self.note_failure("")
        try:
            self.logs.mkdir(parents=True, exist_ok=True)
            # appended, so that `limit_log` may cut it while the hold writes
            flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND | os.O_NOFOLLOW
            handle = os.open(self.logs / LOG_NAME, flags, 0o600)
            with os.fdopen(handle, "wb") as log:
                process = subprocess.Popen(
                    words,
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    start_new_session=True,
                )
        except OSError as error:
            self.note_failure(f"the hold was not started: {errors.os_reason(error)}")
            return
        with self._lock:
            self._process = process

    def limit_log(self) -> None:
        """Empty the log of a hold that was started, if it has become long: a line a second."""
        path = self.logs / LOG_NAME
        with suppress(OSError):
            if path.stat().st_size > _LOG_BYTES_MAX:
                os.truncate(path, 0)

    def note_failure(self, text: str) -> None:
        """Keep why the last start or restart failed; empty: it has not."""
        with self._lock:
            self._failure = text

    def _read_tail(self) -> str:
        """Return the last lines of the hold's log, in one."""
        try:
            with (self.logs / LOG_NAME).open("rb") as file:
                file.seek(0, os.SEEK_END)
                file.seek(max(0, file.tell() - _TAIL_BYTES))
                text = file.read().decode("utf-8", "replace")
        except OSError as error:
            return f"its log cannot be read ({errors.os_reason(error)})"
        return terminal.one_line("; ".join(text.strip().splitlines()[-_TAIL_LINES:]))


def options_file(logs: Path, name: str) -> Path:
    """Return the file from which a unit of systemd takes the options of its next start.

    Parameters
    ----------
    logs : Path
        Folder of the runs, which the service may write.
    name : str
        Name of the configuration, which is the unit's instance.
    """
    return logs / f".start-{name}.env"


def find_name_of_run(run: str, names: Sequence[str]) -> str | None:
    """Return the configuration of a run that the service has started, which has its name.

    Parameters
    ----------
    run : str
        Name of the run folder: `20261121T012345Z-lab`, or `...-lab-2` for the second run that began
        in that second; empty if there was none yet.
    names : sequence of str
        Names of the configurations.

    Returns
    -------
    str or None
        None for a run that was started by hand under another name.
    """
    of_run = run.partition("-")[2]
    if of_run in names:
        return of_run
    first, _, number = of_run.rpartition("-")
    return first if number.isdecimal() and first in names else None


def is_configuration_name(name: str) -> bool:
    """Whether a name may be that of a configuration: it becomes the name of a file and of a run."""
    return name != TWIN and _CONFIGURATION_NAME.fullmatch(name) is not None


def _read_configuration(file: Path) -> Configuration:
    try:
        config = toml_file.load_toml(file, schema.Config)
    except errors.CommandError as error:
        return Configuration(file.stem, file, problem=error.lines[0])
    except OSError as error:
        return Configuration(file.stem, file, problem=f"{file}: {errors.os_reason(error)}")
    return Configuration(file.stem, file, has_devices=config.devices is not None)
