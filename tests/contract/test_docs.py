"""What the documents say can be typed and found: every command, every option, every linked file, every example file."""

from __future__ import annotations

import re
import shlex
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from markdown_it import MarkdownIt

from tests.documents.blocks import all_blocks
from tests.documents.command_lines import program
from weldcal.calibration.data.dataset import load_dataset
from weldcal.systems.scenario.loading import load_scenario, scenario_names

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
LONGEST_README = 90
WIDEST_CODE = (
    88  # characters of a column of the site in a window of 1280 pixels; tests/documents/test_site.py measures it
)
FOLDERS = ("models", "calibration", "welding", "systems", "tools", "tests")

FENCED = re.compile(r"^```([a-z]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)

# Places of one machine or one mirror; in two parts so that this file does not name them itself.
PRIVATE = re.compile("|".join([r"(?<![\w.~])/" + "(work|root|home|Users)/", "pypi" + r"\.org", "python" + "hosted"]))


def blocks(document: Path, language: str | None = None) -> list[str]:
    """The document's fenced code blocks, all of them or those of one language ("": of none)."""
    found = FENCED.findall(document.read_text())
    return [text for its_language, text in found if language in (None, its_language)]


def typed_lines(document: Path) -> list[str]:
    """The lines of the document's code blocks that run weldcal."""
    joined = (re.sub(r" *\\\n\s*", " ", block) for block in blocks(document))
    lines = (line.strip().removeprefix("$ ") for block in joined for line in block.splitlines())
    return [line for line in lines if line.startswith(("./tools/run", "weldcal "))]


def quoted_commands(document: Path) -> list[str]:
    """The commands in the running text and in tables, between backticks; FILE, NAME and ... may stand for arguments."""
    text = FENCED.sub("", document.read_text())
    return [
        command.strip()
        for quoted in re.findall(r"`((?:\./tools/run|weldcal) [^`]+)`", text)
        for command in re.split(r";|\n", quoted)
    ]


TYPED = [(document.relative_to(ROOT).as_posix(), line) for document in DOCUMENTS for line in typed_lines(document)]
QUOTED = [(document.relative_to(ROOT).as_posix(), line) for document in DOCUMENTS for line in quoted_commands(document)]


def leaves(command: Any, name: str = "") -> Iterator[str]:
    """Every command that the help lists and that does something, with its full name after `weldcal`; old names are
    hidden."""
    if hasattr(command, "commands"):
        for word, child in command.commands.items():
            if not getattr(child, "hidden", False):
                yield from leaves(child, f"{name} {word}".strip())
    elif not command.hidden:
        yield name


def resolve(line: str) -> tuple[Any, list[str]]:
    """The command that a line runs, and the words after its name.

    Raises:
        AssertionError: if the command does not exist.
    """
    words = shlex.split(line, comments=True)[1:]
    command = program()
    while words and hasattr(command, "commands"):
        assert words[0] in command.commands, f"there is no command {words[0]!r} in {line!r}"
        command = command.commands[words.pop(0)]
    return command, words


def is_the_test_run(line: str) -> bool:
    """Whether the line runs the tests or builds these pages, which is not a weldcal command."""
    return line.split()[:2] in (["./tools/run", "test"], ["./tools/run", "docs"])


def check(line: str) -> None:
    """Parses a command line as weldcal would, without running it.

    Raises:
        AssertionError: if the command does not exist.
        Exception: click's usage error, if an option or argument does not fit.
    """
    if is_the_test_run(line):
        return
    command, words = resolve(line)
    if not hasattr(command, "commands"):
        command.make_context("weldcal", words)


def check_names(line: str) -> None:
    """Checks that the command and the options of a line exist; its arguments may be placeholders.

    Raises:
        AssertionError: if the command or an option does not exist.
    """
    if is_the_test_run(line) or line in ("./tools/run COMMAND", "weldcal COMMAND", "./tools/run figures NAME"):
        return
    command, words = resolve(line)
    known = {option for p in command.params for option in (*p.opts, *p.secondary_opts)} | {"--help"}
    unknown = {word.partition("=")[0] for word in words if word.startswith("--")} - known
    assert not unknown, f"{line!r} has no option {', '.join(sorted(unknown))}"


@pytest.mark.parametrize(("document", "line"), TYPED)
def test_every_command_of_the_documents_exists(document: str, line: str) -> None:
    check(line)


@pytest.mark.parametrize(("document", "line"), QUOTED)
def test_every_command_in_the_text_exists_with_its_options(document: str, line: str) -> None:
    check_names(line)


@pytest.mark.parametrize(
    "line", ["weldcal dance", "weldcal demo --colour red", "weldcal demo --seed first", "weldcal view"]
)
def test_a_command_that_does_not_exist_would_be_caught(line: str) -> None:
    with pytest.raises(Exception, match=r"no command|No such option|integer|Missing"):
        check(line)


@pytest.mark.parametrize("line", ["weldcal dance FILE", "weldcal demo SCENARIO --colour red"])
def test_a_command_of_the_text_that_does_not_exist_would_be_caught(line: str) -> None:
    with pytest.raises(AssertionError, match=r"no command|no option"):
        check_names(line)


def test_the_readme_shows_the_two_first_commands_and_the_users_own_data() -> None:
    lines = typed_lines(ROOT / "README.md")
    assert lines[:2] == ["./tools/run demo", "./tools/run test"]
    assert any("calibrate" in line for line in lines)
    assert any("verify" in line for line in lines)


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= LONGEST_README


def test_the_readme_says_what_is_not_real() -> None:
    text = " ".join((ROOT / "README.md").read_text().split())
    for sentence in (
        "tested against an emulated one, not yet against a real one",
        "The groove's section, the tip and the light are ideal there.",
        "Nothing here is a safety function.",
    ):
        assert sentence in text


def leads_to(page: Path) -> set[Path]:
    """The pages that a page links to, or names in the navigation of the site."""
    text = page.read_text()
    targets = {page.parent / target for target in re.findall(r"\]\(([^)#:]+\.md)", text)}
    for names in re.findall(r"^```{toctree}\n(?::.*\n)*\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        targets |= {found for name in names.split() for found in page.parent.glob(f"{name}.md")}
    return {target.resolve() for target in targets}


def test_the_readme_leads_to_every_page_and_names_every_root_folder() -> None:
    text = (ROOT / "README.md").read_text()
    found: set[Path] = set()
    new = {ROOT / "README.md"}
    while new:
        found |= new
        new = {target for page in new for target in leads_to(page) if target.exists()} - found
    assert [path.relative_to(ROOT).as_posix() for path in DOCUMENTS if path not in found] == []
    assert [name for name in FOLDERS if not (ROOT / name).is_dir() or f"\n- `{name}`: " not in text] == []


def test_the_page_of_commands_has_every_command() -> None:
    text = (ROOT / "docs/commands.md").read_text()
    names = (name for name in leaves(program()) if not name.startswith("figures "))
    assert [name for name in names if not re.search(rf"`{name}[ `]|`{name}\]", text)] == []


def test_every_figure_is_cited_by_a_page() -> None:
    text = "\n".join(document.read_text() for document in DOCUMENTS)
    figures = [name for name in leaves(program()) if name.startswith("figures ")]
    assert len(figures) > 15
    assert [name for name in figures if not re.search(rf"{name}(?![a-z-])", text)] == []


def test_the_page_of_scenarios_has_every_scenario() -> None:
    text = (ROOT / "docs/scenarios.md").read_text()
    assert [name for name in scenario_names() if f"`{name}`" not in text] == []


def test_the_scenario_that_the_documents_show_can_be_loaded(tmp_path: Path) -> None:
    (example,) = blocks(ROOT / "docs/scenarios.md", "yaml")
    file = tmp_path / "my_cell.yaml"
    file.write_text(example)
    assert load_scenario(str(file)).welding.speed_mm_s == 6.0


def test_the_dataset_that_the_documents_show_can_be_loaded(tmp_path: Path) -> None:
    page = ROOT / "docs/calibration.md"
    header = next(block for block in blocks(page, "yaml") if block.startswith("schema:"))
    poses = next(block for block in blocks(page, "") if block.startswith("id,x,y,z"))
    (tmp_path / "clouds").mkdir()
    (tmp_path / "dataset.yaml").write_text(header)
    (tmp_path / "poses.csv").write_text(poses)
    points = np.random.default_rng(0).normal(size=(50, 3))
    np.save(tmp_path / "clouds/pose01.npy", points)
    data = load_dataset(tmp_path)
    assert set(data.clouds) == {"pose01"}
    assert data.cloud("pose01") == pytest.approx(points)
    assert data.guess("pose01") is not None


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(document: Path) -> None:
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", document.read_text()):
        assert (document.parent / target).exists(), f"{document.name} links to {target}, which is not there"


def rows_outside_a_table(text: str) -> list[str]:
    """The rows of pipes that a reader of Markdown does not take for a table, such as those below an empty line."""
    tokens = MarkdownIt("commonmark").enable("table").parse(text)
    spans = [t.map for t in tokens if t.map and t.type in ("table_open", "fence", "code_block", "html_block")]
    inside = {line for start, end in spans for line in range(start, end)}
    return [line for k, line in enumerate(text.splitlines()) if line.lstrip().startswith("|") and k not in inside]


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_each_row_of_pipes_is_in_a_table(document: Path) -> None:
    assert rows_outside_a_table(document.read_text()) == []


def test_a_table_that_an_empty_line_breaks_is_found() -> None:
    whole = "# A page\n\n| a | b |\n|---|---|\n| 1 | 2 |\n"
    assert rows_outside_a_table(whole) == []
    assert rows_outside_a_table(whole + "\n| 3 | 4 |\n") == ["| 3 | 4 |"]


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_a_block_of_code_fits_its_column(document: Path) -> None:
    tokens = MarkdownIt("commonmark").parse(re.sub(r"\A---\n.*?^---\n", "", document.read_text(), flags=re.M | re.S))
    code = [token.content for token in tokens if token.type in ("fence", "code_block")]
    shown = [
        (document.parent / name).read_text() for name in re.findall(r"{literalinclude} (\S+)", document.read_text())
    ]
    lines = [line for block in (*code, *shown) for line in block.splitlines()]
    assert [line for line in lines if len(line) > WIDEST_CODE] == []


def test_a_block_of_commands_is_read_as_shell() -> None:
    shell = [block for block in all_blocks() if block.kind == "shell"]
    assert len(shell) > 50
    assert [f"{block.page}:{block.line}" for block in shell if block.language not in ("sh", "console")] == []


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
