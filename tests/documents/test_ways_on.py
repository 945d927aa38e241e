"""What screens, messages and pages tell a reader to do next is done, as it is printed, for one result of each kind;
`python -m tests.ways_on` does it for all results."""

from __future__ import annotations

import ast
import contextlib
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer.main
from typer.testing import CliRunner

from tests.contract.test_imports import FILES
from tests.documents.props import needs_data
from tests.places import SHARED_DATA, require_data
from tests.ways_on import Ran, Walk, copied, offered, results
from weldcal.tools.cli.app import app

ONE_OF_EACH = (
    "calibrate my_scans --out my-calibration",
    "calibrate no_such_scans",
    "verify my-calibration other_scans --limit-mm 0.001 --out refuted",
    "verify eMc.yaml pairs.npz --mounting eye_in_hand",
    "verify touched-calibration --touch touched_points.csv",
    "hand-eye ax-yb pairs.npz --limit-mm 0.01 --out hand_missed",
    "hand-eye ax-yb two_robots.npz",
    "profiler sphere sphere.npz --out my-profiler",
    "tablet calibrate touches.csv --poses poses.csv --camera camera.yaml --seen seen.csv --limit-mm 0.01 --out tablet_missed",
    "apply my-calibration my_scans/clouds/pose03.npz scan_C.ply",
    "export my-calibration --ros2 my_scanner_tf",
    "import my_scans --out imported",
    "robots nobody",
    "view no_such_folder",
)


def in_process(line: str, folder: Path) -> Ran:
    """Execute a line in this process."""
    with contextlib.chdir(folder):
        done = CliRunner().invoke(app, shlex.split(line)[1:], env={"COLUMNS": "80", "BROWSER": "true"})
    return Ran(line, done.exit_code, done.stdout, done.stderr)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Walk:
    """One reader, who keeps what they made."""
    return Walk(tmp_path_factory.mktemp("reader"), in_process)


@pytest.mark.parametrize("words", ONE_OF_EACH)
def test_every_printed_way_on_leads_on(walk: Walk, words: str) -> None:
    if needs_data(words):
        require_data(SHARED_DATA)
    assert [f"{way.printed}: {way.wrong}" for way in walk.result(words) if way.wrong] == []


def test_sixty_results_and_more_are_walked_by_the_command() -> None:
    lines = results()
    assert len(set(lines)) == len(lines)
    assert len(lines) >= 60 or not SHARED_DATA.exists()


PRINTED = """\
calibrate: use with care
  next    weldcal doctor out
          Take scans: run 'weldcal verify out' and name their folder. Or 'weldcal hand-eye
          ax-yb'.
"""


def test_a_command_is_found_on_its_line_and_in_a_sentence() -> None:
    assert offered(PRINTED) == (["weldcal doctor out", "weldcal verify out other_scans"], ["weldcal hand-eye ax-yb"])


def test_what_a_page_copies_is_found(tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    page.write_text(
        '<code id="a">weldcal view &#39;my out&#39;</code><button data-copies="a"></button><button data-copies="b">'
    )
    assert list(copied(page)) == ["weldcal view 'my out'", "no text for the button b", "weldcal view 'my out'"]


@pytest.mark.parametrize(
    ("code", "said", "next", "wrong"),
    [
        (0, "", "weldcal doctor out", ""),
        (1, "weldcal: Correct --flange.", "weldcal doctor out", ""),
        (2, "Missing argument", "weldcal doctor out", "exit code 2"),
        (1, "Traceback (most recent call last)", "weldcal doctor out", "exit code 1"),
        (1, "", "weldcal doctor out", "no sentence"),
        (1, "weldcal: There is no file out.", "weldcal doctor out", "does not exist"),
        (0, "", "weldcal robots", "leads back"),
    ],
)
def test_a_way_that_does_not_lead_on_would_be_found(
    tmp_path: Path, code: int, said: str, next: str, wrong: str
) -> None:
    def shell(line: str, _: Path) -> Ran:
        first = line == "weldcal robots"
        return Ran(line, 0 if first else code, f"  next  {next}\n" if first else "", "" if first else said)

    found = [way.wrong for way in Walk(tmp_path, shell).result("robots") if way.wrong]
    assert bool(found) == bool(wrong)
    assert all(wrong in text for text in found)


def sentences() -> Iterator[tuple[str, str]]:
    """The strings of the package that name a command of it in quotes, with their files; not docstrings."""
    for name, path in FILES.items():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if not isinstance(node, ast.Constant | ast.JoinedStr):
                continue
            parts = [node] if isinstance(node, ast.Constant) else node.values
            text = "".join(str(p.value) if isinstance(p, ast.Constant) else "VALUE" for p in parts)
            yield from ((name, found) for found in re.findall(r"'(weldcal [a-z][^'\n]*)'", text))


def test_each_command_that_a_message_names_exists() -> None:
    seen, wrong = 0, []
    for name, text in sentences():
        seen += 1
        command, words = typer.main.get_command(app), text.split()[1:]
        while words and hasattr(command, "commands") and words[0] != "VALUE":
            command = command.commands.get(words.pop(0))
        known = [o for p in getattr(command, "params", ()) for o in (*p.opts, *p.secondary_opts)]
        if command is None or [w for w in words if w.startswith("--") and w not in known]:
            wrong.append(f"{name}: {text}")
    assert seen > 20
    assert wrong == []
