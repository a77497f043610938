"""Figures of the house: its size and its order; `python -m tests.lint.package_order` prints both
and judges the order.

A *room* is a package directly under `membrane_ctrl`, a loose module there, `firmware_iface` or
`tuning`. A room's
*floor* is one above the highest floor that it imports from; rooms that import each other in a
circle share one.
"""

from __future__ import annotations

import ast
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
TOPS = ("membrane_ctrl", "firmware_iface", "tuning")


@dataclass(frozen=True)
class Module:
    """A module of the product.

    Attributes
    ----------
    name : str
        Dotted; a package's `__init__` has the suffix `.__init__`.
    path : Path
        Its file.
    lines, import_lines : int
        Lines of the file, and those that import statements cover.
    imports : frozenset of str
        Modules of the product that it imports, also inside functions.
    """

    name: str
    path: Path
    lines: int
    import_lines: int
    imports: frozenset[str]

    @property
    def room(self) -> str:
        """Where it lives: `membrane_ctrl/<package or loose module>`,
        `firmware_iface` or `tuning`.
        """
        parts = self.name.split(".")
        return "/".join(parts[:2]) if parts[0] == "membrane_ctrl" else parts[0]


@dataclass(frozen=True)
class HouseFigures:
    """Size and order of the code."""

    modules: int
    lines: int
    largest_folder: int
    import_percent: float
    loose: int
    floors: int
    largest_circle: int


# The size has no limit: a module is as large as its concept. The order has: rooms must not import
# each other in a circle, `docs/explanation/architecture.md` explains nine floors, and a loose
# module belongs to no room. More than 6 % of the lines as imports means that concepts are spread
# over too many modules; a concept a
# module
# has 5 %.
ORDER_LIMITS = {"import_percent": 6.0, "loose": 3, "floors": 9, "largest_circle": 1}


def import_nodes(tree: ast.AST) -> Iterator[ast.Import | ast.ImportFrom]:
    """Yield the import statements of a file, also those inside functions."""
    return (node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom))


def imported(tree: ast.AST) -> Iterator[str]:
    """Yield each imported name in full: `package.module` or `package.module.name`."""
    for node in import_nodes(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def module_of(name: str, known: frozenset[str]) -> str | None:
    """Return the module of the product that defines an imported name; None for other packages."""
    while name:
        for candidate in (name, f"{name}.__init__"):
            if candidate in known:
                return candidate
        name = name.rpartition(".")[0]
    return None


@cache
def modules(root: Path = ROOT) -> dict[str, Module]:
    """Read every module of the product; keys are dotted names."""
    paths = {
        ".".join(p.relative_to(root).with_suffix("").parts): p
        for top in TOPS
        for p in (root / top).rglob("*.py")
    }
    known = frozenset(paths)
    found = {}
    for name, path in paths.items():
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        targets = frozenset(target for full in imported(tree) if (target := module_of(full, known)))
        import_lines = sum(
            node.end_lineno - node.lineno + 1 for node in import_nodes(tree) if node.end_lineno
        )
        found[name] = Module(name, path, text.count("\n"), import_lines, targets)
    return found


def rooms(found: dict[str, Module]) -> dict[str, set[str]]:
    """Return the rooms that each room imports from."""
    edges: dict[str, set[str]] = {
        module.room: set() for module in found.values() if "__init__" not in module.room
    }
    for module in found.values():
        targets = {found[name].room for name in module.imports} - {module.room}
        edges.setdefault(module.room, set()).update(t for t in targets if "__init__" not in t)
    return edges


def circle_of(edges: dict[str, set[str]]) -> dict[str, frozenset[str]]:
    """Return each room's circle: the rooms that it reaches and that reach it, itself included."""

    def reached(start: str) -> set[str]:
        seen, todo = set[str](), [start]
        while todo:
            for target in edges[todo.pop()] - seen:
                seen.add(target)
                todo.append(target)
        return seen

    reach = {room: reached(room) for room in edges}
    return {
        room: frozenset({room} | {other for other in reach[room] if room in reach[other]})
        for room in edges
    }


def floors(edges: dict[str, set[str]]) -> dict[str, int]:
    """Return each room's floor, 1 for one that imports nothing."""
    circles = circle_of(edges)

    @cache
    def floor(circle: frozenset[str]) -> int:
        return 1 + max(
            (floor(circles[t]) for room in circle for t in edges[room] - circle), default=0
        )

    return {room: floor(circle) for room, circle in circles.items()}


def figures(root: Path = ROOT) -> HouseFigures:
    """Measure the house."""
    found = modules(root)
    edges = rooms(found)
    plain = [module for module in found.values() if module.path.name != "__init__.py"]
    lines = sum(module.lines for module in found.values())
    return HouseFigures(
        modules=len(plain),
        lines=lines,
        import_percent=100 * sum(module.import_lines for module in found.values()) / lines,
        loose=len(list((root / "membrane_ctrl").glob("*.py"))),
        largest_folder=max(Counter(module.path.parent for module in plain).values()),
        floors=max(floors(edges).values()),
        largest_circle=max(map(len, circle_of(edges).values())),
    )


def main() -> int:
    """Print each figure, beside its limit if it has one; return 1 if one is above it."""
    exceeded = False
    for name, value in vars(figures()).items():
        line = f"{name.replace('_', ' '):16} {value:10.6g}"
        if name in ORDER_LIMITS:
            limit = ORDER_LIMITS[name]
            line += f"   at most {limit:g}"
            if value > limit:
                line += "   TOO MANY"
                exceeded = True
        print(line)
    return int(exceeded)


if __name__ == "__main__":
    sys.exit(main())
