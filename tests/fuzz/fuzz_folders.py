"""Mutated run folders and capture sets through every command that reads them: `make fuzz`.

A worker process runs cases one after the other, in itself, under a limit of memory and an alarm; it
says on its output which case it is at, so that one that kills it is known, and another worker goes
on behind it. What is wrong: anything raised, an exit code that is none of the documented ones,
control characters printed, a case that hangs, a file outside the folder that was changed, memory
beyond the limit, a worker that dies.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parents[1]), str(HERE)]

MEMORY_BYTES = 700_000_000  # of a case, above what the process has: a command begins with 0.2 GB
# each review leaves threads of Rerun behind, whose address space counts against the limit
_CASES_A_WORKER = 250
CASE_S = 120  # on a busy machine; a step of a tuning session takes ten
_CODES = frozenset({0, 2, 3, 4})
_REFUSED = {"Cc", "Cf", "Cs", "Zl", "Zp"}


@dataclass(frozen=True, slots=True)
class Command:
    """A command, what it is given, and how many of a thousand cases it gets."""

    name: str
    words: tuple[str, ...]
    share: int
    reads: str = "logs"


# RUN, LOGS, SET, SETS, TRACK, FIGURES, TUNING, LIVE, H5 and OUT are put in; `runs` costs 15 ms and
# `report` a second
COMMANDS = (
    Command("runs", ("runs", "--logs", "LOGS"), 160),
    Command("runs --json", ("runs", "--logs", "LOGS", "--json"), 50),
    Command("runs show", ("runs", "show", "RUN"), 160),
    Command("replay", ("replay", "RUN"), 170),
    Command("repair", ("repair", "RUN"), 80),
    Command("repair --in-place", ("repair", "RUN", "--in-place"), 40),
    Command("report", ("report", "RUN"), 20),
    Command("export", ("export", "RUN", "--format", "parquet"), 70),
    Command("export csv", ("export", "RUN", "--format", "csv"), 30),
    Command("export hdf5", ("export", "RUN", "--format", "hdf5", "--out", "OUT"), 20),
    Command("review", ("review", "RUN", "--save", "OUT.rrd"), 33),
    Command("review mark", ("review", "mark", "RUN", "a mark", "--at", "+1s"), 50),
    Command("measure", ("measure", "SET", "--no-pictures"), 95, "sets"),
    Command("measure pictures", ("measure", "SET"), 5, "sets"),
    Command("uncertainty", ("uncertainty", "SET", "--trials", "2"), 10, "sets"),
    Command("stability", ("stability", "SETS", "--trials", "2"), 10, "sets"),
    Command("calibrate", ("calibrate", "SET0", "SET1", "--out", "OUT.toml"), 10, "sets"),
    Command("track", ("track", "TRACK", "--no-pictures"), 30, "track"),
    Command("modes", ("modes", "FIGURES", "--no-pictures"), 20, "track"),
    Command("measure h5", ("measure", "H5", "--no-pictures"), 60, "sofast"),
    Command(
        "calibrate --live", ("calibrate", "--live", "--session", "LIVE", "--no-pictures"), 3, "live"
    ),
    Command("tune history", ("tune", "history", "--logs", "TUNED"), 20, "tuned"),
    Command("tune identify", ("tune", "identify", "--session", "TUNING"), 8, "tuned"),
    Command("tune design", ("tune", "design", "--session", "TUNING"), 4, "tuned"),
    Command("tune preview", ("tune", "preview", "--session", "TUNING"), 3, "tuned"),
)


@dataclass(frozen=True, slots=True)
class Case:
    """One case: its number is its seed."""

    number: int
    command: Command


def case(number: int, only: str | None = None) -> Case:
    """The command of a case, drawn unless only one is asked for."""
    if only is not None:
        return Case(number, next(command for command in COMMANDS if command.name == only))
    shares = [command.share for command in COMMANDS]
    return Case(number, random.Random(f"command {number}").choices(COMMANDS, shares)[0])


class _HangError(BaseException):
    """No `Exception`: nothing may catch it on the way."""


def _rang(number: int, frame: FrameType | None) -> None:
    raise _HangError(f"no end after {CASE_S} s")


class Room:
    """Good folders, and a place where a copy of one is spoiled and read."""

    def __init__(self, root: Path, good: Path | None = None) -> None:
        from good_folders import RUN, TUNING

        self._root = root
        self._good = good or root / "good"
        self._good.mkdir(exist_ok=True)
        self._run_name, self._tuning_name = RUN, TUNING

    def make(self, kind: str) -> None:
        """A good folder of a kind, unless it is there."""
        from good_folders import (
            good_live,
            good_run,
            good_sets,
            good_sofast,
            good_track,
            good_tuning,
        )

        folder = self._good / kind
        if kind == "live":
            self.make("sets")
        if folder.exists():
            return
        with _quiet():
            match kind:
                case "logs":
                    good_run(folder)
                case "sets":
                    good_sets(self._good)
                case "track":
                    good_track(folder)
                case "sofast":
                    good_sofast(folder)
                case "live":
                    good_live(folder, self._good / "sets")
                case "tuned":
                    good_tuning(folder)

    def run(self, one: Case) -> str:
        """The fault of a case; empty if there is none."""
        from mutations import CANARY, spoil

        from membrane_ctrl.cli import run

        rng = random.Random(f"case {one.number}")
        place = self._root / "case"
        _wipe(place)
        place.mkdir()
        (place / CANARY).write_text("untouched")
        inside = place / "inside"
        self.make(one.command.reads)
        shutil.copytree(self._good / one.command.reads, inside)
        if one.command.reads == "sets":
            spoil(rng.choice((inside, inside / "0000", inside / "0001")), rng)
        elif one.command.reads != "logs":
            spoil(inside, rng)
        else:
            spoil(inside / self._run_name, rng)
            if one.command.name.startswith(
                "runs"
            ):  # one bad folder must not hide the good ones from the list
                shutil.copytree(
                    self._good / "logs" / self._run_name, inside / "20261122T000000Z-good"
                )
        before = _outside(place)
        words = [self._word(word, inside, rng) for word in one.command.words]
        with _captured() as reported:
            code = run(words)
        return "; ".join(_wrong(one, code, reported(), before, _outside(place)))

    def _word(self, word: str, inside: Path, rng: random.Random) -> str:
        places = {
            "LOGS": inside,
            "RUN": inside / self._run_name,
            "SETS": inside,
            "SET": inside / rng.choice(("0000", "0001")),
            "TRACK": inside / "track",
            "FIGURES": inside,
            "TUNED": inside,
            "TUNING": inside / "tuning" / self._tuning_name,
            "LIVE": inside,
            "H5": inside / "m.h5",
            "SET0": inside / "0000",
            "SET1": inside / "0001",
            "OUT": inside.parent / "out",
            "OUT.rrd": inside.parent / "out.rrd",
            "OUT.toml": inside.parent / "out.toml",
        }
        return str(places.get(word, word))


def _wrong(
    one: Case,
    code: int,
    reported: tuple[str, str],
    before: dict[str, tuple[int, int]],
    after: dict[str, tuple[int, int]],
) -> Iterator[str]:
    import unicodedata

    out, err = reported
    if code not in _CODES:
        yield f"exit {code}"
    if any(
        unicodedata.category(letter) in _REFUSED and letter not in "\n\t" for letter in out + err
    ):
        yield "control characters were printed"
    if code == 2 and sum(line.startswith("membrane-ctrl: ") for line in err.splitlines()) != 1:
        yield f"not one line: {err[-200:]!r}"
    if one.command.name == "runs" and "20261122T000000Z-good" not in out:
        yield "the good run is not in the list"
    if before != after:
        yield f"outside changed: {sorted(set(before.items()) ^ set(after.items()))}"


def _outside(place: Path) -> dict[str, tuple[int, int]]:
    """Size and time of all beside the folder that is spoiled, but for what a command had to
    write.
    """
    return {
        path.name: (path.lstat().st_size, path.lstat().st_mtime_ns)
        for path in place.iterdir()
        if path.name != "inside" and not path.name.startswith("out")
    }


def _wipe(place: Path) -> None:
    if place.exists():
        shutil.rmtree(place)


@contextlib.contextmanager
def _captured() -> Iterator[object]:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        yield lambda: (out.getvalue(), err.getvalue())


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    with _captured():
        yield


def work(first: int, last: int, root: Path, good: Path, only: str | None) -> None:
    """Run cases and print a line of JSON for each: what is wrong with it, and how long it took."""
    import functools
    import warnings

    import typer.main

    from tests.support.peak_memory import peak_mb, reset_peak

    typer.main.get_command = functools.cache(
        typer.main.get_command
    )  # making it again takes four times what a case does
    warnings.simplefilter("error")
    warnings.simplefilter(
        "ignore", RuntimeWarning
    )  # NumPy's, of numbers that are none: a line, and no end
    room = Room(root, good)
    for kind in {case(number, only).command.reads for number in range(first, last)}:
        room.make(kind)
    signal.signal(signal.SIGALRM, _rang)
    for warm in range(2):  # everything is loaded before the limit is set
        with contextlib.suppress(Exception):
            room.run(case(warm, only))
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + 3 * MEMORY_BYTES, -1))
    for number in range(first, last):
        one = case(number, only)
        print(json.dumps({"at": number, "command": one.command.name}), flush=True)
        began_mb = reset_peak()
        began_s, began_cpu_s = time.perf_counter(), time.process_time()
        signal.alarm(CASE_S)
        try:
            wrong = room.run(one)
        except BaseException as error:
            frames = traceback.extract_tb(error.__traceback__)
            ours = next(
                (f for f in reversed(frames) if "/membrane_ctrl/" in f.filename), frames[-1]
            )
            wrong = (
                f"{type(error).__name__}: {str(error)[:120]} at "
                f"{Path(ours.filename).name}:{ours.lineno} {ours.name}"
            )
            if os.environ.get("FUZZ_TRACE"):
                traceback.print_exc()
            if isinstance(error, KeyboardInterrupt):
                raise
        finally:
            signal.alarm(0)
        taken_mb = peak_mb() - began_mb
        if taken_mb * 1e6 > MEMORY_BYTES and not wrong:
            wrong = f"it took {taken_mb:.0f} MB"
        took_s = time.perf_counter() - began_s
        cpu_s = time.process_time() - began_cpu_s
        done = {
            "done": number,
            "wrong": wrong,
            "took_s": round(took_s, 3),
            "cpu_s": cpu_s,
            "peak_mb": taken_mb,
        }
        print(json.dumps(done), flush=True)


Outcome = tuple[Counter[str], list[tuple[int, str, str]], float]


def campaign(first: int, last: int, only: str | None = None, report: object = print) -> Outcome:
    """Cases in worker processes; counts by command, what was wrong,
    and the greatest memory in MB.
    """
    with tempfile.TemporaryDirectory(prefix="membrane-fuzz-good-") as good:
        return _campaign(first, last, only, good, report)


def _campaign(first: int, last: int, only: str | None, good: str, report: object) -> Outcome:
    counts: Counter[str] = Counter()
    found: list[tuple[int, str, str]] = []
    peak_mb = 0.0
    seconds: Counter[str] = Counter()
    at = first
    while at < last:
        with tempfile.TemporaryDirectory(prefix="membrane-fuzz-") as root:
            end = min(last, at + _CASES_A_WORKER)
            words = [sys.executable, str(Path(__file__)), "--worker", root, "--good", good]
            words += [
                "--first",
                str(at),
                "--last",
                str(end),
                *(["--command", only] if only else []),
            ]
            with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as worker:
                assert worker.stdout is not None
                name = "start"
                for line in worker.stdout:
                    message = json.loads(line)
                    if "at" in message:
                        at, name = message["at"], message["command"]
                        continue
                    counts[name] += 1
                    if message["peak_mb"] > max(peak_mb, 300) + 20:
                        report(f"{message['done']} {name}: peak {message['peak_mb']:.0f} MB")  # type: ignore[operator]
                    peak_mb = max(peak_mb, message["peak_mb"])
                    seconds[name] += message["cpu_s"]
                    if message["wrong"]:
                        found.append((message["done"], name, message["wrong"]))
                        report(f"{message['done']} {name}: {message['wrong']}")  # type: ignore[operator]
                    if message["took_s"] > CASE_S / 3:
                        report(f"{message['done']} {name}: took {message['took_s']} s")  # type: ignore[operator]
                    at = message["done"] + 1
                    if at % 500 == 0:
                        report(f"{at} cases, peak {peak_mb:.0f} MB, {len(found)} wrong")  # type: ignore[operator]
            if worker.returncode:
                found.append((at, name, f"the worker died with {worker.returncode}"))
                report(f"{at} {name}: the worker died with {worker.returncode}")  # type: ignore[operator]
                at += 1
    for name, count in sorted(counts.items()):
        report(f"{name:20} {count:6} cases, {1e3 * seconds[name] / count:6.0f} ms each")  # type: ignore[operator]
    return counts, found, peak_mb


def main(arguments: Sequence[str]) -> int:
    """The command."""
    parser = argparse.ArgumentParser(
        description="Mutated run folders and capture sets through every reading command."
    )
    parser.add_argument(
        "--first", type=int, default=0, help="number of the first case, which is its seed"
    )
    parser.add_argument("--last", type=int, default=20_000, help="and of the one behind the last")
    parser.add_argument(
        "--command", choices=[command.name for command in COMMANDS], help="cases of this one alone"
    )
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--good", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.worker is not None:
        work(options.first, options.last, options.worker, options.good, options.command)
        return 0
    began_s = time.perf_counter()
    counts, found, peak_mb = campaign(options.first, options.last, options.command)
    took_s = time.perf_counter() - began_s
    print(
        f"{sum(counts.values())} cases in {took_s:.0f} s, peak {peak_mb:.0f} MB, {len(found)} wrong"
    )
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
