"""What the documents say can be typed and found: every command, every option, every linked file."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path
from typing import Any

import pytest
import typer.main

from tests.places import ROOT
from weldcal.tools.cli.app import app

DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]

# Places of one machine or one mirror; in two parts so that this file does not name them itself.
PRIVATE = re.compile("|".join([r"(?<![\w.~])/" + "(work|root|home|Users)/", "pypi" + r"\.org", "python" + "hosted"]))


def typed_lines(document: Path) -> list[str]:
    """The lines of the document's code blocks that run weldcal."""
    blocks = re.findall(r"^```[a-z]*\n(.*?)^```", document.read_text(), re.MULTILINE | re.DOTALL)
    lines = (line.strip().removeprefix("$ ") for block in blocks for line in block.splitlines())
    return [line for line in lines if line.startswith(("./tools/run", "weldcal "))]


COMMANDS = [(document.relative_to(ROOT).as_posix(), line) for document in DOCUMENTS for line in typed_lines(document)]


def check(line: str) -> None:
    """Parses a command line as weldcal would, without running it.

    Raises:
        AssertionError: if the command does not exist.
        Exception: click's usage error, if an option or argument does not fit.
    """
    words = shlex.split(line, comments=True)[1:]
    if words[:1] == ["test"]:
        return
    command: Any = typer.main.get_command(app)
    while words and hasattr(command, "commands"):
        assert words[0] in command.commands, f"there is no command {words[0]!r} in {line!r}"
        command = command.commands[words.pop(0)]
    if not hasattr(command, "commands"):
        command.make_context("weldcal", words)


@pytest.mark.parametrize(("document", "line"), COMMANDS)
def test_every_command_of_the_documents_exists(document: str, line: str) -> None:
    check(line)


@pytest.mark.parametrize(
    "line", ["weldcal dance", "weldcal demo --colour red", "weldcal demo --seed first", "weldcal view"]
)
def test_a_command_that_does_not_exist_would_be_caught(line: str) -> None:
    with pytest.raises(Exception, match=r"no command|No such option|integer|Missing"):
        check(line)


def test_the_readme_shows_the_two_first_commands_and_the_real_data() -> None:
    lines = typed_lines(ROOT / "README.md")
    assert lines[:2] == ["./tools/run demo", "./tools/run test"]
    assert any("calibrate" in line for line in lines)


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 150


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(document: Path) -> None:
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", document.read_text()):
        assert (document.parent / target).exists(), f"{document.name} links to {target}, which is not there"


def test_no_file_names_a_machine_or_a_mirror() -> None:
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        check=False,
    )
    if listed.returncode != 0:
        pytest.skip("this is not a git checkout, so what belongs to it is not known")
    offenders = []
    for name in filter(None, listed.stdout.decode().split("\0")):
        path = ROOT / name
        if path.is_file() and not path.is_symlink():
            found = PRIVATE.search(path.read_text(errors="ignore"))
            if found:
                offenders.append(f"{name}: {found[0]}")
    assert not offenders
