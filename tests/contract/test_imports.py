"""The house rules that a reader relies on: who may import whom, where systems live, what a file looks like."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache

from tests.places import ROOT

# Imports point one way.
MAY_IMPORT = {
    "models": {"models"},
    "calibration": {"models", "calibration"},
    "welding": {"models", "welding"},
    "systems": {"models", "calibration", "welding", "systems"},
    "tools": {"models", "calibration", "welding", "systems", "tools"},
}
FILES = {
    path.relative_to(ROOT).as_posix(): path for folder in MAY_IMPORT for path in sorted((ROOT / folder).rglob("*.py"))
}

# Where the simulation's truth may be spoken of: where it is made, and where it is handed on to reports.
TRUTH_IS_KNOWN = (
    "systems/drivers/",
    "systems/station.py",
    "systems/cell.py",
    "systems/jobs/profiler/cell.py",
    "tools/",
)

LONGEST_FILE = 500


def imported(tree: ast.Module) -> Iterator[str]:
    """The dotted name of every module that the file imports, at its top or inside a function."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            module = node.module or ""
            yield from (f"{module}.{alias.name}" for alias in node.names)


def called(tree: ast.Module) -> set[str]:
    """The plain names that the file calls."""
    return {node.func.id for node in ast.walk(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}


def names(tree: ast.Module) -> set[str]:
    """Every identifier of the file: names, attributes and what is imported."""
    plain = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    attributes = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    return plain | attributes | {name.rsplit(".", 1)[-1] for name in imported(tree)}


@cache
def trees() -> dict[str, ast.Module]:
    """Every file, parsed: when the first test asks, for collecting happens in every process of a run."""
    return {name: ast.parse(path.read_text(), filename=name) for name, path in FILES.items()}


def test_imports_point_one_way() -> None:
    wrong = [
        f"{name} imports {module}"
        for name, tree in trees().items()
        for module in imported(tree)
        if module.startswith("weldcal.") and module.split(".")[1] not in MAY_IMPORT[name.split("/")[0]]
    ]
    assert wrong == []


def test_the_import_name_is_always_weldcal() -> None:
    bare = {*MAY_IMPORT, "tests", "pytest", "hypothesis", "selenium"}
    wrong = [
        f"{name}: {module}"
        for name, tree in trees().items()
        for module in imported(tree)
        if module.split(".")[0] in bare
    ]
    assert wrong == []


def test_diagram_systems_live_in_systems_only() -> None:
    holders = [name for name, tree in trees().items() if names(tree) & {"LeafSystem", "VectorSystem"}]
    assert holders, "the cell has systems"
    assert [name for name in holders if not name.startswith("systems/")] == []


def test_no_algorithm_speaks_of_the_simulations_truth() -> None:
    speakers = [name for name, path in FILES.items() if "cheat" in path.read_text()]
    assert [name for name in speakers if not name.startswith(TRUTH_IS_KNOWN)] == []


def test_nothing_prints_and_nothing_changes_globals() -> None:
    assert [name for name, tree in trees().items() if "print" in called(tree)] == []
    assert [
        name for name, tree in trees().items() if any(isinstance(node, ast.Global) for node in ast.walk(tree))
    ] == []


def test_each_file_says_its_one_idea_first() -> None:
    silent = [name for name, tree in trees().items() if len((ast.get_docstring(tree) or "").split("\n")[0]) < 16]
    assert silent == []


def test_no_file_is_long() -> None:
    lengths = {name: len(path.read_text().splitlines()) for name, path in FILES.items()}
    assert {name: length for name, length in lengths.items() if length > LONGEST_FILE} == {}


def test_the_rules_would_catch_an_offender() -> None:
    offender = ast.parse("from weldcal.calibration import rigid\nimport models\nprint(1)\nclass A(LeafSystem): pass")
    assert set(imported(offender)) == {"weldcal.calibration.geometry.rigid", "models"}
    assert "print" in called(offender)
    assert "LeafSystem" in names(offender)


def test_every_folder_is_looked_at() -> None:
    assert {name.split("/")[0] for name in FILES} == set(MAY_IMPORT)
