"""Every block of README and docs: YAML loads, Python runs, and commands without a simulation are executed as
written."""

from __future__ import annotations

import inspect
import re
import shutil
import tomllib
from collections import Counter
from pathlib import Path

import pytest
from typer.testing import CliRunner

import weldcal
from tests.documents.blocks import DOCUMENTS, FENCE, Block, all_blocks, blocks_of, is_command
from tests.documents.command_lines import SHORT, CommandLine, program
from tests.documents.execution import ELSEWHERE, FAILED, WRITTEN, Check, Page, entry_points_of
from tests.documents.props import PROPS, lay_out, named_in, needs_data
from tests.documents.yaml_blocks import check_yaml
from tests.places import ROOT, SHARED_DATA, needs
from tests.short_job import ShortJobs
from weldcal.models.errors import InputError
from weldcal.systems.cell import build_cell
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.cli.app import app
from weldcal.welding.servo.weave import WeaveError

BLOCKS = all_blocks()
LINES = [
    CommandLine(line) for block in BLOCKS if block.kind == "shell" for line in block.commands() if is_command(line)
]
# One of each: the same command on another page, or with another --out, is the same.
ONCE = {line.name.partition(" --out ")[0]: line for line in LINES if line.cheap}
SNIPPETS = [block for block in BLOCKS if block.kind == "yaml"]


def named(block: Block) -> str:
    """A block as the name of a test."""
    return f"{block.page}:{block.line}"


def said_twice(printed: str) -> list[str]:
    """Poses, and lines of words, that a terminal shows more than once."""
    poses = re.findall(r"p\[.*?\]", printed)
    lines = [text for line in printed.splitlines() if len(text := re.sub(r"^ *(\S.*?)?  +|^- ", "", line).strip()) > 30]
    # rows of two matrices are alike, and so are those of two joints, and those of two robots in a table
    lines = [text for text in lines if re.search(r"[a-z]{3}", text) and not re.match(r"[-+]?\d|iso9409.*   ", text)]
    return [text for found in (poses, lines) for text, count in Counter(found).items() if count > 1]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that all commands share, as one reader has it."""
    return tmp_path_factory.mktemp("reader")


@pytest.mark.parametrize(
    "line", [pytest.param(line, marks=needs(SHARED_DATA) if needs_data(line.name) else ()) for line in ONCE.values()],
    ids=lambda line: line.name,
)  # fmt: skip
def test_a_command_without_a_simulation_does_what_the_page_says(
    line: CommandLine, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(place)
    for made in line.makes:
        shutil.rmtree(place / made, ignore_errors=True)
    lay_out(line.name, place, line.makes)
    finished = CliRunner().invoke(app, line.words)
    assert finished.exit_code == 0, finished.output
    assert all((place / made).is_dir() for made in line.makes)
    assert said_twice(finished.stdout) == []


@pytest.mark.parametrize("block", SNIPPETS, ids=named)
def test_a_block_of_yaml_is_what_the_loader_reads(block: Block, tmp_path: Path) -> None:
    assert check_yaml(block, tmp_path, entry_points_of([ROOT / "docs" / "developers.md"]))


@pytest.mark.parametrize(
    ("page", "text", "wrong"),
    [
        ("docs/scenarios.md", "welding: {speed: 6.0}\n", "speed"),
        ("docs/scenarios.md", "extends: no_such_cell\n", "no_such_cell"),
        ("docs/calibration.md", "schema: 1\nrobot: ur10e\nflnge: iso9409-1-50-4-m6\n", "flnge"),
        ("docs/scanners.md", "width: 640\nheight: 480\nfocal: 500.0\n", "focal"),
        ("docs/tool.md", "torch: {xyz_mm: [0.0, 0.0, 300.0]}\n", "lacks"),
    ],
)
def test_a_wrong_block_of_yaml_would_be_caught(page: str, text: str, wrong: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=wrong):
        check_yaml(Block(page, 1, "yaml", text), tmp_path)


def test_the_examples_of_python_run_in_order_and_have_at_most_eight_lines(tmp_path: Path) -> None:
    reader = Page(tmp_path, "")
    blocks = [block for block in blocks_of(ROOT / "docs/python.md") if block.kind == "python"]
    functions = {name for name in weldcal.__all__ if inspect.isfunction(getattr(weldcal, name))}
    shown = {name for name in functions if any(f"weldcal.{name}(" in b.text for b in blocks)}
    assert shown == functions - {"load_scenario"}
    for block in blocks:
        assert len(block.text.splitlines()) <= 8, block.text
        (done,) = reader.execute(block)
        assert done.how == WRITTEN, done.said
    assert (tmp_path / "my_result" / "calibration.yaml").exists()
    assert (tmp_path / "my_run" / "recording.html").exists()
    assert reader.names["summary"]["state"] == "held"  # type: ignore[index]
    assert reader.names["report"].verdict.verdict == "use it"  # type: ignore[attr-defined]


def test_the_diagram_of_ones_own_runs(tmp_path: Path) -> None:
    (block,) = [block for block in blocks_of(ROOT / "docs/developers.md") if block.kind == "python"]
    (done,) = Page(tmp_path, "").execute(block)
    assert done.how == WRITTEN, done.said


@pytest.mark.parametrize("block", [b for b in SNIPPETS if b.page == "docs/weld_orders.md"], ids=named)
def test_each_order_of_the_page_is_one_that_a_cell_can_keep(block: Block) -> None:
    cell = build_cell(load_scenario("s_groove", f"job: {{calibrate: false}}\n{block.text}"))
    cell.station.close()


def test_an_order_that_no_cell_can_keep_would_be_caught() -> None:
    too_fast = "job: {calibrate: false}\nwelding: {weave: {shape: triangle, frequency_hz: 1.5}}"
    with pytest.raises(WeaveError, match="set frequency_hz to"):
        build_cell(load_scenario("s_groove", too_fast))


def test_the_examples_of_a_weld_log_run_on_the_log_of_a_demo(short_jobs: ShortJobs, tmp_path: Path) -> None:
    (tmp_path / "weldcal-out").mkdir()
    (tmp_path / "weldcal-out/demo-s_groove-seed0").symlink_to(short_jobs.folder())
    blocks = [block for block in blocks_of(ROOT / "docs/weld_log.md") if block.kind == "python"]
    for block in blocks:
        (done,) = Page(tmp_path, "").execute(block)
        assert done.how == WRITTEN, done.said
    assert blocks


def test_a_block_of_python_that_fails_would_be_caught(tmp_path: Path) -> None:
    (done,) = Page(tmp_path, "").execute(Block("docs/python.md", 1, "python", "import weldcal\nweldcal.calibrat()\n"))
    assert done.how == FAILED
    assert "calibrat" in done.said


def test_a_check_executes_each_line_once_and_says_what_failed(tmp_path: Path) -> None:
    check = Check()
    text = "weldcal robots ur10e\nweldcal robots nobody\n./tools/run robots ur10e\n./tools/run test\n"
    done = list(Page(tmp_path, "", check).execute(Block("docs/arms.md", 1, "sh", text)))
    assert [step.how for step in done] == [WRITTEN, FAILED, WRITTEN, ELSEWHERE]
    assert "exit code 1" in done[1].said
    assert "nobody" in done[1].said
    assert check.done == {("robots", "ur10e"): WRITTEN}


def test_each_other_block_is_a_listing_without_a_language() -> None:
    assert [named(block) for block in BLOCKS if block.kind == "text" and block.language not in ("", "text")] == []


def test_each_line_of_a_block_of_shell_runs_weldcal_or_installs_an_extra_of_it() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    known = {f"pip install 'weldcal[{extra}]'" for extra in extras}
    others = [line for block in BLOCKS if block.kind == "shell" for line in block.commands() if not is_command(line)]
    assert [line for line in others if line not in known] == []


def test_the_sentences_that_the_page_of_failures_quotes_are_those_of_the_program() -> None:
    page = (ROOT / "docs/how_to/when_it_fails.md").read_text()
    table = page.partition("## A command refuses")[2].partition("Exit code 1")[0]
    quoted = [
        text for row in re.findall(r"^\| (\".+?) \|", table, re.MULTILINE) for text in re.findall(r'"([^"]+)"', row)
    ]
    folders = ("models", "calibration", "welding", "systems", "tools")
    sources = "\n".join(file.read_text() for folder in folders for file in (ROOT / folder).rglob("*.py"))
    assert len(quoted) > 6
    assert [text for text in quoted if text not in sources] == []


def test_each_page_begins_with_a_paragraph() -> None:
    beginnings = {page.relative_to(ROOT).as_posix(): page.read_text().split("\n\n")[1] for page in DOCUMENTS}
    assert [name for name, text in beginnings.items() if not re.match(r"[A-Za-z`*\"]", text)] == []


def test_no_command_stands_in_a_block_that_is_not_found() -> None:
    hidden = re.compile(r"^(?: {4}|\t)\$? ?(?:weldcal|\./tools/run) ", re.MULTILINE)
    assert [page.name for page in DOCUMENTS if hidden.search(FENCE.sub("", page.read_text()))] == []


def test_every_short_form_is_of_a_line_and_can_be_typed() -> None:
    unused = [pattern for pattern, _ in SHORT if not any(re.search(pattern, line.name) for line in LINES)]
    assert unused == []
    whole = program()
    for line in LINES:
        words, command = line.arguments(full=False), whole
        while not line.elsewhere and hasattr(command, "commands"):
            command = command.commands[words.pop(0)]
        if not line.elsewhere:
            command.make_context("weldcal", words)


def test_every_file_that_can_be_made_is_named_by_a_page() -> None:
    named = {name for block in BLOCKS for name in named_in(block.text)} | {
        "short.yaml",
        "short_cell.yaml",
        "short_wired.yaml",
    }
    assert set(PROPS) - named == set()


def test_a_block_is_found_where_it_stands_and_its_commands_are_those_that_are_typed() -> None:
    page = ROOT / "docs" / "datasets.md"
    first = next(blocks_of(page))
    assert page.read_text().splitlines()[first.line - 1].startswith("```")
    console = Block(
        "a.md", 1, "console", "$ weldcal robots   # all of them\nname flange\n$ weldcal robots \\\n  ur10e\n"
    )
    assert console.kind == "shell"
    assert console.commands() == ["weldcal robots", "weldcal robots ur10e"]
