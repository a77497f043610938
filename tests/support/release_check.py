"""The release checklist, `make release-check`: runs every item and prints what is missing.

    python -m tests.support.release_check              # all
    python -m tests.support.release_check --only licences build

An item that cannot be run here is named as not done: it neither fails nor passes, and the last line
repeats it. Nothing is published.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.metadata
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from membrane_ctrl import __version__

ROOT = Path(__file__).parents[2]
_BUILD = "import sys; from setuptools import build_meta; print(build_meta.build_wheel(sys.argv[1]))"
_AUDIT = ["-m", "pip_audit", "-r", "requirements.lock", "--no-deps", "--format", "json"]
_SOURCE_DATE = "1704067200"  # 2024-01-01: any fixed time
PASSED, MISSING, NOT_DONE = "passed", "missing", "not done"
# Licences under which a dependency may be distributed with, or beside, BSD-3-Clause software
_ALLOWED = (
    "mit", "bsd", "apache", "isc", "psf", "python software foundation", "mpl", "mozilla", "zlib",
    "unlicense", "hpnd", "cc0", "0bsd", "public domain",
    "lgpl", "lesser general public", "epics", "blueoak",
)  # fmt: skip
# Extras whose packages a laboratory installs
_EXTRAS = ("alarms", "web", "screen", "gpio", "mqtt", "h5", "fits", "data")


class NotDoneError(Exception):
    """An item cannot be run here; the message states why."""


@dataclass(frozen=True, slots=True)
class ReleaseItem:
    """An item of the checklist.

    `find_problem` runs it, and returns an empty text if it passes. It raises NotDoneError if it
    cannot be run here.
    """

    name: str
    what: str
    find_problem: Callable[[], str]


def check_tree() -> str:
    """No file differs from its commit."""
    changed = _run_text("git", "status", "--porcelain")
    return f"changed files: {changed.splitlines()[0].strip()} ..." if changed else ""


def check_version() -> str:
    """The changelog's first heading is this version, with a date."""
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    found = re.search(r"^## (\S+) \((.*)\)$", text, re.MULTILINE)
    if found is None:
        return "CHANGELOG.md has no heading `## VERSION (DATE)`"
    if found[1] != __version__:
        return f"membrane_ctrl.__version__ is {__version__}, CHANGELOG.md begins with {found[1]}"
    if not re.fullmatch(r"\d{4}-\d\d-\d\d", found[2]):
        return f"CHANGELOG.md has no date for {found[1]}: {found[2]}"
    return ""


def check_lock() -> str:
    """Every required package is pinned, and those that are installed here are of that version."""
    pinned = dict(
        line.split("==")
        for line in (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines()
        if "==" in line and not line.startswith("#")
    )
    pinned = {_plain(name): version.split(";")[0].strip() for name, version in pinned.items()}
    missing = sorted(name for name in find_dependencies() if name not in pinned)
    if missing:
        return f"not in requirements.lock: {', '.join(missing)}"
    other = [
        f"{name} {importlib.metadata.version(name)}"
        for name in sorted(find_dependencies())
        if importlib.metadata.version(name) != pinned[name]
    ]
    return f"installed in another version: {', '.join(other)}" if other else ""


def check_licences() -> str:
    """Every dependency has a licence that allows its use."""
    unknown = [
        f"{name} ({licence or 'none stated'})"
        for name in sorted(find_dependencies())
        if not any(word in (licence := find_licence(name)).lower() for word in _ALLOWED)
    ]
    return f"look at: {', '.join(unknown)}" if unknown else ""


def check_vulnerabilities() -> str:
    """No pinned package has a known vulnerability. Raises NotDoneError without the service."""
    if importlib.util.find_spec("pip_audit") is None:
        raise NotDoneError("pip-audit, which asks a service on the internet, is not installed")
    done = subprocess.run(
        [sys.executable, *_AUDIT], cwd=ROOT, capture_output=True, text=True, check=False
    )
    return judge_audit(done.stdout, done.stderr)


def judge_audit(output: str, messages: str) -> str:
    """Judge what pip-audit printed.

    It calls a package that its service does not answer for skipped, and ends as if all were well.

    Parameters
    ----------
    output : str
        Its report as JSON; empty or incomplete if it failed.
    messages : str
        Its standard error.

    Returns
    -------
    str
        The packages with known vulnerabilities; empty if there are none.

    Raises
    ------
    NotDoneError
        A package was not looked up.
    """
    try:
        packages = json.loads(output)["dependencies"]
    except (ValueError, KeyError, TypeError):
        raise NotDoneError(f"no network: {_last_line(messages)}") from None
    skipped = [package for package in packages if "skip_reason" in package]
    found = [package["name"] for package in packages if package.get("vulns")]
    if found:
        return f"known vulnerabilities: {', '.join(found)}"
    if skipped or not packages:
        raise NotDoneError(
            f"no network: {len(skipped)} of {len(packages)} packages were not looked up"
        )
    return ""


def check_build() -> str:
    """Two builds of the wheel are equal to the last bit."""
    with tempfile.TemporaryDirectory() as folder:
        sums = [_build_wheel(Path(folder) / str(number)) for number in (1, 2)]
    return "" if sums[0] == sums[1] else "two builds of one source differ"


def run_make(*targets: str) -> Callable[[], str]:
    """An item that is one of the Makefile's targets."""

    def find_problem() -> str:
        done = subprocess.run(["make", *targets], cwd=ROOT, check=False)
        return "" if done.returncode == 0 else f"`make {' '.join(targets)}` fails"

    return find_problem


ITEMS = (
    ReleaseItem("tree", "nothing is uncommitted", check_tree),
    ReleaseItem("version", "one version in package and changelog, with its date", check_version),
    ReleaseItem("lock", "the lock file has every dependency", check_lock),
    ReleaseItem("licences", "every dependency may be used", check_licences),
    ReleaseItem("vulnerabilities", "no dependency has a known one", check_vulnerabilities),
    ReleaseItem("build", "two builds are equal", check_build),
    ReleaseItem("tests", "format, lint, types, docs, all tests", run_make("test")),
    ReleaseItem("campaign", "all faults, in virtual and real time", run_make("campaign")),
    ReleaseItem("mutants", "the tests notice wrong code", run_make("mutants")),
    ReleaseItem("benchmarks", "figures against their references", run_make("bench")),
    ReleaseItem("board", "firmware: analysis, tests, QEMU, fuzzing", run_make("board")),
)


def find_dependencies() -> set[str]:
    """Names of all packages that the program and its extras need, as far as installed."""
    found: set[str] = set()
    wanted: list[tuple[str, tuple[str, ...]]] = [("membrane-ctrl", ("", *_EXTRAS))]
    while wanted:
        name, extras = wanted.pop()
        try:
            requirements = importlib.metadata.requires(name) or []
        except importlib.metadata.PackageNotFoundError:
            continue
        for requirement in requirements:
            needed = re.match(r"[A-Za-z0-9._-]+", requirement)
            marker = re.search(r"extra == ['\"]([^'\"]+)['\"]", requirement)
            if needed is None or (marker is not None and marker[1] not in extras):
                continue
            plain = _plain(needed[0])
            if plain not in found and _is_installed(plain):
                found.add(plain)
                wanted.append((plain, ("",)))
    return found


def find_licence(name: str) -> str:
    """What a package states as its licence."""
    about = importlib.metadata.metadata(name)
    classifiers = [
        line.rpartition("::")[2].strip()
        for line in about.get_all("Classifier") or []
        if line.startswith("License ::")
    ]
    expressions = about.get_all("License-Expression") or []
    stated = [*expressions, *classifiers, *(about.get_all("License") or [])]
    return next((text.splitlines()[0] for text in stated if text.strip()), "")


def main() -> int:
    """Run the items and print the table; returns 1 if something is missing."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", nargs="+", choices=[item.name for item in ITEMS], default=[])
    only = parser.parse_args().only
    chosen = [item for item in ITEMS if not only or item.name in only]
    return print_results([(item, *_run_item(item)) for item in chosen])


def print_results(results: list[tuple[ReleaseItem, str, str]]) -> int:
    """Print the table of items, their results and reasons; 1 if something is missing."""
    for item, result, reason in results:
        print(f"{result:8} {item.name:16} {reason or item.what}")
    not_done = [item.name for item, result, _ in results if result == NOT_DONE]
    if not_done:
        print(f"not a complete check: {', '.join(not_done)} not done on this machine")
    return 1 if any(result == MISSING for _, result, _ in results) else 0


def _run_item(item: ReleaseItem) -> tuple[str, str]:
    """The result of an item, and its reason."""
    try:
        problem = item.find_problem()
    except NotDoneError as error:
        return NOT_DONE, str(error)
    return (MISSING, problem) if problem else (PASSED, "")


def _build_wheel(folder: Path) -> str:
    """SHA-256 of a wheel built from a copy of the committed sources."""
    source = folder / "source"
    shutil.copytree(ROOT, source, ignore=shutil.ignore_patterns(".git", ".venv", "build", "logs"))
    environment = os.environ | {"SOURCE_DATE_EPOCH": _SOURCE_DATE}
    done = subprocess.run(
        [sys.executable, "-c", _BUILD, str(folder)],
        cwd=source, env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    wheel = folder / done.stdout.splitlines()[-1]
    return hashlib.sha256(wheel.read_bytes()).hexdigest()


def _run_text(*words: str) -> str:
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout


def _is_installed(name: str) -> bool:
    try:
        importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def _plain(name: str) -> str:
    """A package's name as indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _last_line(text: str) -> str:
    lines = text.strip().splitlines()
    return lines[-1] if lines else "no output"


if __name__ == "__main__":
    sys.exit(main())
