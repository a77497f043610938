"""Who may import whom (docs/architecture.md). A rule that is broken here is a design that has slipped."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PLAIN_DATA = {"membrane_ctrl.config", "membrane_ctrl.estimate", "membrane_ctrl.names", "membrane_ctrl.telemetry"}
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


def imports_of(path: Path) -> set[str]:
    """Every module that a file imports, also inside functions; names imported from a package count as modules."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found.add(node.module or "")
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return found


def files_of(*folders: str) -> list[Path]:
    """Python files under the folders (or the file itself)."""
    paths = [ROOT / folder for folder in folders]
    files = [file for path in paths for file in ([path] if path.suffix else sorted(path.rglob("*.py")))]
    assert files, folders
    return files


def ours(modules: set[str]) -> set[str]:
    """Those of `modules` that are this project's."""
    return {m for m in modules if m.split(".")[0] in {"membrane_ctrl", "firmware_iface", "tuning"}}


def allowed(module: str, prefixes: set[str]) -> bool:
    """`module` is one of the prefixes or inside one."""
    return any(module == prefix or module.startswith(prefix + ".") for prefix in prefixes)


@pytest.mark.parametrize("file", files_of("firmware_iface"), ids=str)
def test_firmware_iface_imports_nothing_of_ours(file: Path) -> None:
    assert not {m for m in ours(imports_of(file)) if not allowed(m, {"firmware_iface"})}


@pytest.mark.parametrize("file", files_of("membrane_ctrl/control"), ids=str)
def test_control_is_pure(file: Path) -> None:
    found = imports_of(file)
    assert not {m for m in ours(found) if not allowed(m, {"membrane_ctrl.control"} | PLAIN_DATA)}
    assert not {m for m in found if allowed(m, IO)}


@pytest.mark.parametrize("file", files_of("membrane_ctrl/metrology"), ids=str)
def test_metrology_is_pure(file: Path) -> None:
    found = imports_of(file)
    may = {"membrane_ctrl.metrology", "firmware_iface.roles", "membrane_ctrl.errors"} | PLAIN_DATA
    assert not {m for m in ours(found) if not allowed(m, may)}
    assert not {m for m in found if allowed(m, IO)}


@pytest.mark.parametrize("file", files_of("membrane_ctrl/safety.py"), ids=str)
def test_safety_is_pure(file: Path) -> None:
    found = imports_of(file)
    assert not {m for m in ours(found) if not allowed(m, {"firmware_iface.roles"} | PLAIN_DATA)}
    assert not {m for m in found if allowed(m, IO)}


@pytest.mark.parametrize("file", files_of("membrane_ctrl/twin"), ids=str)
def test_the_twin_shares_nothing_with_the_inverse(file: Path) -> None:
    assert not {m for m in imports_of(file) if allowed(m, {"membrane_ctrl.metrology"})}


def modules_reached(start: str) -> set[str]:
    """All of our modules that importing `start` pulls in at import time (imports inside functions are not)."""
    seen: set[str] = set()
    todo = [start]
    while todo:
        module = todo.pop()
        path = ROOT / Path(*module.split("."))
        file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        if module in seen or not file.exists():
            continue
        seen.add(module)
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.Import):
                todo.extend(alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module:
                todo.append(node.module)
                todo.extend(f"{node.module}.{alias.name}" for alias in node.names)
                seen.add(node.module)
    return seen


def test_the_control_process_loads_no_image_code_and_no_rerun() -> None:
    """Nothing that could stall a tick is even imported beside it."""
    reached = modules_reached("membrane_ctrl.supervisor")
    heavy = {"membrane_ctrl.recording", "membrane_ctrl.acquisition", "membrane_ctrl.metrology", "membrane_ctrl.twin"}
    assert not {m for m in reached if allowed(m, heavy)}


# What runs code, or makes whatever object it is told to, out of bytes. Between this program's own parent and children
# `multiprocessing` pickles by itself (what a child is given, what it reports): neither a file nor a name that a
# stranger could give leads there.
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
    """What in a file could run code out of data."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    found = {module for module in imports_of(path) if module.split(".")[0] in MAKES_OBJECTS}
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        name = ast.unparse(node.func)
        allows = [word for word in node.keywords if word.arg == "allow_pickle"]
        if name in RUNS_CODE or any(ast.unparse(word.value) != "False" for word in allows):
            found.add(ast.unparse(node))
        if name in {"np.load", "numpy.load"} and not allows:  # its default may change
            found.add(ast.unparse(node))
    return found


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
def test_the_rule_sees_what_would_run_data(tmp_path: Path, line: str) -> None:
    (tmp_path / "bad.py").write_text(line + "\n")
    assert unsafe(tmp_path / "bad.py")


def test_the_rules_see_a_broken_one(tmp_path: Path) -> None:
    """The checker itself: a late import inside a function does not escape it."""
    bad = tmp_path / "bad.py"
    bad.write_text("def f():\n    from membrane_ctrl.metrology import phase\n")
    assert allowed("membrane_ctrl.metrology.phase", {"membrane_ctrl.metrology"})
    assert any(allowed(m, {"membrane_ctrl.metrology"}) for m in imports_of(bad))
