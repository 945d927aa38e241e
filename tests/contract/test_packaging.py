"""What `pip install` of a wheel or an sdist brings: the whole package under weldcal/, its data, its command."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.places import ROOT

FOLDERS = ("models", "calibration", "welding", "systems", "tools")
PROJECT_FILES = ("pyproject.toml", "README.md", "LICENSE", "NOTICE")
ROOT_FILES = ("__init__.py", "py.typed")
LINK = ".typing/weldcal"  # to the root: what is built, or installed, has it as the package's folder


@dataclass(frozen=True)
class Built:
    """The files that a build left, and the copy of the repository that was built."""

    wheel: Path
    sdist: Path
    copy: Path


def source_files() -> set[str]:
    """Every file of the package that must arrive: Python, YAML, CSV, scans, URScript, templates, styles, scripts of pages,
    type markers."""
    return set(ROOT_FILES) | {
        path.relative_to(ROOT).as_posix()
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("*")
        if path.suffix in {".py", ".yaml", ".csv", ".script", ".j2", ".css", ".js", ".html", ".npz"}
        or path.name == "py.typed"
    }


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Built:
    """A wheel and an sdist, built from a copy so that nothing is left in the repository."""
    copy = tmp_path_factory.mktemp("source") / "weldcal"
    ignored = shutil.ignore_patterns("__pycache__", "*.egg-info")
    for folder in FOLDERS:
        shutil.copytree(ROOT / folder, copy / folder, ignore=ignored)
    for name in PROJECT_FILES + ROOT_FILES:
        shutil.copy(ROOT / name, copy / name)
    (copy / LINK).parent.mkdir()
    (copy / LINK).symlink_to("..")
    out = tmp_path_factory.mktemp("dist")
    command = [
        sys.executable,
        "-P",
        "-m",
        "build",
        "--no-isolation",
        "--wheel",
        "--sdist",
        "--outdir",
        str(out),
        str(copy),
    ]
    finished = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert finished.returncode == 0, finished.stdout + finished.stderr
    (wheel,) = out.glob("*.whl")
    (sdist,) = out.glob("*.tar.gz")
    return Built(wheel, sdist, copy)


def test_the_list_of_packages_is_complete() -> None:
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    there = {
        "weldcal." + path.parent.relative_to(ROOT).as_posix().replace("/", ".")
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("__init__.py")
    }
    assert sorted(listed) == sorted({"weldcal"} | there)
    assert [path.name for path in ROOT.glob("*.py")] == ["__init__.py"], (
        "the root is the package weldcal, and nothing else"
    )


def test_each_folder_with_python_files_is_a_package() -> None:
    for folder in FOLDERS:
        for path in (ROOT / folder).rglob("*.py"):
            assert (path.parent / "__init__.py").exists(), f"{path.parent.relative_to(ROOT)} lacks __init__.py"


def test_the_wheel_holds_every_file_and_nothing_at_the_top(built: Built) -> None:
    with zipfile.ZipFile(built.wheel) as wheel:
        names = {name for name in wheel.namelist() if not name.endswith("/")}
    assert {name.split("/")[0] for name in names} == {"weldcal", "weldcal-1.0.0.dist-info"}
    packaged = {name.removeprefix("weldcal/") for name in names if name.startswith("weldcal/")}
    assert packaged == source_files()


def test_the_wheel_has_its_command_and_its_licences(built: Built) -> None:
    with zipfile.ZipFile(built.wheel) as wheel:
        commands = wheel.read("weldcal-1.0.0.dist-info/entry_points.txt").decode()
        metadata = wheel.read("weldcal-1.0.0.dist-info/METADATA").decode()
        licences = {name.rsplit("/", 1)[-1] for name in wheel.namelist() if "/licenses/" in name}
    assert "weldcal = weldcal.tools.__main__:main" in commands
    assert "License-Expression: BSD-3-Clause" in metadata
    assert licences == {"LICENSE", "NOTICE"}


def test_an_index_would_accept_wheel_and_sdist(built: Built) -> None:
    command = [sys.executable, "-P", "-m", "twine", "check", "--strict", str(built.wheel), str(built.sdist)]
    checked = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert checked.returncode == 0, checked.stdout + checked.stderr
    assert checked.stdout.count("PASSED") == 2


def test_the_size_of_the_wheel_is_the_one_that_is_stated(built: Built) -> None:
    page = (ROOT / "CONTRIBUTING.md").read_text()
    (stated,) = re.findall(r"wheel of weldcal has ([\d.]+) MB", page)
    assert abs(built.wheel.stat().st_size / 1e6 - float(stated)) < 0.15


def test_the_sdist_holds_what_a_build_needs(built: Built) -> None:
    with tarfile.open(built.sdist) as sdist:
        names = {name.split("/", 1)[1] for name in sdist.getnames() if "/" in name}
    assert {f"{LINK}/{name}" for name in source_files()} <= names
    assert set(PROJECT_FILES) <= names


def test_an_installed_wheel_works_far_from_the_repository(built: Built, tmp_path: Path) -> None:
    target = tmp_path / "site"
    # the import below compiles what it needs; pip would compile every file
    options = ["--quiet", "--no-compile", "--no-deps", "--no-index", "--target", str(target)]
    install = ["-m", "pip", "install", *options, str(built.wheel)]
    subprocess.run([sys.executable, *install], check=True, capture_output=True, timeout=120)
    # -S keeps this repository's editable install out of sight; the libraries are added by hand.
    libraries = [path for path in sys.path if path.endswith("site-packages")]
    script = (
        "import sys; import weldcal.tools.cli.app as cli; from weldcal.tools.report.render import environment;"
        "from weldcal.systems.scenario.loading import SCENARIO_FOLDER;"
        f"assert cli.__file__.startswith({str(target)!r}), cli.__file__;"
        "assert environment().get_template('base.html.j2');"
        "print(*sorted(path.name for path in SCENARIO_FOLDER.glob('*.yaml')))"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(target), *libraries])}
    command = [sys.executable, "-S", "-c", script]
    finished = subprocess.run(
        command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60
    )
    assert finished.returncode == 0, finished.stderr
    assert set(finished.stdout.split()) == {path.name for path in (ROOT / "models" / "scenarios").glob("*.yaml")}


USER_PROGRAM = """
import weldcal, weldcal.calibration, weldcal.welding, weldcal.systems
weldcal.nothing
weldcal.calibration.nothing
weldcal.welding.nothing
weldcal.systems.nothing
reveal_type(weldcal.__version__)
reveal_type(weldcal.read_calibration("my_result").correct)
"""
ADDED = "import weldcal.added\nreveal_type(weldcal.added.found)\n"
# mypy follows the packages only, not the modules of their names, which saves a minute.
FAST = """
[mypy-weldcal.models.*,weldcal.calibration.*,weldcal.welding.*,weldcal.systems.*,weldcal.tools.*]
follow_imports = skip
[mypy-weldcal.calibration,weldcal.welding,weldcal.systems]
follow_imports = normal
"""


def installed(built: Built, folder: Path, kind: str) -> Path:
    """The Python of a new environment with weldcal, installed from the wheel or from its editable folder."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True, timeout=60)
    python = folder / "bin" / "python"
    (site,) = (folder / "lib").glob("python*/site-packages")
    libraries = [path for path in sys.path if path.endswith("site-packages")]
    (site / "libraries.pth").write_text("\n".join(libraries))
    source = [str(built.wheel)] if kind == "wheel" else ["--no-build-isolation", "--editable", str(built.copy)]
    options = ["--quiet", "--no-compile", "--no-deps", "--no-index", "--ignore-installed", *source]
    install = [sys.executable, "-m", "pip", "--python", str(python), "install", *options]
    subprocess.run(install, check=True, capture_output=True, timeout=120)
    return python


def checked(arguments: list[str], folder: Path) -> str:
    """What a type checker finds in a folder far from the repository."""
    hidden = ("PYTHONPATH", "MYPYPATH")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    command = [sys.executable, "-P", "-m", *arguments]
    return subprocess.run(
        command, env=environment, cwd=folder, capture_output=True, text=True, check=False, timeout=300
    ).stdout


@pytest.mark.parametrize("kind", ["wheel", "editable"])
def test_type_checkers_of_a_users_project_find_weldcal(built: Built, tmp_path: Path, kind: str) -> None:
    python = installed(built, tmp_path / "env", kind)
    program = USER_PROGRAM
    if kind == "editable":  # a module that was added after the install
        (built.copy / "added.py").write_text("found: int = 1\n")
        program += ADDED
    (tmp_path / "user.py").write_text(program)
    (tmp_path / "mypy.ini").write_text(FAST)
    by_mypy = checked(["mypy", "--python-executable", str(python), "user.py"], tmp_path)
    lines = [line.split(":", 1)[1] for line in by_mypy.splitlines() if line.startswith("user.py")]
    assert lines == [
        *(f'{line}: error: Module has no attribute "nothing"  [attr-defined]' for line in (3, 4, 5, 6)),
        '7: note: Revealed type is "str"',
        '8: note: Revealed type is "Any"',  # its module is not followed
        *(['10: note: Revealed type is "int"'] if kind == "editable" else []),
    ], by_mypy
    by_pyright = json.loads(checked(["basedpyright", "--outputjson", "--pythonpath", str(python), "user.py"], tmp_path))
    notes = by_pyright["generalDiagnostics"]
    unknown = [note["range"]["start"]["line"] for note in notes if note.get("rule") == "reportAttributeAccessIssue"]
    assert [line + 1 for line in unknown] == [3, 4, 5, 6], notes
    revealed = [note["message"].split(" is ", 1)[1] for note in notes if note["severity"] == "information"]
    assert revealed[0] == '"str"'
    assert revealed[1].startswith('"(points_C: ')
    assert ") -> ndarray[" in revealed[1]
    assert "Unknown" not in revealed[1]
