"""Code made wrong on purpose: what do the fast tests notice, what the campaign alone? Writes
docs/measurements/mutants.md.

python tests/mutants/mutants.py                       # all, 2 at a time
python tests/mutants/mutants.py --only "no wait" "levels"     # those whose words contain one of these
python tests/mutants/mutants.py --campaign-sample 60  # fast tests on all, the campaign on so many,
drawn at random
python tests/mutants/mutants.py --missing             # only those without a result of their present text

Results are kept in results.json, from which the document is made; a mutation whose text has changed
has none.
"""  # noqa: E501

from __future__ import annotations

import argparse
import ast
import hashlib
import importlib.util
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from queue import Queue
from threading import Lock

ROOT = Path(__file__).parents[2]
LIST = Path(__file__).with_name("mutants.toml")
SAFETY = ROOT / "membrane_ctrl" / "controller" / "safety.py"
RESULTS = Path(__file__).with_name("results.json")
DOCUMENT = ROOT / "docs" / "measurements" / "mutants.md"
PRODUCT = ("membrane_ctrl", "firmware_iface")
# after the tests that an area names: all fast tests of control and devices
ALL_FAST = tuple(
    f"tests/{room}/test_*.py"
    for room in (
        "controller",
        "control",
        "hold",
        "firmware_iface",
        "instruments",
        "control_port",
        "commissioning",
        "sim",
    )
)
# These compare a generated document with its source: any change of the source would count as
# noticed ...
COMPARISONS = (
    "test_configuration_page.py",
    "test_faults_page.py",
    "test_register_generate.py",
    "test_telemetry_pages.py",
    "test_events_page.py",
)
# ... and this one waits for real devices' time-outs: on a busy machine it fails without a mutation.
_OF_TIME = ("test_examples.py",)
_LAYOUT = re.compile(r"\s|,(?=\s*[)\]}])")  # space, line ends, last commas
_LEAVE = shutil.ignore_patterns(
    ".git", ".venv", "__pycache__", ".mypy_cache", ".ruff_cache", "logs", "images"
)
# a mutation that waits for ever is noticed, too; all tests on a busy machine take 500 s
PATIENCE_S = 1200.0
# Shares of the mutations that the fast tests, and the campaign alone, should notice.
TESTS_GOAL, CAMPAIGN_GOAL = 0.95, 0.75


@dataclass(frozen=True)
class Mutant:
    """One entry of the list."""

    what: str
    area: str
    find: str
    replace: str
    lives: str = ""
    guard: str = ""  # name of the `controller.duties.Guard` that it removes, if it removes one
    # name of the rule of the safety table that it removes, if it was made from the table
    rule: str = ""

    @property
    def digest(self) -> str:
        """Hash of the mutation's text without its layout: a result belongs to this text alone, and
        remains valid when the formatter breaks lines elsewhere.
        """
        text = _LAYOUT.sub("", f"{self.find}\0{self.replace}")
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def place(self, root: Path) -> Path:
        """The file that holds the text. Raises LookupError unless it is there exactly once."""
        found = [path for path, text in _sources(root) for _ in range(text.count(self.find))]
        if len(found) != 1:
            raise LookupError(f"{self.what!r}: `find` occurs {len(found)} times, not once")
        return found[0]

    def applied(self, text: str) -> str:
        """The file's text with the mutation. Raises SyntaxError if that is no Python."""
        mutated = text.replace(self.find, self.replace)
        compile(mutated, self.what, "exec")
        return mutated


@dataclass(frozen=True)
class Verdict:
    """Who noticed a mutation; empty: nobody. `by_campaign` is None
    where the campaign was not run.
    """

    mutant: Mutant
    place: str
    by_tests: str
    by_campaign: str | None
    lasted_s: float


def _sources(root: Path) -> Iterator[tuple[Path, str]]:
    for folder in PRODUCT:
        for path in sorted((root / folder).rglob("*.py")):
            yield path, path.read_text(encoding="utf-8")


@dataclass(frozen=True)
class First:
    """The tests, and the part of the campaign, that run first on an area's mutations; the rest
    follows.
    """

    tests: tuple[str, ...]
    campaign: str


def load(root: Path = ROOT) -> tuple[list[Mutant], dict[str, First]]:
    """All mutations, and what runs first on them, by area.
    Raises LookupError for a missing test.
    """
    table = tomllib.loads(LIST.read_text(encoding="utf-8"))
    firsts = {
        name: First(_paths_of_tests(root, area["tests"]), area["campaign"])
        for name, area in table["area"].items()
    }
    listed = [Mutant(**entry) for entry in table["mutant"]]
    return make_rule_mutants(root, table["rule_lives"]) + listed, firsts


def make_rule_mutants(root: Path, lives: Mapping[str, str]) -> list[Mutant]:
    """Return a mutation for each rule of the safety table: it never trips.

    Parameters
    ----------
    root : Path
        Of the source.
    lives : mapping of str to str
        Why the mutation of a rule may survive.

    Returns
    -------
    list of Mutant
        In the order of the table.
    """
    text = (root / SAFETY.relative_to(ROOT)).read_text(encoding="utf-8")
    found = []
    for rule, row in _rows_of_rules(text):
        (broken,) = (keyword.value for keyword in row.keywords if keyword.arg == "broken")
        condition = ast.get_source_segment(text, broken)
        found.append(
            Mutant(
                what=f"{rule} never trips",
                area="safety",
                find=f"broken={condition}",
                replace="broken=lambda o, c: False",
                lives=lives.get(rule, ""),
                rule=rule,
            )
        )
    return found


def _rows_of_rules(text: str) -> Iterator[tuple[str, ast.Call]]:
    """Name and row of each rule in the text of the safety table."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "Rule":
            (name,) = (keyword.value for keyword in node.keywords if keyword.arg == "name")
            yield str(ast.literal_eval(name)), node


def _paths_of_tests(root: Path, names: Sequence[str]) -> tuple[str, ...]:
    """Paths of tests by file name."""
    found = {name: list((root / "tests").rglob(name)) for name in names}
    if missing := {name: len(paths) for name, paths in found.items() if len(paths) != 1}:
        raise LookupError(f"test files that are not there exactly once: {missing}")
    return tuple(str(paths[0].relative_to(root)) for paths in found.values())


@contextmanager
def mutated(tree: Path, mutant: Mutant) -> Iterator[str]:
    """The tree with the mutation in it, for a while; its place."""
    path = mutant.place(tree)
    text = path.read_text(encoding="utf-8")
    compiled = Path(importlib.util.cache_from_source(str(path)))
    path.write_text(mutant.applied(text), encoding="utf-8")
    compiled.unlink(missing_ok=True)  # Python compares only size and second with the source
    try:
        yield str(path.relative_to(tree))
    finally:
        path.write_text(text, encoding="utf-8")
        compiled.unlink(missing_ok=True)


def ask_tests(tree: Path, first: Sequence[str]) -> str:
    """The first fast test that fails; empty if all pass."""
    rest = [str(p.relative_to(tree)) for pattern in ALL_FAST for p in sorted(tree.glob(pattern))]
    left = [
        path
        for path in rest
        if path not in first and Path(path).name not in (*COMPARISONS, *_OF_TIME)
    ]
    for files in filter(None, (first, left)):  # pytest without a file would run every test there is
        if found := _failed_test(_run(tree, "-m", "pytest", *_PYTEST, *files)):
            return found
    return ""


_PYTEST = ("-x", "-q", "-p", "no:cacheprovider", "-m", "not campaign and not real_time")


def ask_campaign(tree: Path, first: str) -> str:
    """The first violation that the short campaign finds, with one of its parts first; empty if
    there is none.
    """
    ended = _run(tree, "tests/campaign/campaign.py", "--short", "--first", first)
    if ended is None:
        return "hangs"
    return "" if ended.returncode == 0 else _last_line(ended.stdout or ended.stderr)


def _run(tree: Path, *arguments: str) -> subprocess.CompletedProcess[str] | None:
    """A Python of the tree, two steps back in priority; None if it hangs."""
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    command = ["nice", "-n", "5", sys.executable, *arguments]
    try:
        return subprocess.run(
            command,
            cwd=tree,
            env=environment,
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return None


def _failed_test(ended: subprocess.CompletedProcess[str] | None) -> str:
    if ended is None:
        return "hangs"
    if ended.returncode == 0:
        return ""
    found = re.search(r"^(?:FAILED|ERROR) \S*?([^/\s]+\.py\S*)", ended.stdout, re.MULTILINE)
    return found[1] if found else _last_line(ended.stdout + ended.stderr)


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or ["no word"])[-1][:120]


def require_sound(tree: Path, first: Sequence[str], with_campaign: bool) -> None:
    """Raise RuntimeError if a test fails without a mutation: then a failure would prove nothing.

    Of the fast tests those that run first on some mutation; `make test` runs the others.
    """
    if found := _failed_test(_run(tree, "-m", "pytest", *_PYTEST, *first)):
        raise RuntimeError(f"without any mutation: {found}")
    if with_campaign and (found := ask_campaign(tree, "")):
        raise RuntimeError(f"without any mutation: {found}")


def examine(mutant: Mutant, tree: Path, first: First, with_campaign: bool) -> Verdict:
    """Examine one mutation in its own tree."""
    begun_s = time.monotonic()
    with mutated(tree, mutant) as place:
        by_tests = ask_tests(tree, first.tests)
        by_campaign = ask_campaign(tree, first.campaign) if with_campaign else None
    return Verdict(mutant, place, by_tests, by_campaign, time.monotonic() - begun_s)


def load_results() -> dict[str, dict[str, str | None]]:
    """What was found so far, by the mutations' words."""
    if not RESULTS.exists():
        return {}
    results: dict[str, dict[str, str | None]] = json.loads(RESULTS.read_text(encoding="utf-8"))
    return results


def store_result(verdict: Verdict) -> None:
    """Add a result; one of the campaign stays if the same text is examined again without it."""
    results = load_results()
    before = results.get(verdict.mutant.what, {})
    by_campaign = verdict.by_campaign
    if by_campaign is None and before.get("digest") == verdict.mutant.digest:
        by_campaign = before.get("by_campaign")
    results[verdict.mutant.what] = {
        "digest": verdict.mutant.digest,
        "place": verdict.place,
        "by_tests": verdict.by_tests,
        "by_campaign": by_campaign,
    }
    RESULTS.write_text(json.dumps(results, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def current_verdicts(mutants: Sequence[Mutant]) -> list[Verdict]:
    """The results of the mutations' present texts, in the list's order."""
    results = load_results()
    verdicts = []
    for mutant in mutants:
        result = results.get(mutant.what)
        if result is not None and result["digest"] == mutant.digest:
            place, by_tests = str(result["place"]), str(result["by_tests"])
            verdicts.append(Verdict(mutant, place, by_tests, result["by_campaign"], 0.0))
    return verdicts


def examine_all(
    mutants: Sequence[Mutant],
    firsts: dict[str, First],
    at_once: int,
    for_campaign: Sequence[Mutant],
) -> list[Verdict]:
    """All mutations, each worker with a copy of the tree outside the repository; those
    `for_campaign` also by it.
    """
    stored = Lock()
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        trees: Queue[Path] = Queue()
        for number in range(at_once):
            shutil.copytree(ROOT, Path(folder) / str(number), ignore=_LEAVE)
            trees.put(Path(folder) / str(number))
        begun_s = time.monotonic()
        first = sorted({path for mutant in mutants for path in firsts[mutant.area].tests})
        if mutants:  # pytest without a file would run every test there is
            require_sound(trees.queue[0], first, with_campaign=bool(for_campaign))
        print(f"{time.monotonic() - begun_s:4.0f} s  without a mutation all tests pass", flush=True)

        def one(mutant: Mutant) -> Verdict:
            tree = trees.get()
            try:
                verdict = examine(mutant, tree, firsts[mutant.area], mutant in for_campaign)
            finally:
                trees.put(tree)
            with stored:
                store_result(verdict)
            by_campaign = (
                "not run" if verdict.by_campaign is None else verdict.by_campaign or "LIVES"
            )
            print(
                f"{verdict.lasted_s:4.0f} s  {mutant.what}\n        tests:    "
                f"{verdict.by_tests or 'LIVES'}"
                f"\n        campaign: {by_campaign}",
                flush=True,
            )
            return verdict

        with ThreadPoolExecutor(at_once) as workers:
            return list(workers.map(one, mutants))


def removes(mutant: Mutant) -> str:
    """The rule of the safety table, or the guard, that a mutation removes; empty if it is about
    something else.
    """
    if mutant.guard or mutant.rule:
        return mutant.guard or mutant.rule
    for rule, row in _texts_of_rules().items():
        if mutant.find in row:
            return rule
    return ""


@cache
def _texts_of_rules() -> dict[str, str]:
    """Text of each rule's row in the safety table."""
    text = SAFETY.read_text(encoding="utf-8")
    return {rule: ast.get_source_segment(text, row) or "" for rule, row in _rows_of_rules(text)}


def sample(mutants: Sequence[Mutant], number: int) -> list[Mutant]:
    """Draw `number` of them at random, the same at every call."""
    shuffled = list(mutants)
    random.Random(3).shuffle(shuffled)
    return shuffled[:number]


def count_kills(verdicts: Sequence[Verdict]) -> tuple[tuple[int, int], tuple[int, int]]:
    """Killed and examined, by the fast tests and by the campaign."""
    by_tests = [verdict.by_tests for verdict in verdicts]
    by_campaign = [verdict.by_campaign for verdict in verdicts if verdict.by_campaign is not None]
    return (sum(map(bool, by_tests)), len(by_tests)), (
        sum(map(bool, by_campaign)),
        len(by_campaign),
    )


def document(verdicts: Sequence[Verdict], listed: int) -> str:
    """The result as Markdown; of `listed` mutations these were examined."""
    total = len(verdicts)
    (tests, _), (campaign, of_campaign) = count_kills(verdicts)
    share = campaign / max(of_campaign, 1)
    met = "met" if share >= CAMPAIGN_GOAL else "**missed**"
    lines = [
        "# Mutants",
        "",
        "Generated by `make mutants` from `tests/mutants/mutants.toml` and the safety table: "
        "code made wrong on "
        "purpose, one mutation at a time, and the test that notices. The list says how the "
        "mutations are chosen. It "
        "is a list and not a tool such as mutmut, because a tool changes every operator, "
        "mostly without an effect on "
        "the mirror, and takes days; the list holds the ways in which each decision about "
        "gas can be wrong.",
        "",
        (
            f"{listed} mutations are listed"
            if total == listed
            else f"{total} of {listed} were examined"
        )
        + f". **Fast tests kill {tests} of {total} ({100 * tests / max(total, 1):.0f} %), the "
        "campaign alone kills "
        f"{campaign} of {of_campaign} ({100 * share:.0f} %).** The campaign was run on mutations "
        f"drawn at random; its goal of {100 * CAMPAIGN_GOAL:.0f} % is {met}.",
        "",
        "The fast tests are those of control and devices, without the campaign, the "
        "real-time tests and the "
        "comparisons of generated documents "
        f"({', '.join(f'`{name}`' for name in COMPARISONS)}). The campaign is its "
        "short part (`python tests/campaign/campaign.py --short`).",
        "",
        "| mutation | in | killed by test | killed by campaign |",
        "|---|---|---|---|",
    ]
    lines += [
        f"| {v.mutant.what} | `{v.place}` | {_cell(v.by_tests)} | {_cell(v.by_campaign)} |"
        for v in verdicts
    ]
    lines += ["", "## Survivors", ""]
    for verdict in verdicts:
        by = (("tests", verdict.by_tests), ("campaign", verdict.by_campaign))
        who = [name for name, found in by if found == ""]
        if who:
            lines.append(
                f"- {verdict.mutant.what} ({' and '.join(who)}): "
                f"{verdict.mutant.lives or 'not examined'}"
            )
    return "\n".join(lines) + "\n"


def _cell(found: str | None) -> str:
    if found is None:
        return "not run"
    return f"`{found.replace('|', '/')}`" if found else "**no**"


def main(arguments: list[str] | None = None) -> int:
    """Examine the mutants; 1 if a share is below its goal."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--only", nargs="+", metavar="WORDS", help="mutations whose words contain one of these"
    )
    parser.add_argument("--missing", action="store_true", help="only those without a result")
    parser.add_argument(
        "--safety-case", action="store_true", help="only those that remove a rule or a guard"
    )
    parser.add_argument("--sample", type=int, metavar="NUMBER", help="so many, drawn at random")
    parser.add_argument(
        "--campaign-sample", type=int, metavar="NUMBER", help="run the campaign on so many of all"
    )
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args(arguments)
    listed, firsts = load()
    of_campaign = (
        listed if options.campaign_sample is None else sample(listed, options.campaign_sample)
    )
    chosen = listed
    if options.only:
        chosen = [
            mutant for mutant in chosen if any(words in mutant.what for words in options.only)
        ]
    if options.safety_case:
        chosen = [mutant for mutant in chosen if removes(mutant)]
    if options.sample is not None:
        chosen = sample(chosen, options.sample)
    if options.missing:
        known = {
            v.mutant
            for v in current_verdicts(listed)
            if v.by_campaign is not None or v.mutant not in of_campaign
        }
        chosen = [mutant for mutant in chosen if mutant not in known]
    examine_all(
        chosen, firsts, options.processes, [mutant for mutant in chosen if mutant in of_campaign]
    )
    verdicts = current_verdicts(listed)
    DOCUMENT.write_text(document(verdicts, len(listed)), encoding="utf-8")
    (tests, total), (campaign, run) = count_kills(verdicts)
    print(
        f"tests kill {tests} of {total}, the campaign {campaign} of {run}; {len(listed)} are listed"
    )
    return int(tests < TESTS_GOAL * total or campaign < CAMPAIGN_GOAL * run)


if __name__ == "__main__":
    sys.exit(main())
