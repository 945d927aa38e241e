"""The house rules that a reader relies on: who may import whom, where systems live, what a file looks like."""

from __future__ import annotations

import ast
import gc
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.places import ROOT

FOLDERS = ("models", "calibration", "welding", "systems", "tools")
FILES = {
    path.relative_to(ROOT).as_posix(): path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))
}

# Where the simulation's truth may be spoken of: where it is made, and where it is handed on to reports.
TRUTH_IS_KNOWN = (
    *("systems/drivers/", "systems/station.py", "tools/"),
    *(
        "systems/jobs/weld/job.py",
        "systems/jobs/profiler/job.py",
        "systems/jobs/motion/job.py",
    ),  # what the log may show
    *("systems/jobs/mounting/job.py", "systems/jobs/tablet/job.py"),  # what a report compares with
    "systems/jobs/tablet/config.py",  # what it is made of
    "systems/recording/tap.py",  # what a recording leaves out
)

LONGEST_FILE = 500


@cache
def nodes(tree: ast.Module) -> tuple[ast.AST, ...]:
    """All of a file: every rule looks at all files, and to walk through them takes longer than to parse them."""
    return tuple(ast.walk(tree))


def imported(tree: ast.Module) -> Iterator[str]:
    """The dotted name of every module that the file imports, at its top or inside a function."""
    for node in nodes(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            module = node.module or ""
            yield from (f"{module}.{alias.name}" for alias in node.names)


def called(tree: ast.Module) -> set[str]:
    """The plain names that the file calls."""
    return {node.func.id for node in nodes(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}


def names(tree: ast.Module) -> set[str]:
    """Every identifier of the file: names, attributes and what is imported."""
    plain = {node.id for node in nodes(tree) if isinstance(node, ast.Name)}
    attributes = {node.attr for node in nodes(tree) if isinstance(node, ast.Attribute)}
    return plain | attributes | {name.rsplit(".", 1)[-1] for name in imported(tree)}


@cache
def trees() -> dict[str, ast.Module]:
    """Every file, parsed: when the first test asks, for collecting happens in every process of a run.

    A tree has no garbage, and to look for it among a million nodes takes three times as long as to parse them.
    """
    gc.disable()
    try:
        return {name: ast.parse(path.read_text(), filename=name) for name, path in FILES.items()}
    finally:
        gc.enable()


@pytest.fixture(scope="module", autouse=True)
def forgotten() -> Iterator[None]:
    """A million nodes are not kept for the files after this one, whose garbage collector would look through them."""
    yield
    trees.cache_clear()
    nodes.cache_clear()


def of_the_truth(tree: ast.Module) -> set[str]:
    """What the file says of the simulation's truth: attributes and types with `truth` in them, and ports called
    `cheat`."""
    attributes = {node.attr for node in nodes(tree) if isinstance(node, ast.Attribute)}
    texts = {node.value for node in nodes(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    types = names(tree) | {node.name for node in nodes(tree) if isinstance(node, ast.ClassDef)}
    spoken = {name for name in attributes if "truth" in name.lower()} | {name for name in types if "Truth" in name}
    return spoken | {text for text in texts if re.search(r"\bcheat\b", text)}


def lint_imports(folder: Path) -> subprocess.CompletedProcess[str]:
    """Check the contracts of pyproject.toml against the packages that lie under weldcal/ in a folder."""
    environment = {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"}
    command = [sys.executable, "-P", "-c", "from importlinter.cli import lint_imports_command; lint_imports_command()"]
    return subprocess.run(
        [*command, "--config", str(ROOT / "pyproject.toml"), "--no-cache"],
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
        env=environment,
        timeout=120,
    )


@pytest.fixture(scope="module")
def copied(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The packages' modules in a folder of their own, to be spoilt."""
    folder = tmp_path_factory.mktemp("contracts")
    for name, path in FILES.items():
        target = folder / "weldcal" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, target)
    shutil.copy(
        ROOT / "__init__.py", folder / "weldcal" / "__init__.py"
    )  # a package of its own, before the installed one
    return folder


def test_the_contracts_on_imports_are_kept(copied: Path) -> None:
    finished = lint_imports(copied)
    assert finished.returncode == 0, finished.stdout
    assert "6 kept, 0 broken" in finished.stdout


OFFENDERS = (
    ("models/offender.py", "from weldcal.systems import messages", "Imports point one way"),
    ("calibration/offender.py", "from weldcal.welding import numerics", "Imports point one way"),
    ("calibration/geometry/offender.py", "from weldcal.calibration.data import clouds", "Inside calibration"),
    ("tools/report/offender.py", "from weldcal.tools.commands import calibrate", "Inside tools"),
    ("systems/offender.py", "from weldcal.tools.cli import app", "Imports point one way"),
    ("tools/api.py", "from weldcal.tools.commands import demo", "tools/api.py imports no command"),
)


def test_each_import_that_points_the_wrong_way_breaks_its_contract(copied: Path) -> None:
    """All at once: one look through the packages takes seconds."""
    kept = (copied / "weldcal/tools/api.py").read_text()
    for module, text, _ in OFFENDERS:
        (copied / "weldcal" / module).write_text(f"from typing import TYPE_CHECKING\n\nif TYPE_CHECKING:\n    {text}\n")
    finished = lint_imports(copied)
    for module, _, _ in OFFENDERS:
        (copied / "weldcal" / module).unlink()
    (copied / "weldcal/tools/api.py").write_text(kept)
    assert finished.returncode == 1
    verdicts, _, details = finished.stdout.partition("Broken contracts")
    found = re.findall(r"(\w.*?) (KEPT|BROKEN)", " ".join(verdicts.split()))
    broken = {name for name, verdict in found if verdict == "BROKEN"}
    wanted = {broken_one for _, _, broken_one in OFFENDERS}
    assert len(broken) == len(wanted), finished.stdout
    assert all(any(part in name for name in broken) for part in wanted), finished.stdout
    for module, text, _ in OFFENDERS:
        offender = "weldcal." + module.removesuffix(".py").replace("/", ".")
        imported = ".".join(text.removeprefix("from ").split(" import "))
        assert f"{offender} -> {imported}" in details, finished.stdout


def test_a_circle_of_imports_breaks_a_contract(copied: Path) -> None:
    first, second = (copied / "weldcal/models" / name for name in ("first.py", "second.py"))
    first.write_text("from weldcal.models import second\n")
    second.write_text("from weldcal.models import first\n")
    finished = lint_imports(copied)
    first.unlink()
    second.unlink()
    assert finished.returncode == 1
    assert "weldcal.models.first -> weldcal.models.second -> weldcal.models.first" in " ".join(finished.stdout.split())


def test_the_import_name_is_always_weldcal() -> None:
    bare = {*FOLDERS, "tests", "pytest", "hypothesis", "selenium"}
    wrong = [
        f"{name}: {module}"
        for name, tree in trees().items()
        for module in imported(tree)
        if module.split(".")[0] in bare
    ]
    assert wrong == []


def test_the_package_imports_no_test() -> None:
    of_tests = [
        path for path, tree in trees().items() if any(f"{name}.".startswith("tests.") for name in imported(tree))
    ]
    assert of_tests == []
    assert list(imported(ast.parse("from tests.worlds import motion"))) == ["tests.worlds.motion"]


def test_diagram_systems_live_in_systems_only() -> None:
    holders = [name for name, tree in trees().items() if names(tree) & {"LeafSystem", "VectorSystem"}]
    assert holders, "the cell has systems"
    assert [name for name in holders if not name.startswith("systems/")] == []


def test_no_algorithm_speaks_of_the_simulations_truth() -> None:
    speakers = {name: said for name, tree in trees().items() if (said := of_the_truth(tree))}
    assert {name: said for name, said in speakers.items() if not name.startswith(TRUTH_IS_KNOWN)} == {}
    for place in TRUTH_IS_KNOWN:
        assert any(name.startswith(place) for name in speakers), f"{place} need not be excepted"


def test_nothing_prints_and_nothing_changes_globals() -> None:
    assert [name for name, tree in trees().items() if "print" in called(tree)] == []
    assert [name for name, tree in trees().items() if any(isinstance(node, ast.Global) for node in nodes(tree))] == []


def test_each_file_says_its_one_idea_first() -> None:
    silent = [name for name, tree in trees().items() if len((ast.get_docstring(tree) or "").split("\n")[0]) < 16]
    assert silent == []


def test_no_file_is_long() -> None:
    lengths = {name: len(path.read_text().splitlines()) for name, path in FILES.items()}
    assert {name: length for name, length in lengths.items() if length > LONGEST_FILE} == {}


def test_the_rules_would_catch_an_offender() -> None:
    offender = ast.parse("from weldcal.calibration import rigid\nimport models\nprint(1)\nclass A(LeafSystem): pass")
    assert set(imported(offender)) == {"weldcal.calibration.rigid", "models"}
    assert "print" in called(offender)
    assert "LeafSystem" in names(offender)
    for text in ("x = station.truth.X_BC", "from a import TabletTruth", 'port = "cheat.X_BC"'):
        assert of_the_truth(ast.parse(text)), text
    assert not of_the_truth(ast.parse('"""No cheating here, in truth."""\nx = 1'))


def test_every_folder_is_looked_at() -> None:
    assert {name.split("/")[0] for name in FILES} == set(FOLDERS)


def test_the_process_that_supervises_a_robot_loads_no_drake() -> None:
    """It starts in half the time, and takes half of the memory."""
    script = (
        "import sys\nimport weldcal.systems.drivers.ur.worker\n"
        "loaded = {name.split('.')[0] for name in sys.modules} & {'pydrake', 'scipy', 'numba', 'cv2', 'open3d'}\n"
        "assert not loaded, loaded\n"
    )
    finished = subprocess.run([sys.executable, "-P", "-c", script], capture_output=True, text=True, check=False)
    assert finished.returncode == 0, finished.stderr
