"""The command line keeps its promises: quick help, one sentence for a mistake, one JSON line, the right exit code."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer.main
from pydrake.math import RigidTransform
from typer.testing import CliRunner

from weldcal.models.errors import InputError
from weldcal.tools import console
from weldcal.tools.cli.app import PANELS, app
from weldcal.tools.cli.options import Call, Outcome, fresh_folder, report
from weldcal.tools.report.first_screen import ExpectedError, Findings, FirstScreen, Next

HEAVY = ("pydrake", "open3d", "cv2", "scipy", "matplotlib", "numba", "numpy")


def weldcal(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Runs the command as an operator does."""
    command = [sys.executable, "-P", "-m", "weldcal.tools", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=cwd, timeout=120)


def leaves(command: Any, name: str = "weldcal") -> Iterator[tuple[str, Any]]:
    """Every command that does something, with its full name."""
    if hasattr(command, "commands"):
        for word, child in command.commands.items():
            yield from leaves(child, f"{name} {word}")
    else:
        yield name, command


LEAVES = dict(leaves(typer.main.get_command(app)))


@pytest.mark.parametrize("name", LEAVES)
def test_every_command_explains_itself_and_every_option(name: str) -> None:
    command = LEAVES[name]
    options = {option for parameter in command.params for option in parameter.opts}
    assert command.help
    assert all(parameter.help for parameter in command.params)
    assert "--debug" in options
    if name in ("weldcal emulate-ur", "weldcal emulate-cell"):  # servers: they have no result, only a seed
        assert "--seed" in options
        return
    if name == "weldcal tablet serve":  # a server of one page: no result, nothing random
        return
    assert "--json" in options
    if name == "weldcal new":  # its argument is its output folder
        assert "--seed" in options
        return
    if name == "weldcal export":  # its options name the files; nothing random
        assert {"--ros2", "--drake-directives"} <= options
        return
    # these only look: they write nothing and leave nothing to chance
    only_look = (
        "weldcal view",
        "weldcal replay",
        "weldcal compare",
        "weldcal doctor",
        "weldcal check-robot",
        "weldcal finger loading",
        "weldcal check-cell",
        "weldcal robots",
        "weldcal schema",
        "weldcal apply",  # its argument is the file that it writes
    )
    assert name in only_look or {"--out", "--seed"} <= options


def test_every_command_is_on_one_panel_of_the_help() -> None:
    shown = [name for name, found in typer.main.get_command(app).commands.items() if not found.hidden]  # type: ignore[attr-defined]
    listed = [name for names in PANELS.values() for name in names]
    assert sorted(shown) == sorted(listed)
    assert len(set(listed)) == len(listed)


def test_a_shell_completes_names_without_a_heavy_import() -> None:
    script = (
        "import sys\nfrom weldcal.tools.cli import app as cli\nsys.argv = ['weldcal']\n"
        "try:\n    cli.main()\nexcept SystemExit:\n    pass\n"
        f"assert not {{*{HEAVY}}} & {{*sys.modules}}"
    )
    environment = os.environ | {"_WELDCAL_COMPLETE": "complete_bash", "COMP_WORDS": "weldcal c", "COMP_CWORD": "1"}
    done = subprocess.run([sys.executable, "-P", "-c", script], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["capture", "calibrate", "compare", "camera", "check-robot", "check-cell"]


def test_help_and_a_mistyped_path_load_no_heavy_library() -> None:
    reading = [name for name, made in LEAVES.items() if made.params[0].param_type_name == "argument"]
    calls = [["--help"], *([*name.split()[1:], "--help"] for name in LEAVES)]
    missing = ["calibrate", "doctor", "fleet", "hand-eye ax-yb", "part", "profiler edge", "verify", "view"]
    assert {f"weldcal {name}" for name in missing} <= set(reading)
    calls += [[*name.split(), "no_such"] for name in missing]
    script = (
        "import sys\nfrom weldcal.tools.cli import app as cli\n"
        f"for words in {calls!r}:\n"
        "    sys.argv = ['weldcal', *words]\n"
        "    try:\n        cli.main()\n"
        "    except SystemExit as end:\n        assert end.code == (words[-1] != '--help'), (words, end.code)\n"
        f"    loaded = [name for name in {HEAVY!r} if name in sys.modules]\n    assert not loaded, (words, loaded)\n"
    )
    finished = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=60)
    assert finished.returncode == 0, finished.stderr
    assert "calibrate" in finished.stdout
    assert finished.stderr.count("There is no file or folder 'no_such'") == len(missing)


@pytest.mark.parametrize(
    "arguments",
    [
        *(
            ["dance"],
            ["demo", "--colour"],
            ["demo", "--seed", "-1"],
            ["calibrate"],
            ["calibrate", "a", "--scenario", "b"],
            ["calibrate", "--scenario", "calibrate_only", "--poses", "a:b"],
        ),
        *(["tablet", "calibrate", "a.csv", "--pen-length-mm", number] for number in ("nan", "inf", "1e308")),
        ["demo", "--speed-factor", "nan"],
    ],
)
def test_wrong_usage_ends_with_2_and_a_hint(arguments: list[str]) -> None:
    finished = weldcal(*arguments)
    assert finished.returncode == 2
    assert "Usage:" in finished.stderr
    assert "Traceback" not in finished.stderr


@pytest.mark.parametrize(
    "arguments", [["demo", "--scenario", "no_such"], ["calibrate", "no_such"], ["view", "no_such"]]
)
def test_a_mistake_ends_with_1_one_sentence_and_nothing_written(arguments: list[str], tmp_path: Path) -> None:
    finished = weldcal(*arguments, cwd=tmp_path)
    assert finished.returncode == 1
    assert finished.stdout == ""
    assert finished.stderr.startswith("weldcal: ")
    assert len(finished.stderr.splitlines()) == 1
    assert "no_such" in finished.stderr
    assert "Internal error" not in finished.stderr
    assert list(tmp_path.iterdir()) == []


def test_with_json_a_mistake_is_json_too(tmp_path: Path) -> None:
    finished = weldcal("view", "no_such", "--json", cwd=tmp_path)
    assert finished.returncode == 1
    assert json.loads(finished.stdout.splitlines()[-1])["state"] == "failed"


@pytest.mark.parametrize(
    "arguments",
    [
        ["demo"],
        ["calibrate", "data"],
        ["verify", "result", "data"],
        ["hand-eye", "ax-yb", "poses.csv"],
        ["profiler", "sphere", "scans.npz"],
        ["tablet", "calibrate", "touches.csv"],
    ],
)
@pytest.mark.parametrize("place", ["file/result", "file", "/proc/result"])
def test_a_folder_that_cannot_be_written_is_refused_before_any_work(
    arguments: list[str], place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before the files are looked at: none of them exists, and the sentence is not about them."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    finished = CliRunner().invoke(app, [*arguments, "--out", place])
    assert finished.exit_code == 1
    assert f"'{place}'" in finished.stderr
    assert "Give a" in finished.stderr
    assert "folder" in finished.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_sigterm_leaves_the_result_folder_as_ctrl_c_does(tmp_path: Path) -> None:
    script = (
        "import os, signal, sys\nfrom weldcal.systems import runner\nfrom weldcal.tools.cli import app\n"
        "from weldcal.tools.commands import run\nwhole = run.run_cell\n"
        "def ended(cell, progress, *rest):\n"
        "    def tell(stage, fraction):\n"
        "        os.kill(os.getpid(), signal.SIGTERM)\n"
        "    return whole(cell, tell, *rest)\n"
        "run.run_cell = ended\n"
        f"sys.argv = ['weldcal', 'weld', '--no-browser', '--json', '--out', {str(tmp_path / 'run')!r}]\napp.main()\n"
    )
    finished = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=120)
    assert finished.returncode == 1, finished.stderr
    said = json.loads(finished.stdout.splitlines()[-1])
    assert said["state"] == "held"
    assert "SIGTERM" in said["reason"]
    assert (tmp_path / "run" / "report.html").is_file()


def test_view_finds_the_pages_of_a_result(tmp_path: Path) -> None:
    for name in ("report.html", "recording.html"):
        (tmp_path / name).write_text("<p>page</p>")
    finished = weldcal("view", str(tmp_path), "--no-browser", "--json")
    assert json.loads(finished.stdout)["pages"] == [str(tmp_path / "report.html"), str(tmp_path / "recording.html")]


def test_an_earlier_result_is_never_written_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    first = fresh_folder("demo", "s_groove", 7)
    assert first == Path("weldcal-out/demo-s_groove-seed7")
    first.mkdir(parents=True)
    assert fresh_folder("demo", "s_groove", 7) == Path("weldcal-out/demo-s_groove-seed7-2")
    assert fresh_folder("demo", "folder/mine.yaml", 0).name == "demo-mine-seed0"


@pytest.mark.parametrize(
    ("failure", "words"),
    [
        (InputError("Name a folder."), "weldcal: Name a folder.\n"),
        (FileNotFoundError(2, "No such file or directory", "x/y"), "weldcal: No such file or directory: x/y."),
        (RuntimeError("bad luck"), "weldcal: Internal error of weldcal: RuntimeError: bad luck."),
    ],
)
def test_every_failure_is_a_sentence(failure: Exception, words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit) as end, console.boundary(json_wanted=False, debug=False):
        raise failure
    assert end.value.exit_code == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith(words)
    assert "Traceback" not in said.err


def test_ctrl_c_ends_with_130_and_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit) as end, console.boundary(json_wanted=True, debug=False):
        raise KeyboardInterrupt
    assert end.value.exit_code == 130
    said = capsys.readouterr()
    assert said.err.startswith("weldcal: Ctrl-C or SIGTERM ended the command.")
    assert len(said.err.splitlines()) == 1
    assert json.loads(said.out)["state"] == "failed"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ["weld", "--scenario", "straight_grove"],
            "There is no scenario 'straight_grove': did you mean 'straight_groove'?",
        ),
        (["weld", "--robot", "emulatd"], "There is no robot 'emulatd': did you mean 'emulated'?"),
        (["hand-eye", "ax-yb", "poses.csv", "--robot", "ur10ee"], "There is no arm 'ur10ee'; did you mean 'ur10e'?"),
    ],
)
def test_a_slip_of_the_keyboard_gets_the_nearest_name(
    arguments: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("poses.csv").touch()
    finished = CliRunner().invoke(app, arguments)
    assert finished.exit_code == 1
    assert words in finished.stderr


def test_debug_shows_where_it_happened(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit), console.boundary(json_wanted=False, debug=True):
        raise RuntimeError("bad luck")
    assert "Traceback" in capsys.readouterr().err


def test_a_job_that_is_held_ends_with_1_and_says_why(capsys: pytest.CaptureFixture[str]) -> None:
    held = Outcome({"state": "held", "reason": "The tag was not seen."})
    call = Call("demo", {"json": True}, ExitStack())
    with pytest.raises(typer.Exit) as end:
        report("demo", held, call)
    assert end.value.exit_code == 1
    said = capsys.readouterr()
    assert json.loads(said.out)["state"] == "held"
    assert "The tag was not seen." in said.err


@pytest.mark.parametrize(
    ("options", "stated"), [((), False), (("--browser",), True), (("--share",), True), (("--no-browser",), False)]
)
def test_json_says_that_it_opens_no_page(
    options: tuple[str, ...], stated: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def stop(*_: object) -> None:
        raise InputError("Far enough.")

    monkeypatch.setattr("weldcal.tools.commands.demo.run_procedure", stop)
    arguments = ["demo", "--json", *options, "--out", str(tmp_path)]
    monkeypatch.setattr("sys.argv", ["weldcal", *arguments])
    found = CliRunner().invoke(app, arguments)
    assert "Far enough." in found.stderr
    assert ("no page is opened" in found.stderr) == stated


def test_a_runs_page_shows_its_result_before_it_closes() -> None:
    happened: list[str] = []
    first = FirstScreen(Findings(unseen=8), ExpectedError("error", "0.2 mm", "8 poses"), Next("Verify it."))

    def show(what: FirstScreen | None, folder: Path | None) -> None:
        happened.append(f"shown {what is first}")

    call = Call("demo", {}, ExitStack())
    call.keep_page(lambda *_: happened.append("the first run's"), lambda: happened.append("closed first"))
    call.keep_page(show, lambda: happened.append("closed"))
    report("demo", Outcome({"state": "done"}, first=first), call)
    call.close_page()
    call.close_page()
    assert happened == ["closed first", "shown True", "closed"]


def test_what_no_scan_can_show_and_the_pose_does_not_need_is_no_row(capsys: pytest.CaptureFixture[str]) -> None:
    summary = {"state": "done", "unobservable": ["A rotation of the flange about its own axis."]}
    first = FirstScreen(Findings(unseen=8), ExpectedError("error", "0.2 mm", "8 poses"), Next("Verify it."))
    report("calibrate", Outcome(summary, first=first), Call("calibrate", {}, ExitStack()))
    assert "unobservable" not in capsys.readouterr().out
    report("calibrate", Outcome(summary, first=first), Call("calibrate", {"json": True}, ExitStack()))
    assert "unobservable" in capsys.readouterr().out


def test_a_person_reads_short_values_with_their_units_and_every_refusal() -> None:
    shown = console.rows(
        {
            "state": "done",
            "n_used": 17,
            "held_out_mm": {"median": 0.57123, "p95": 1.2},
            "X_BC_error_mm": 0.08,
            "nested": {"a": {"b": 1.0}},
            "refused": [{"id": "pose04", "reason": "It is empty."}],
            "X_BC": [[1.0, 0.0], [0.0, 1.0]],
            "warnings": ["One.", "Two."],
            "scanner_correction": None,
        }
    )
    assert {name: text for name, text in shown.items() if text} == {
        "scans used": "17",
        "held-out error": "median 0.571, p95 1.2 mm",
        "X_BC error": "0.08 mm",
        "refused pose04": "It is empty.",
        "warnings": "One.\nTwo.",
    }


class Colour(Enum):
    """An example of an enumeration in a result."""

    RED = "red"


@dataclass(frozen=True)
class Part:
    """An example of a nested result."""

    length_mm: float
    where: Path


def test_results_become_strict_json(capsys: pytest.CaptureFixture[str]) -> None:
    console.emit_json(
        {
            "X_BC": RigidTransform(np.array([1.0, 2.0, 3.0])),
            "numbers": np.array([1.5, np.nan, np.inf]),
            "count": np.int64(3),
            "ok": np.bool_(True),
            "part": Part(0.5, Path("a/b")),
            "colour": Colour.RED,
            "ids": ("a", "b"),
            "nothing": None,
        }
    )
    assert json.loads(capsys.readouterr().out) == {
        "X_BC": [[1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 0.0, 2.0], [0.0, 0.0, 1.0, 3.0], [0.0, 0.0, 0.0, 1.0]],
        "numbers": [1.5, None, None],
        "count": 3,
        "ok": True,
        "part": {"length_mm": 0.5, "where": "a/b"},
        "colour": "red",
        "ids": ["a", "b"],
        "nothing": None,
    }
