"""Starts a commissioning session in the terminal."""

import sys
from pathlib import Path

from membrane_ctrl.commissioning.guide.bench_access import BenchAccess
from membrane_ctrl.commissioning.guide.emulated_bench import EmulatedBench, MakeHold
from membrane_ctrl.commissioning.guide.real_bench import RealBench
from membrane_ctrl.commissioning.guide.session import CommissioningSession
from membrane_ctrl.model import errors, files


def commission_bench(folder: Path, make_virtual_hold: MakeHold | None = None) -> int:
    """Run or resume the session of a folder, on the emulated bench if its hold is given.

    Raises InputError or DeviceError.
    """
    with errors.convert_write_errors(folder, errors.DeviceError):
        files.make_folder(folder)
    access: BenchAccess = RealBench()
    if make_virtual_hold is not None:
        access = EmulatedBench(make_virtual_hold)
    session = CommissioningSession(folder, access, _read_line, _show_line)
    return session.run()


def _read_line(key: str, prompt: str) -> str:
    """A line from the terminal. Raises EOFError at its end."""
    print(f"{prompt}: ", end="", flush=True)
    line = sys.stdin.readline()
    if not line:
        raise EOFError
    return line.rstrip("\n")


def _show_line(line: str) -> None:
    print(line, flush=True)
