"""What an installation adds to the system: the units of the service, of each hold and of guided
sessions, the rule that lets the service start holds, access to instruments and cameras, and
real-time limits.

The files are written from the files in `examples/`, with the path of this program and its user.
"""

from __future__ import annotations

import grp
import pwd
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from membrane_ctrl.model import errors, files

EXAMPLES = Path(__file__).parents[1] / "examples"
USER = "membrane"
SERVICE_UNIT = "membrane-service.service"
HOLD_UNIT = "membrane-hold@.service"
SESSION_UNIT = "membrane-commission@.service"
SESSION_LISTENER = "membrane-commission.socket"
_STATE = "/var/lib/membrane-ctrl"
_CONFIGURATIONS = "/etc/membrane-ctrl"
_PROGRAM = "/opt/membrane-ctrl/.venv/bin/membrane-ctrl"
_TARGETS = {
    SERVICE_UNIT: "etc/systemd/system",
    HOLD_UNIT: "etc/systemd/system",
    SESSION_UNIT: "etc/systemd/system",
    SESSION_LISTENER: "etc/systemd/system",
    "50-membrane-ctrl.rules": "etc/polkit-1/rules.d",
    "70-membrane-ctrl.rules": "etc/udev/rules.d",
    "50-membrane-ctrl-limits.conf": "etc/security/limits.d",
    "50-membrane-ctrl-sysctl.conf": "etc/sysctl.d",
}
# Groups of serial ports and GPIO lines, and of cameras
_DEVICE_GROUPS = ("dialout", "video")
# Of the rules of udev: what is plugged in already gets its group without being plugged in again
_DEVICE_SUBSYSTEMS = ("tty", "usb", "video4linux", "gpio")
_SETTINGS = "service.toml"
_SETTINGS_TEXT = f"""# Settings of the service (docs/how-to/service.md).
logs = "{_STATE}/logs"
configurations = "{_CONFIGURATIONS}"
commissioning = "{_STATE}/commissioning"
units = true
"""
_UNIT_SYNTAX = frozenset(" \t\"'\\%$")  # characters with a meaning in a line of a unit


@dataclass(frozen=True, slots=True)
class InstalledFile:
    """A file that `service install` writes."""

    path: Path
    text: str


def list_files(root: Path, program: Path) -> list[InstalledFile]:
    """Return the files of the installation.

    Parameters
    ----------
    root : Path
        `/`, or the folder of a package or an image.
    program : Path
        `membrane-ctrl`, as the units call it.
    """
    return [
        InstalledFile(
            root / folder / name,
            files.read_text(EXAMPLES / name).replace(_PROGRAM, str(program)),
        )
        for name, folder in _TARGETS.items()
    ]


def install_units(root: Path, program: Path) -> list[Path]:
    """Write units, rules, limits and, if there are none, settings; make the user; start the
    service.

    Parameters
    ----------
    root : Path
        Another folder than `/`: only write the files.
    program : Path
        `membrane-ctrl`, as the units call it.

    Returns
    -------
    list of Path
        What was written.

    Raises
    ------
    InputError
        The program's path cannot stand in a unit.
    DeviceError
        A file cannot be written, or a command of the system failed.
    """
    if not program.is_absolute() or not _UNIT_SYNTAX.isdisjoint(str(program)):
        raise errors.InputError(f"{program}: a unit needs an absolute path without spaces")
    is_system = root == Path("/")
    if is_system:
        _make_user()
    written = []
    settings = root / _CONFIGURATIONS.lstrip("/") / _SETTINGS
    wanted = list_files(root, program)
    if not settings.exists():
        wanted.append(InstalledFile(settings, _SETTINGS_TEXT))
    for file in wanted:
        with errors.convert_write_errors(file.path, errors.DeviceError, "; use sudo"):
            file.path.parent.mkdir(parents=True, exist_ok=True)
            files.write_text_atomic(file.path, file.text)
            file.path.chmod(0o644)
        written.append(file.path)
    if is_system:
        _run(["systemctl", "daemon-reload"])
        _apply_device_rules()
        # Restarted, so that an upgrade takes effect: holds are other units and continue, and a
        # guided session stops safely.
        for name in (SESSION_LISTENER, SERVICE_UNIT):
            _run(["systemctl", "enable", name])
            _run(["systemctl", "restart", name])
    return written


def remove_units(root: Path) -> list[Path]:
    """Stop the service and remove units, rules and limits; configurations, runs and user stay.

    Returns
    -------
    list of Path
        What was removed.

    Raises
    ------
    DeviceError
        A hold or a guided session runs as a unit, a file cannot be removed, or a command of the
        system failed.
    """
    is_system = root == Path("/")
    if is_system:
        listing = ["systemctl", "list-units", "--plain", "--no-legend"]
        running = _run([*listing, "membrane-hold@*", "membrane-commission@*"])
        if running.strip():
            unit = running.split()[0]
            raise errors.DeviceError(f"{unit} runs; stop it before: systemctl stop {unit}")
        for name in (SERVICE_UNIT, SESSION_LISTENER):
            if (root / _TARGETS[name] / name).exists():
                _run(["systemctl", "disable", "--now", name])
    removed = []
    for name, folder in _TARGETS.items():
        path = root / folder / name
        with errors.convert_write_errors(path, errors.DeviceError, "; use sudo"):
            if path.exists():
                path.unlink()
                removed.append(path)
    if is_system:
        _run(["systemctl", "daemon-reload"])
        _apply_device_rules()
    return removed


def own_program() -> Path:
    """Return the path by which this program was called."""
    return Path(sys.argv[0]).absolute()


def _make_user() -> None:
    """Make the user of service and holds, unless there is one, with access to the devices."""
    try:
        pwd.getpwnam(USER)
    except KeyError:
        words = ["--system", "--user-group", "--home-dir", _STATE, "--shell", "/usr/sbin/nologin"]
        _run(["useradd", *words, USER])
    there = {group.gr_name for group in grp.getgrall()}
    for name in _DEVICE_GROUPS:
        if name in there:
            _run(["usermod", "--append", "--groups", name, USER])


def _apply_device_rules() -> None:
    """Apply the rules of udev and the socket buffers to the running system, where it has them."""
    if shutil.which("udevadm"):
        _run(["udevadm", "control", "--reload"])
        subsystems = [f"--subsystem-match={name}" for name in _DEVICE_SUBSYSTEMS]
        _run(["udevadm", "trigger", *subsystems])
        # the rule of the latency is for adapters as they are plugged in
        _run(["udevadm", "trigger", "--action=add", "--subsystem-match=usb-serial"])
    if shutil.which("sysctl"):
        _run(["sysctl", "--system"])


def _run(words: Sequence[str]) -> str:
    """Run a command of the system and return its output. Raises DeviceError."""
    try:
        done = subprocess.run(words, capture_output=True, text=True, check=False)
    except OSError as error:
        raise errors.DeviceError(f"{words[0]}: {errors.os_reason(error)}") from None
    if done.returncode != 0:
        reason = done.stderr.strip() or f"ended with code {done.returncode}"
        raise errors.DeviceError(f"{' '.join(words)}: {reason}; use sudo")
    return done.stdout
