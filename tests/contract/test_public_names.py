"""The public names and signatures are those of public_names.txt; `python -m tests.contract.test_public_names` writes it.

Of a class whose objects a public function returns, and of the scenario, the members are held; of a system its
constructor; of other classes (states, settings, messages) the name.

A name that a user may have must not go without notice: it is marked `@deprecated("since 1.1: use ...")` for one minor
version (typing_extensions), which type checkers show and Python warns of.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import subprocess
import sys
import textwrap
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

from tests.places import ROOT

PACKAGES = ("weldcal", "weldcal.calibration", "weldcal.welding", "weldcal.systems")
STORED = Path(__file__).with_name("public_names.txt")
FOLDERS = ("models", "calibration", "welding", "systems", "tools")


def parameters(function: ast.FunctionDef) -> str:
    """The signature as it is written, without a method's first parameter."""
    args = function.args
    if args.args and args.args[0].arg in ("self", "cls"):
        del args.args[0]
    returned = "" if function.returns is None else f" -> {ast.unparse(function.returns)}"
    return f"({ast.unparse(args)}){returned}"


def members(kind: ast.ClassDef) -> Iterator[str]:
    """What a class declares itself: its fields, constructor, public methods and properties."""
    for node in kind.body:
        if isinstance(node, ast.AnnAssign) and not ast.unparse(node.target).startswith("_"):
            yield f".{ast.unparse(node.target)}: {ast.unparse(node.annotation)}"
        elif isinstance(node, ast.FunctionDef) and node.name == "__init__":
            yield parameters(node)
        elif isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            is_property = any(ast.unparse(mark) == "property" for mark in node.decorator_list)
            shown = parameters(node)
            yield f".{node.name}" + (shown.replace("() -> ", ": ") if is_property else shown)


def returned(values: Iterable[object]) -> set[str]:
    """The classes that public functions return, by name, and the scenario."""
    found = {"Scenario"}
    for value in filter(inspect.isfunction, values):
        found |= set(re.findall(r"\w+", str(inspect.signature(value).return_annotation)))
    return found - {"WeldingState"}  # one tick hands it to the next: a caller reads nothing of it


def lines_of(name: str, value: object, results: set[str]) -> Iterator[str]:
    """The lines of a public name; `results`: the classes whose members are held."""
    if not inspect.isclass(value) and not inspect.isfunction(value):
        yield name
        return
    node = ast.parse(textwrap.dedent(inspect.getsource(value))).body[0]
    if isinstance(node, ast.ClassDef):
        bases = ", ".join(ast.unparse(base) for base in node.bases)
        yield f"class {name}({bases})"
        whole = node.name in results
        yield from (f"{name}{one}" for one in members(node) if whole or one.startswith("("))
    elif isinstance(node, ast.FunctionDef):
        yield f"{name}{parameters(node)}"


def public_names() -> str:
    """Every public name, a line each, and each member of what a public function returns."""
    modules = {package: importlib.import_module(package) for package in PACKAGES}
    results = returned(getattr(module, name) for module in modules.values() for name in module.__all__)
    return "".join(
        f"{line}\n"
        for package, module in modules.items()
        for name in sorted(module.__all__)
        for line in lines_of(f"{package}.{name}", getattr(module, name), results)
    )


def deprecations(source: str) -> list[str]:
    """What the source says of each name that it marks as deprecated."""
    calls = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)]
    return [ast.literal_eval(c.args[0]) for c in calls if ast.unparse(c.func).split(".")[-1] == "deprecated"]


def overdue(source: str, version: str) -> list[str]:
    """The deprecations that do not say `since X.Y: use ...`, or whose minor version is over."""
    major_minor = ".".join(version.split(".")[:2])
    return [text for text in deprecations(source) if not text.startswith(f"since {major_minor}: use ")]


def test_public_names_and_signatures_are_the_stored_ones() -> None:
    assert public_names() == STORED.read_text(), (
        "A user's program may need what changed. Keep an old name for one minor version, marked as deprecated; then"
        " write the list with: python -m tests.contract.test_public_names"
    )


@pytest.mark.parametrize("package", PACKAGES)
def test_no_public_name_hides_a_module(package: str) -> None:
    """`import weldcal.calibration.flange` would replace an exported function of that name."""
    module = importlib.import_module(package)
    folder = Path(module.__path__[0])
    modules = {path.stem for path in folder.glob("*.py")} | {path.parent.name for path in folder.glob("*/__init__.py")}
    assert set(module.__all__) & modules == set()
    assert set(module.__all__) <= set(dir(module))
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'nothing'"):
        module.nothing  # noqa: B018


@pytest.mark.parametrize("package", PACKAGES)
def test_importing_a_package_loads_nothing_heavy(package: str) -> None:
    script = f"import sys, {package}; print(*{{'numpy', 'pydrake'}} & set(sys.modules))"
    found = subprocess.run([sys.executable, "-P", "-c", script], capture_output=True, text=True, check=True)
    assert found.stdout.split() == []


def test_a_deprecated_name_is_kept_for_one_minor_version() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    files = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")]
    marked = [path for path in files if "deprecated" in (text := path.read_text()) and overdue(text, version)]
    assert marked == []
    old = '@deprecated("since 1.1: use weldcal.verify")\ndef judge() -> None: ...\n'
    assert overdue(old, "1.1.3") == []
    assert overdue(old, "1.2.0") == ["since 1.1: use weldcal.verify"]
    assert overdue(old.replace("since 1.1: ", ""), "1.1.3") == ["use weldcal.verify"]


if __name__ == "__main__":
    STORED.write_text(public_names())
