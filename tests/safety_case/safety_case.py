"""docs/reference/safety-case.md, made from safety_case.toml, the safety table, the tests and the mutants'
results.

python tests/safety_case/safety_case.py            # writes the page
python tests/safety_case/safety_case.py --check    # writes nothing; names what is open or out of date, exits with 1
"""  # noqa: E501

from __future__ import annotations

import argparse
import re
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
for folder in (ROOT / "tests" / "mutants", ROOT):
    sys.path.insert(0, str(folder))  # it is run as a script, and imported by a test

from mutants import Verdict, current_verdicts, load, removes  # noqa: E402

from firmware_iface.register_map import load_default_map  # noqa: E402
from membrane_ctrl.controller.duties import Guard  # noqa: E402
from membrane_ctrl.controller.safety import TABLE  # noqa: E402
from membrane_ctrl.controller.safety_rule import Rule  # noqa: E402

SOURCE = Path(__file__).with_name("safety_case.toml")
DOCUMENT = ROOT / "docs" / "reference" / "safety-case.md"
OPERATIONS = ROOT / "docs" / "how-to" / "operations.md"
_RULES = {rule.name: rule for rule in TABLE}


@dataclass(frozen=True)
class External:
    """Hardware that the laboratory fits, and the step of docs/how-to/operations.md that tests
    it."""

    name: str
    step: str


@dataclass(frozen=True)
class Constraint:
    """What must hold so that a hazard does not come about, and what enforces it."""

    id: str
    hazards: list[str]
    action: str  # the unsafe control action
    text: str
    rules: list[str] = field(default_factory=list)
    guards: list[str] = field(default_factory=list)
    board: list[str] = field(default_factory=list)
    tests: list[str] = field(default_factory=list)
    external: list[External] = field(default_factory=list)


@dataclass(frozen=True)
class SafetyCase:
    """The whole source."""

    losses: dict[str, str]
    hazards: dict[str, dict[str, Any]]
    constraints: list[Constraint]


def load_case() -> SafetyCase:
    """Read safety_case.toml. Raises TypeError for an unknown key."""
    table = tomllib.loads(SOURCE.read_text(encoding="utf-8"))
    constraints = [
        Constraint(
            **{**entry, "external": [External(**each) for each in entry.get("external", [])]}
        )
        for entry in table["constraint"]
    ]
    losses = {loss["id"]: loss["text"] for loss in table["loss"]}
    return SafetyCase(losses, {hazard["id"]: hazard for hazard in table["hazard"]}, constraints)


@cache
def find_killed() -> dict[str, list[Verdict]]:
    """The mutations that fast tests kill, by the rule or guard that they remove."""
    killed: dict[str, list[Verdict]] = {}
    for verdict in current_verdicts(load()[0]):
        name = removes(verdict.mutant)
        if verdict.by_tests and name:
            killed.setdefault(name, []).append(verdict)
    return killed


@cache
def _test_texts() -> dict[str, str]:
    return {
        str(path.relative_to(ROOT)): path.read_text(encoding="utf-8")
        for path in (ROOT / "tests").rglob("*.py")
    }


def _tests_of_rule(name: str) -> list[str]:
    """Test files of the controller that name the rule."""
    return [
        path for path, text in _test_texts().items() if f'"{name}"' in text and "/test_" in path
    ]


def _tests_of_board_fault(name: str) -> list[str]:
    """Test files of the board and its emulator in which a line with the name of the fault compares
    or expects it.
    """
    names = rf"(\"{name}\"|'{name}'|\b{name.upper()}\b|_FAULT_{name.upper()}\b)"
    pattern = re.compile(names)
    wanted = ("tests/board/test_", "tests/firmware_iface/test_")
    return [
        path
        for path, text in _test_texts().items()
        if path.startswith(wanted) and pattern.search(text)
    ]


def find_gaps(case: SafetyCase) -> Iterator[str]:
    """What is open: a hazard without a constraint; a constraint, rule, guard or hardware without
    its proof.
    """
    for hazard, entry in case.hazards.items():
        if not any(hazard in constraint.hazards for constraint in case.constraints):
            yield f"{hazard}: no constraint prevents it"
        yield from (
            f"{hazard}: unknown loss {loss}" for loss in entry["losses"] if loss not in case.losses
        )
    for constraint in case.constraints:
        yield from _find_gaps_of(constraint, case)
    used = {name for constraint in case.constraints for name in constraint.rules}
    yield from (f"rule {name}: enforces no constraint" for name in _RULES if name not in used)
    guarding = {name for constraint in case.constraints for name in constraint.guards}
    yield from (
        f"guard {guard.name}: enforces no constraint"
        for guard in Guard
        if guard.name not in guarding
    )
    board = {name for constraint in case.constraints for name in constraint.board}
    yield from (
        f"board fault {f.name}: enforces no constraint"
        for f in load_default_map().faults
        if f.name not in board
    )


def _find_gaps_of(constraint: Constraint, case: SafetyCase) -> Iterator[str]:
    name, killed = constraint.id, find_killed()
    yield from (
        f"{name}: unknown hazard {hazard}"
        for hazard in constraint.hazards
        if hazard not in case.hazards
    )
    if not (
        constraint.rules
        or constraint.guards
        or constraint.board
        or constraint.tests
        or constraint.external
    ):
        yield f"{name}: nothing enforces it"
    for rule in constraint.rules:
        if rule not in _RULES:
            yield f"{name}: the safety table has no rule {rule}"
            continue
        if not _tests_of_rule(rule):
            yield f"{name}: no test names rule {rule}"
        if rule not in killed:
            yield f"{name}: no killed mutant removes rule {rule}"
    for guard in constraint.guards:
        if guard not in Guard.__members__:
            yield f"{name}: there is no guard {guard}"
        elif guard not in killed:
            yield f"{name}: no killed mutant removes guard {guard}"
    faults = {fault.name for fault in load_default_map().faults}
    for fault in constraint.board:
        if fault not in faults:
            yield f"{name}: the board has no fault {fault}"
        elif not _tests_of_board_fault(fault):
            yield f"{name}: no test of the board names {fault}"
    for path in constraint.tests:
        if "def test_" not in _test_texts().get(path, ""):
            yield f"{name}: {path} has no test"
    headings = OPERATIONS.read_text(encoding="utf-8")
    for hardware in constraint.external:
        if not re.search(rf"^#+ {re.escape(hardware.step)}$", headings, re.MULTILINE):
            yield (
                f"{name}: docs/how-to/operations.md has no step {hardware.step!r} "
                f"for the {hardware.name}"
            )


_HEAD = """# Safety case

Generated by `python tests/safety_case/safety_case.py` from `tests/safety_case/safety_case.toml`; CI fails if
anything in it is open. For a safety engineer who does not know the program: what can be lost, which states of the
system lead there, which constraints prevent them, and what enforces and proves each constraint (terms of STPA).

**The system.** A pump presses nitrogen between two films; a leak, or a vent, lets it out. A *board* drives pump
and vent, has its own pressure limit and a watchdog, and stops the pump by itself. A *controller* on a computer reads
laser, gauge, weather and camera 50 times a second (a *tick*), compares them with the *safety table* before it
decides anything, and then commands the board. A tripped rule enters a *safe level*: hold the mean flow for seconds,
ramp down, pump off, vent ([faults](faults.md)). A latched fault needs a person.

```
 operator, page, ctl, bridges ──commands──> controller ──pump, vent──> board ──drive──> pump, vent ──gas──> films
        ^                                     ^      ^                   |  ^                                 |
        └──── state, alarms, locks ───────────┘      └──── readings ─────┘  └──── gauge, interlock inputs ────┘
                                              └──────────── camera, laser, weather ───────────────────────────┘
```

**Numbers** (defaults; `membrane-ctrl config explain limits`): films work at 600 Pa; the controller vents above
750 Pa, the board at its own limit; displacement limits -2000 and +500 µm. The pump gives 5.3 µm/s or 0.26 Pa/s at
most, so that 150 Pa take ten minutes; the controller decides within 20 ms to some seconds ([fault
matrix](../measurements/fault-matrix.md)), the board's watchdog within 0.5 s.

**What this page does not claim.** No hardware has been driven yet: everything here is proved on simulated benches,
an emulated board and the board's firmware in an emulator. The relief valve, the emergency stop and the oxygen
monitor are the laboratory's; without them C1, C5 and C14 are not met. Electrical hazards, the laser's light and the
mechanics of pump and frame are outside. Severity and likelihood are not rated, and a killed mutant shows that a
rule is tested, not that it suffices.

**Assumptions and what remains.**

- *Bench with a pump board.* On a bench of single instruments nothing stops the pump if the computer fails: C12, and
  the board's part of C1, C2 and C5, do not hold there. Fit a board, or hardware that cuts the pump's power.
- *One gauge* serves the controller and the board (C1, C2): the relief valve is the independent protection.
- *Slow drifts* within what a room's climate does are found late (C9; [protection](../measurements/protection.md) has the distances).
- *Interlocks*: a welded contact or a short circuit of its wires is not found. *Locks* are known on one machine.
- *The actuator test* in `check` lasts for at most 14 s, with all sensors good; the pump is on for 8 s at a time at most.
- Everyone who may reach page, control port or a bridge with the role `operate` may command; [operations](../how-to/operations.md)
  has the roles. Locks and interlocks apply to all of them.

**How it is proved.** Each rule has tests, and at least one *mutant*: the rule is removed on purpose, and a test
must notice ([mutants](../measurements/mutants.md)). The [fault matrix](../measurements/fault-matrix.md), [sensor faults](../measurements/sensor-faults.md) and
[protection](../measurements/protection.md) inject failures into a simulated bench and judge its true state.
"""  # noqa: E501


def make_page(case: SafetyCase) -> str:
    """The page as Markdown."""
    lines = [_HEAD, "## Losses", "", "| | loss |", "|---|---|"]
    lines += [f"| {loss} | {text} |" for loss, text in case.losses.items()]
    lines += ["", "## Hazards", "", "| | hazard | leads to | prevented by |", "|---|---|---|---|"]
    for hazard, entry in case.hazards.items():
        by = ", ".join(
            constraint.id for constraint in case.constraints if hazard in constraint.hazards
        )
        lines.append(f"| {hazard} | {entry['text']} | {', '.join(entry['losses'])} | {by} |")
    lines += ["", "## Constraints", ""]
    lines += ["| | unsafe control action | constraint | hazards |", "|---|---|---|---|"]
    lines += [
        f"| {c.id} | {c.action} | {c.text} | {', '.join(c.hazards)} |" for c in case.constraints
    ]
    lines += ["", "## Enforcement and proof", ""]
    for constraint in case.constraints:
        lines += _describe(constraint)
    return "\n".join(lines).rstrip("\n") + "\n"


def _link_to_step(step: str) -> str:
    return f"../how-to/operations.md#{step.lower().replace(' ', '-')}"


def _describe(constraint: Constraint) -> list[str]:
    """One constraint's enforcement, with its proof."""
    lines = [
        f"### {constraint.id}: {constraint.text}",
        "",
        "| enforced by | acts | tested by | mutant that is killed |",
    ]
    lines += ["|---|---|---|---|"]
    killed = find_killed()
    for name in constraint.rules:
        rule: Rule = _RULES[name]
        verdicts = killed.get(name, [])
        by = f"`{verdicts[0].by_tests.split('::')[0]}`" if verdicts else ""
        acts = f"{rule.cause}: {rule.safe_level.name.lower().replace('_', ' ')}"
        lines.append(f"| rule {rule.code} `{name}` | {acts} | {by} | {_mutant(verdicts)} |")
    for name in constraint.guards:
        verdicts = killed.get(name, [])
        by = f"`{verdicts[0].by_tests.split('::')[0]}`" if verdicts else ""
        lines.append(
            f"| guard `{name.lower()}` | {Guard[name].value} | {by} | {_mutant(verdicts)} |"
        )
    for name in constraint.board:
        fault = next(fault for fault in load_default_map().faults if fault.name == name)
        by = ", ".join(f"`{Path(path).name}`" for path in _tests_of_board_fault(name)[:2])
        lines.append(f"| board fault {fault.bit} `{name}` | {fault.meaning} | {by} | - |")
    lines += [
        f"| program | tests of the constraint | `{Path(path).name}` | - |"
        for path in constraint.tests
    ]
    lines += [
        f"| external: {hardware.name} | fitted by the laboratory | commissioning step "
        f"[{hardware.step}]({_link_to_step(hardware.step)}) | - |"
        for hardware in constraint.external
    ]
    return [*lines, ""]


def _mutant(verdicts: list[Verdict]) -> str:
    return verdicts[0].mutant.what if verdicts else "**none**"


def main(arguments: list[str] | None = None) -> int:
    """Write the page, or name what is open; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true")
    check = parser.parse_args(arguments).check
    case = load_case()
    gaps = list(find_gaps(case))
    for gap in gaps:
        print(gap, file=sys.stderr)
    page = make_page(case)
    if not check:
        DOCUMENT.write_text(page, encoding="utf-8")
    elif not DOCUMENT.exists() or DOCUMENT.read_text(encoding="utf-8") != page:
        gaps.append("docs/reference/safety-case.md is out of date")
        print(gaps[-1], file=sys.stderr)
    return int(bool(gaps))


if __name__ == "__main__":
    sys.exit(main())
