"""The lock pins every direct dependency within its bounds, by hash, and says nothing of where packages are fetched."""

from __future__ import annotations

import re
import tomllib

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.places import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
DIRECT = [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["dev"]]
LOCK = (ROOT / "requirements.lock").read_text()

ENTRY = re.compile(
    r"^(?P<name>[a-z0-9][a-z0-9-]*)(\[[a-z,-]+\])?==(?P<version>[0-9][0-9a-z.+!]*)( ; [^\\]+)? \\\n"
    r"(?P<hashes>(    --hash=sha256:[0-9a-f]{64}( \\)?\n)+)",
    re.MULTILINE,
)


@pytest.fixture(scope="module")
def pinned() -> dict[str, str]:
    """Each package of the lock with its version."""
    return {entry["name"]: entry["version"] for entry in ENTRY.finditer(LOCK)}


@pytest.mark.parametrize("text", DIRECT)
def test_each_direct_dependency_is_pinned_within_its_bounds(pinned: dict[str, str], text: str) -> None:
    requirement = Requirement(text)
    assert pinned[canonicalize_name(requirement.name)] in requirement.specifier


def test_the_build_system_is_in_the_lock(pinned: dict[str, str]) -> None:
    for text in tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]:
        requirement = Requirement(text)
        assert pinned[canonicalize_name(requirement.name)] in requirement.specifier


def test_the_lock_is_nothing_but_versions_and_hashes() -> None:
    rest = [line for line in ENTRY.sub("", LOCK).splitlines() if line.strip()]
    assert [line for line in rest if not line.startswith("#") or "/" in line] == [], "neither a package nor a hash"


@pytest.mark.parametrize("text", DIRECT)
def test_each_direct_dependency_has_an_upper_bound(text: str) -> None:
    operators = {part.operator for part in Requirement(text).specifier}
    assert operators & {"<", "<=", "==", "~="}, f"{text} may jump to a version that was never tried"
