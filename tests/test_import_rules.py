"""Who may import whom (docs/explanation/architecture.md). A broken rule here
means that the design has slipped.
"""

from __future__ import annotations

import ast
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

from tests.lint.package_order import (
    ROOT,
    TOPS,
    cycles_of,
    import_nodes,
    imported,
    imports_between_packages,
    layers_of,
    module_of,
    modules,
    tree_of,
)

IO = {
    "asyncio",
    "socket",
    "threading",
    "multiprocessing",
    "subprocess",
    "time",
    "datetime",
    "rerun",
    "serial",
    "pymodbus",
}
PLAIN_DATA = {"membrane_ctrl.config", "membrane_ctrl.model"}
NOT_PLAIN = {
    "membrane_ctrl.model.files",
    "membrane_ctrl.model.terminal",
    "membrane_ctrl.config.toml_file",
}  # I/O

# Each package with its layer: it imports from lower layers only. A new package is entered here and
# in docs/explanation/architecture.md.
LAYERS = {
    1: {
        "firmware_iface",
        "membrane_ctrl/__init__",
        "membrane_ctrl/model",
        "membrane_ctrl/report_pages",
    },
    2: {"membrane_ctrl/config", "membrane_ctrl/drawing"},
    3: {
        "membrane_ctrl/control",
        "membrane_ctrl/instruments",
        "membrane_ctrl/metrology",
        "membrane_ctrl/processes",
    },
    4: {
        "membrane_ctrl/alarms",
        "membrane_ctrl/controller",
        "membrane_ctrl/geometry",
        "membrane_ctrl/sim",
    },
    5: {"membrane_ctrl/control_port", "membrane_ctrl/measure", "membrane_ctrl/run_files"},
    6: {
        "membrane_ctrl/acquisition",
        "membrane_ctrl/console",
        "membrane_ctrl/paper",
        "membrane_ctrl/recorder",
        "membrane_ctrl/replay",
        "membrane_ctrl/sessions",
    },
    7: {
        "membrane_ctrl/calibration",
        "membrane_ctrl/commissioning",
        "membrane_ctrl/hold",
        "membrane_ctrl/review",
    },
    8: {"membrane_ctrl/cli", "membrane_ctrl/service", "tuning"},
    9: {"membrane_ctrl/__main__", "membrane_ctrl/bridges", "membrane_ctrl/web"},
}


@cache
def imports_of(path: Path) -> set[str]:
    """Every name that a file imports, in full, also inside functions."""
    nodes = list(import_nodes(tree_of(path)))
    assert not any(isinstance(node, ast.ImportFrom) and node.level for node in nodes), (
        f"{path}: relative import"
    )
    return set(imported(nodes))


def files_of(*folders: str) -> list[Path]:
    """Python files under the folders (or the file itself)."""
    paths = [ROOT / folder for folder in folders]
    files = [
        file for path in paths for file in ([path] if path.suffix else sorted(path.rglob("*.py")))
    ]
    assert files, folders
    return files


def ours(names: set[str]) -> set[str]:
    """Those of `names` that are this project's."""
    return {
        name
        for name in names
        if name.split(".")[0] in {"membrane_ctrl", "firmware_iface", "tuning"}
    }


def allowed(module: str, prefixes: set[str]) -> bool:
    """`module` is one of the prefixes or inside one."""
    return any(module == prefix or module.startswith(prefix + ".") for prefix in prefixes)


def test_packages_import_from_lower_layers_and_never_in_a_cycle() -> None:
    edges = imports_between_packages(modules())
    assert {package: cycle for package, cycle in cycles_of(edges).items() if len(cycle) > 1} == {}
    assert layers_of(edges) == {
        package: layer for layer, names in LAYERS.items() for package in names
    }


def test_a_cycle_is_found() -> None:
    edges = {"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}}
    assert cycles_of(edges)["b"] == {"b", "c"}
    assert layers_of(edges) == {"a": 2, "b": 1, "c": 1, "d": 3}


def test_a_class_name_means_one_thing() -> None:
    trees = (tree_of(file) for file in files_of(*TOPS))
    names = Counter(
        node.name for tree in trees for node in tree.body if isinstance(node, ast.ClassDef)
    )
    assert [name for name, count in names.items() if count > 1] == []


@pytest.mark.parametrize("file", files_of("membrane_ctrl/control"), ids=str)
def test_control_is_pure(file: Path) -> None:
    found = imports_of(file)
    assert not {m for m in found if allowed(m, IO | NOT_PLAIN)}


@pytest.mark.parametrize("file", files_of("membrane_ctrl/metrology"), ids=str)
def test_metrology_is_pure(file: Path) -> None:
    found = imports_of(file)
    may = {"membrane_ctrl.metrology", "firmware_iface.optical_roles"} | PLAIN_DATA
    assert not {m for m in ours(found) if not allowed(m, may)}
    assert not {m for m in found if allowed(m, IO | NOT_PLAIN)}


@pytest.mark.parametrize("file", files_of("membrane_ctrl/controller"), ids=str)
def test_the_tick_is_pure(file: Path) -> None:
    found = imports_of(file)
    may = {"membrane_ctrl.control", "membrane_ctrl.controller"}
    may |= {"firmware_iface.roles", "firmware_iface.register_map", "firmware_iface.settings"}
    assert not {m for m in ours(found) if not allowed(m, may | PLAIN_DATA)}
    assert not {m for m in found if allowed(m, IO | NOT_PLAIN)}


@pytest.mark.parametrize("name", ["safety", "safety_rule", "observation", "state_sets"])
def test_safety_imports_only_plain_data(name: str) -> None:
    (file,) = files_of(f"membrane_ctrl/controller/{name}.py")
    may = {"firmware_iface.roles", "membrane_ctrl.controller.link_report"}
    may |= {f"membrane_ctrl.controller.{other}" for other in ("safety_rule", "observation")}
    may |= {"membrane_ctrl.controller.state_sets"}
    assert not {m for m in ours(imports_of(file)) if not allowed(m, may | PLAIN_DATA)}


@pytest.mark.parametrize("file", files_of("membrane_ctrl/sim"), ids=str)
def test_the_twin_shares_nothing_with_the_inverse(file: Path) -> None:
    assert not {m for m in imports_of(file) if allowed(m, {"membrane_ctrl.metrology"})}


def modules_reached(start: str) -> set[str]:
    """All modules of ours that importing `start` pulls in at import time (imports inside functions
    are not).
    """
    known = modules()
    seen: set[str] = set()
    todo = [start]
    while todo:
        name = todo.pop()
        if name in seen:
            continue
        seen.add(name)
        top = tree_of(known[name].path).body
        plain = [node for node in top if isinstance(node, ast.Import | ast.ImportFrom)]
        todo += [
            target for full in imported(plain) if (target := module_of(full, frozenset(known)))
        ]
    return seen


def test_the_control_process_loads_no_image_code_and_no_rerun() -> None:
    """Nothing that could stall a tick is even imported."""
    reached = modules_reached("membrane_ctrl.hold.supervisor")
    heavy = {
        "membrane_ctrl.recorder",
        "membrane_ctrl.acquisition",
        "membrane_ctrl.metrology",
        "membrane_ctrl.sim",
    }
    assert not {m for m in reached if allowed(m, heavy)}


# What runs code, or makes arbitrary objects, from bytes. Between this program's own parent and
# children `multiprocessing` pickles by itself (what a child is given, what it reports): neither a
# file nor a name that a stranger could give leads there.
MAKES_OBJECTS = {
    "pickle",
    "_pickle",
    "marshal",
    "shelve",
    "dill",
    "cloudpickle",
    "joblib",
    "yaml",
    "jsonpickle",
}
RUNS_CODE = {"eval", "exec", "compile", "__import__", "execfile"}


def unsafe(path: Path) -> set[str]:
    """Parts of a file that could run code from data."""
    tree = tree_of(path)
    found = {module for module in imports_of(path) if module.split(".")[0] in MAKES_OBJECTS}
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        name = ast.unparse(node.func) if isinstance(node.func, ast.Name | ast.Attribute) else ""
        allows = [word for word in node.keywords if word.arg == "allow_pickle"]
        if name in RUNS_CODE or any(ast.unparse(word.value) != "False" for word in allows):
            found.add(ast.unparse(node))
        if name in {"np.load", "numpy.load"} and not allows:  # its default may change
            found.add(ast.unparse(node))
    return found


def test_tests_do_not_import_benchmarks() -> None:
    """What both use is in `tests/worlds` (simulated benches) and `tests/studies` (runs on them)."""
    users = {
        str(file.relative_to(ROOT))
        for file in files_of("tests")
        if "benchmarks" in file.read_text(encoding="utf-8")  # the syntax tree takes much longer
        and any(module.split(".")[0] == "benchmarks" for module in imports_of(file))
    }
    assert users == set()


@pytest.mark.parametrize("folder", ["membrane_ctrl", "firmware_iface", "tuning", "benchmarks"])
def test_no_data_is_run_or_unpickled(folder: str) -> None:
    assert {str(file): what for file in files_of(folder) if (what := unsafe(file))} == {}


@pytest.mark.parametrize(
    "line",
    [
        "import pickle",
        "from pickle import loads",
        "import numpy as np\nnp.load('x')",
        "import numpy as np\nnp.load('x', allow_pickle=1 > 0)",
        "eval('1')",
        "def f():\n    import yaml",
    ],
)
def test_the_rule_finds_what_would_run_data(tmp_path: Path, line: str) -> None:
    (tmp_path / "bad.py").write_text(line + "\n")
    assert unsafe(tmp_path / "bad.py")


def test_the_rules_find_a_broken_one(tmp_path: Path) -> None:
    """The checker itself: it finds an import inside a function."""
    bad = tmp_path / "bad.py"
    bad.write_text("def f():\n    from membrane_ctrl.metrology import phase\n")
    assert allowed("membrane_ctrl.metrology.phase", {"membrane_ctrl.metrology"})
    assert any(allowed(m, {"membrane_ctrl.metrology"}) for m in imports_of(bad))
