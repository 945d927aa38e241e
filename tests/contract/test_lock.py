"""Each lock pins its direct dependencies within their bounds, by hash, for every Python; the users' lock has no
developers' tools."""

from __future__ import annotations

import re
import tomllib

import pytest
from packaging.markers import Marker
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

from tests.places import ROOT

PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT = PYPROJECT["project"]
RUNS = [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["editable"], *PYPROJECT["build-system"]["requires"]]
TOOLS = PROJECT["optional-dependencies"]["dev"]
USERS, DEVELOPERS = "requirements.lock", "requirements-dev.lock"
PYTHONS = ("3.11", "3.12", "3.13")

ENTRY = re.compile(
    r"^(?P<name>[a-z0-9][a-z0-9-]*)(\[[a-z,-]+\])?==(?P<version>[0-9][0-9a-z.+!]*)( ; (?P<marker>[^\\]+))? \\\n"
    r"(?P<hashes>(    --hash=sha256:[0-9a-f]{64}( \\)?\n)+)",
    re.MULTILINE,
)


def holds(marker: Marker | None, python: str) -> bool:
    """Whether a marker is true on this machine with that Python."""
    return marker is None or marker.evaluate({"python_version": python, "python_full_version": f"{python}.1"})


def pinned(lock: str, python: str) -> dict[str, str]:
    """Each package that the lock installs with that Python, with its version."""
    found: dict[str, str] = {}
    for entry in ENTRY.finditer((ROOT / lock).read_text()):
        if holds(Marker(entry["marker"]) if entry["marker"] else None, python):
            assert entry["name"] not in found, f"{lock} pins {entry['name']} twice for Python {python}"
            found[entry["name"]] = entry["version"]
    return found


def wanted(texts: list[str], python: str) -> list[Requirement]:
    """The direct dependencies of that Python."""
    return [requirement for requirement in map(Requirement, texts) if holds(requirement.marker, python)]


def test_the_pythons_are_those_of_the_project() -> None:
    allowed = SpecifierSet(PROJECT["requires-python"])
    assert tuple(f"3.{minor}" for minor in range(30) if f"3.{minor}.1" in allowed) == PYTHONS
    classified = [text.rpartition(" ")[2] for text in PROJECT["classifiers"] if "Python :: 3." in text]
    assert tuple(classified) == PYTHONS
    (line,) = re.findall(r"^pythons='(.*)'$", (ROOT / "tools" / "run").read_text(), re.MULTILINE)
    assert sorted(line.split()) == sorted(PYTHONS)


@pytest.mark.parametrize("python", PYTHONS)
@pytest.mark.parametrize(("lock", "texts"), [(USERS, RUNS), (DEVELOPERS, [*RUNS, *TOOLS])])
def test_each_direct_dependency_is_pinned_within_its_bounds(lock: str, texts: list[str], python: str) -> None:
    pins = pinned(lock, python)
    for requirement in wanted(texts, python):
        assert pins[canonicalize_name(requirement.name)] in requirement.specifier, f"{lock}: {requirement}"


@pytest.mark.parametrize("python", PYTHONS)
def test_the_developers_lock_adds_to_the_users_and_changes_nothing(python: str) -> None:
    users, developers = pinned(USERS, python), pinned(DEVELOPERS, python)
    assert users.items() <= developers.items()


@pytest.mark.parametrize("python", PYTHONS)
def test_users_get_no_developers_tools(python: str) -> None:
    tools = {canonicalize_name(Requirement(text).name) for text in TOOLS}
    assert {"pytest", "mypy", "selenium", "hypothesis"} <= tools
    assert not tools & pinned(USERS, python).keys()


@pytest.mark.parametrize("lock", [USERS, DEVELOPERS])
def test_ur_rtde_is_left_out_where_it_has_no_wheel(lock: str) -> None:
    assert "ur-rtde" in pinned(lock, "3.12")
    assert "ur-rtde" not in pinned(lock, "3.13")


@pytest.mark.parametrize("lock", [USERS, DEVELOPERS])
def test_a_lock_is_nothing_but_versions_and_hashes_under_the_command_that_made_it(lock: str) -> None:
    text = (ROOT / lock).read_text()
    rest = [line for line in ENTRY.sub("", text).splitlines() if line.strip()]
    assert [line for line in rest if not line.startswith("#") or "/" in line] == [], "neither a package nor a hash"
    # Without these it would hold for the interpreter that made it only.
    assert re.search(r"^#.* --universal --python-version 3\.11 --generate-hashes ", text, re.MULTILINE)


@pytest.mark.parametrize("text", [*RUNS, *TOOLS])
def test_each_direct_dependency_has_an_upper_bound(text: str) -> None:
    operators = {part.operator for part in Requirement(text).specifier}
    assert operators & {"<", "<=", "==", "~="}, f"{text} may jump to a version that was never tried"
