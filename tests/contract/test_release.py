"""A release is complete: one version, a changelog, the files that a user looks for, and a licence for every package."""

from __future__ import annotations

import importlib.metadata
import re
import tomllib
from datetime import date
from email.message import Message
from typing import Any

import pytest
import yaml
from packaging.utils import canonicalize_name

from tests.contract.test_lock import PROJECT, USERS
from tests.places import ROOT

LONGEST_SECTION = 60
SECTION = re.compile(
    r"^## \[(?P<version>[^\]]+)\](?: - (?P<date>\S+))?\n(?P<text>.*?)(?=^## |\Z)", re.MULTILINE | re.DOTALL
)
KINDS = ("Added", "Changed", "Deprecated", "Removed", "Fixed", "Security")
FORMS = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
LICENCES = {
    "MIT License": "MIT",
    "Apache Software License": "Apache-2.0",
    "BSD License": "BSD-",
    "ISC License (ISCL)": "ISC",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "Python Software Foundation License": "PSF-2.0",
}
"""What a licence that a package states by a classifier is called in NOTICE."""


def read(path: str) -> str:
    return (ROOT / path).read_text(encoding="utf-8")


def tree(path: str) -> Any:
    return yaml.safe_load(read(path))


def test_the_version_is_the_same_everywhere() -> None:
    newest = next(found for found in SECTION.finditer(read("CHANGELOG.md")) if found["version"] != "Unreleased")
    assert newest["version"] == tree("CITATION.cff")["version"] == PROJECT["version"]
    assert newest["date"] == tree("CITATION.cff")["date-released"]
    assert date.fromisoformat(newest["date"])


def test_the_changelog_is_short_and_by_kinds() -> None:
    sections = list(SECTION.finditer(read("CHANGELOG.md")))
    assert len(sections) > 1
    for section in sections:
        assert len(section[0].rstrip().splitlines()) <= LONGEST_SECTION, section["version"]
        kinds = re.findall(r"^### (\w+)", section["text"], re.MULTILINE)
        assert set(kinds) <= set(KINDS), section["version"]


def test_the_citation_is_a_valid_one() -> None:
    citation = tree("CITATION.cff")
    assert citation["cff-version"] == "1.2.0"
    assert citation["license"] == PROJECT["license"]
    assert citation["authors"] == PROJECT["authors"]
    assert citation["message"]
    for paper in citation["references"]:
        assert {"type", "title", "authors"} <= set(paper)
        assert all(set(author) == {"given-names", "family-names"} for author in paper["authors"])
        assert re.fullmatch(r"10\.\d{4,9}/\S+", paper["doi"]) if "doi" in paper else "arXiv" in paper["notes"]


@pytest.mark.parametrize("form", FORMS, ids=lambda form: form.stem)
def test_an_issue_form_can_be_filled_in(form: Any) -> None:
    content = yaml.safe_load(form.read_text(encoding="utf-8"))
    if form.stem == "config":
        assert content == {"blank_issues_enabled": False}
        return
    assert {"name", "description", "body"} <= set(content) <= {"name", "description", "title", "labels", "body"}
    ids = [part["id"] for part in content["body"]]
    assert len(ids) == len(set(ids)) > 1
    for part in content["body"]:
        assert part["type"] in ("input", "textarea", "dropdown", "checkboxes")
        assert part["attributes"]["label"]
        assert set(part) <= {"type", "id", "attributes", "validations"}
        assert set(part.get("validations", {})) <= {"required"}


def test_there_is_a_form_for_each_kind_of_report() -> None:
    assert {form.stem for form in FORMS} == {"config", "wrong_result", "refused_input", "robot_or_driver", "question"}


def test_the_workflow_runs_what_a_merge_needs_on_every_python() -> None:
    workflow = tree(".github/workflows/ci.yml")
    job = workflow["jobs"]["ci"]
    assert any(step.get("run", "").split()[-1:] == [".ci/run"] for step in job["steps"])
    assert (ROOT / ".ci" / "run").is_file()
    rows = job["strategy"]["matrix"]["include"]
    classified = [text.rpartition(" ")[2] for text in PROJECT["classifiers"] if "Python :: 3." in text]
    assert {row["python"] for row in rows} == set(classified)
    images = {row["image"] for row in rows}
    assert {"debian:12", "debian:13"} <= images
    assert all(re.search(r"^debian:1[23]$|-(bookworm|trixie)$", image) for image in images)


def test_what_contributing_names_is_there() -> None:
    text = read("CONTRIBUTING.md")
    links = re.findall(r"\]\(([^)#:]+)", text)
    named = re.findall(r"`((?:tests|docs|\.ci)/[\w./]+)`", text)
    assert len(links) > 2
    assert [path for path in (*links, *named) if not (ROOT / path).exists()] == []
    tests = re.findall(r"`(test_\w+\.py)`", text)
    assert all((ROOT / "tests" / "contract" / name).is_file() for name in tests)
    style = text.split("## Style")[1].split("## ")[0]
    assert [line.split(".")[0] for line in style.strip().splitlines()] == [str(k) for k in range(1, 11)]


def licences() -> dict[str, str]:
    """The licence of each package as NOTICE states it."""
    listed = read("NOTICE").split("requirements.lock")[1]
    return dict(re.findall(r"^  (\S+)  +(\S.*)$", listed, re.MULTILINE))


def test_notice_lists_the_packages_of_the_lock() -> None:
    locked = re.findall(r"^([a-z0-9][a-z0-9-]*)(?:\[[a-z,-]+\])?==", read(USERS), re.MULTILINE)
    assert sorted(licences()) == sorted(set(locked))


def stated(about: Message) -> str:
    """The licence that a package states itself; empty where it does so in free words only."""
    if about.get("License-Expression"):
        return str(about.get("License-Expression"))
    classifiers = [
        text.rpartition(" :: ")[2] for text in about.get_all("Classifier") or [] if text.startswith("License")
    ]
    return LICENCES.get(classifiers[0], "") if classifiers else ""


@pytest.mark.parametrize("name", licences())
def test_a_licence_in_notice_is_what_the_package_states(name: str) -> None:
    try:
        about = importlib.metadata.metadata(name)
    except importlib.metadata.PackageNotFoundError:
        pytest.skip(f"{name} is for another platform or Python")
    assert canonicalize_name(about["Name"]) == name
    assert stated(about) in licences()[name]  # type: ignore[arg-type]


def test_notice_says_what_mosek_needs() -> None:
    about = " ".join(read("NOTICE").split("\nmosek:")[1].split("\n\n")[0].split())
    for words in ("Drake", "proprietary", "licence file", "weldcal never calls it"):
        assert words in about
    assert "Mosek" in str(importlib.metadata.requires("drake"))
    calls = [
        path
        for folder in ("models", "calibration", "welding", "systems", "tools")
        for path in (ROOT / folder).rglob("*.py")
        if re.search(r"Mosek|mathematicalprogram|pydrake\.solvers", path.read_text(encoding="utf-8"))
    ]
    assert calls == []


def test_the_licence_files_are_part_of_the_wheel() -> None:
    project = tomllib.loads(read("pyproject.toml"))["project"]
    assert project["license-files"] == ["LICENSE", "NOTICE"]
    assert all((ROOT / name).is_file() for name in project["license-files"])
