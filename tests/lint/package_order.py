"""Size and order of the code: `python -m tests.lint.package_order` prints them.

The exit code is 1 if a limit of the order is exceeded.

A *package* is here a package directly under `membrane_ctrl`, a single module there,
`firmware_iface` or `tuning`. Its *layer* is one above the highest layer that it imports from;
packages that import each other in a cycle have the same layer.
"""

from __future__ import annotations

import ast
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
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
    def package(self) -> str:
        """Where it lives: `membrane_ctrl/<package or loose module>`,
        `firmware_iface` or `tuning`.
        """
        parts = self.name.split(".")
        return "/".join(parts[:2]) if parts[0] == "membrane_ctrl" else parts[0]


@dataclass(frozen=True)
class CodeFigures:
    """Size and order of the code."""

    modules: int
    lines: int
    largest_folder: int
    import_percent: float
    loose: int
    layers: int
    largest_cycle: int


# The size has no limit: a module is as large as its concept. The order has limits: packages must
# not import each other in a cycle, `docs/explanation/architecture.md` explains nine layers, and a
# loose module belongs to no package. If imports are more than 8 % of the lines, concepts are spread
# over too many modules; with one concept a module they are 6.6 %.
ORDER_LIMITS = {"import_percent": 8.0, "loose": 3, "layers": 9, "largest_cycle": 1}


def import_nodes(tree: ast.AST) -> Iterator[ast.Import | ast.ImportFrom]:
    """Yield the import statements of a file, also those inside functions."""
    return (node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom))


def imported(nodes: Iterable[ast.Import | ast.ImportFrom]) -> Iterator[str]:
    """Yield each imported name in full: `package.module` or `package.module.name`."""
    for node in nodes:
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
def tree_of(path: Path) -> ast.Module:
    """Return the syntax tree of a file."""
    return ast.parse(path.read_text(encoding="utf-8"))


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
        nodes = list(import_nodes(tree_of(path)))
        targets = frozenset(
            target for full in imported(nodes) if (target := module_of(full, known))
        )
        import_lines = sum(node.end_lineno - node.lineno + 1 for node in nodes if node.end_lineno)
        lines = path.read_text(encoding="utf-8").count("\n")
        found[name] = Module(name, path, lines, import_lines, targets)
    return found


def imports_between_packages(found: dict[str, Module]) -> dict[str, set[str]]:
    """Return the packages that each package imports from."""
    edges: dict[str, set[str]] = {
        module.package: set() for module in found.values() if "__init__" not in module.package
    }
    for module in found.values():
        targets = {found[name].package for name in module.imports} - {module.package}
        edges.setdefault(module.package, set()).update(t for t in targets if "__init__" not in t)
    return edges


def cycles_of(edges: dict[str, set[str]]) -> dict[str, frozenset[str]]:
    """Return each package's cycle: itself and the packages that it reaches and that reach it."""

    def reached(start: str) -> set[str]:
        seen, todo = set[str](), [start]
        while todo:
            for target in edges[todo.pop()] - seen:
                seen.add(target)
                todo.append(target)
        return seen

    reach = {package: reached(package) for package in edges}
    return {
        package: frozenset(
            {package} | {other for other in reach[package] if package in reach[other]}
        )
        for package in edges
    }


def layers_of(edges: dict[str, set[str]]) -> dict[str, int]:
    """Return each package's layer, 1 for one that imports nothing."""
    cycles = cycles_of(edges)

    @cache
    def layer(cycle: frozenset[str]) -> int:
        return 1 + max(
            (layer(cycles[t]) for package in cycle for t in edges[package] - cycle), default=0
        )

    return {package: layer(cycle) for package, cycle in cycles.items()}


def measure_code(root: Path = ROOT) -> CodeFigures:
    """Measure size and order of the code."""
    found = modules(root)
    edges = imports_between_packages(found)
    plain = [module for module in found.values() if module.path.name != "__init__.py"]
    lines = sum(module.lines for module in found.values())
    return CodeFigures(
        modules=len(plain),
        lines=lines,
        import_percent=100 * sum(module.import_lines for module in found.values()) / lines,
        loose=len(list((root / "membrane_ctrl").glob("*.py"))),
        largest_folder=max(Counter(module.path.parent for module in plain).values()),
        layers=max(layers_of(edges).values()),
        largest_cycle=max(map(len, cycles_of(edges).values())),
    )


def main() -> int:
    """Print each figure, beside its limit if it has one; return 1 if one is above it."""
    exceeded = False
    for name, value in vars(measure_code()).items():
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
